"""Matrices of grids of texels as images, one for each offset between neighbours.

A sparse matrix with indices takes six times as much memory as these images, and to read
it takes most of the time of a step of conjugate gradients. There are hundreds of steps
if photographs determine texels poorly.
"""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Bool, Float

from phongfit.fitting.texels.solve import STEPS, AbstractSystem
from phongfit.fitting.texels.sums import OFFSETS
from phongfit.programs import program

Pairs = tuple[tuple[int, int], ...]


@dataclasses.dataclass(frozen=True, eq=False)
class Stencil(AbstractSystem):
    """A positive definite matrix over texels of a grid, in the photographs' precision.

    **Arguments:**

    - `scale`: factors of rows and columns that make the diagonal 1.
    - `pairs`: pairs of fields p ≤ q that samples couple.
    - `images`: for each pair an array with an image for each offset, whose border
        repeats the opposite edge.
    - `by`: `scale` in the units of `images`.
    """

    scale: Float[np.ndarray, " n"]
    pairs: Pairs
    images: tuple[Float[Array, "offsets layers rows_2 columns_2"], ...]
    by: Float[np.ndarray, "fields layers rows columns"]

    def solve(
        self,
        right: Float[np.ndarray, "n k"],
        tolerance: float,
        free: Bool[np.ndarray, " n"] | None = None,
    ) -> Float[np.ndarray, "n k"]:
        dtype, shape = self.by.dtype, self.by.shape
        scale = (self.scale if free is None else self.scale * free).astype(dtype)
        by = jnp.asarray(self.by if free is None else self.by * free.reshape(shape))
        least = jnp.asarray(tolerance, dtype)
        found = np.empty(right.shape, dtype, "F")
        # One column after another, since each needs its own number of steps.
        for k, column in enumerate(right.T):
            scaled = jnp.asarray((column * scale).reshape(shape), dtype)
            solved = _descend(self.images, by, scaled, least, self.pairs)
            found[:, k] = np.ravel(solved) * scale
        return found

    def variances(self) -> None:
        return None


def make_stencil(
    blocks: dict[tuple[int, int], Float[np.ndarray, "offsets texels"]],
    shape: tuple[int, ...],
    prior: float | Float[np.ndarray, " n"],
    unit: Float[np.ndarray, " n"] | None,
) -> Stencil:
    """The matrix of `AbstractTexels.matrix` for a grid, multiplied by units.

    **Arguments:** `blocks`, `prior`: as in `AbstractTexels.matrix`. `shape`: the grid's
    shape. `unit`: factors of rows and columns, or None if all are 1.
    """
    fields = 1 + max(q for _, q in blocks)
    dtype = jnp.result_type(float)
    prior = np.broadcast_to(prior, fields * math.prod(shape)).reshape(fields, -1)
    own = np.stack([blocks[p, p][0] + prior[p] for p in range(fields)])
    by = 1 / np.sqrt(own)
    images = []
    for (p, q), block in blocks.items():
        image = _bordered(block.reshape(-1, *shape))
        if p == q:
            image[0] = _bordered(own[p].reshape(shape))
        images.append(jnp.asarray(image, dtype))
    scale = by.ravel() if unit is None else by.ravel() / unit
    by = by.astype(dtype, copy=False).reshape(fields, *shape)
    return Stencil(scale, tuple(blocks), tuple(images), by)


def _bordered(images: np.ndarray) -> np.ndarray:
    """Images with a border of one pixel that repeats the opposite edge."""
    border = [(0, 0)] * (images.ndim - 2) + [(1, 1)] * 2
    return np.pad(images, border, mode="wrap")


@program("pairs")
def _descend(
    images: tuple[Array, ...], by: Array, right: Array, tolerance: Array, pairs: Pairs
) -> Array:
    """Conjugate gradients for one right-hand side."""

    def apply(x: Array) -> Array:
        return by * _product(images, by * x, pairs)

    # JAX takes an array for the tolerance, although it asks for a float.
    found, _ = cg(apply, right, tol=tolerance, maxiter=STEPS)  # pyright: ignore
    return found


def _product(images: tuple[Array, ...], x: Array, pairs: Pairs) -> Array:
    """A matrix times a vector, field by field."""
    beyond = jnp.pad(x, ((0, 0), (0, 0), (1, 1), (1, 1)), mode="wrap")
    total = [jnp.zeros_like(own) for own in x]
    for (p, q), image in zip(pairs, images, strict=True):
        total[p] += _image_times(image, beyond[q])
        if p != q:
            total[q] += _image_times(image, beyond[p])
    return jnp.stack(total)


def _image_times(image: Array, x: Array) -> Array:
    """Product for one pair of fields; both arguments have a border."""
    rows, columns = x.shape[1] - 2, x.shape[2] - 2

    def at(whole: Array, down: int, right: int) -> Array:
        return whole[:, 1 + down : 1 + down + rows, 1 + right : 1 + right + columns]

    total = at(image[0], 0, 0) * at(x, 0, 0)
    # Add each texel's products with its neighbours at ± the offset.
    for one, (down, right) in zip(image[1:], OFFSETS[1:], strict=False):
        total += at(one, 0, 0) * at(x, down, right)
        total += at(one, -down, -right) * at(x, -down, -right)
    return total
