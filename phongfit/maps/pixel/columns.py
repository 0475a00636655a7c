r"""The part of the problem that does not change with the exponent, worked out once.

The measured light is freed of what the unknowns other than the highlight explain: what
is left is small where there is no highlight, so that sums over the lights keep their
digits in single precision. All that a highlight is ever summed with is multiplied by
its strength beforehand, so that an exponent asks for a matrix times a vector.
"""

from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from phongfit.maps.pixel.small import (
    Numbers,
    Triangle,
    factorize,
    optimization_barrier,
    solve,
)

Lights: TypeAlias = tuple[Float[Array, "*channels images"], ...]
"""An array for each light of an image, most often one."""


class Columns(NamedTuple):
    r"""One channel: columns C of weights W, and $y = y_\perp + C x_0$.

    With the strengths $\sigma_j$ of an image's highlights and their heights $s_j$ the
    highlight is $S = \sum_j \sigma_j s_j$. Its sums over the images are those of the
    $s_j$ and of their products, with

    - `gram`: $C^\top W C$.
    - `start`: $x_0$, the solution without a highlight and without bounds.
    - `moments`: a row $W \sigma_j C_k$ for each column, and last $W \sigma_j y_\perp$;
        the lights j one after another.
    - `squares`: $W \sigma_j \sigma_k$ for each of [`pairs`][], one after another; twice
        that where $j \ne k$, for (k, j) is no pair of its own.
    - `rest`: $y_\perp^\top W y_\perp$, what is left without a highlight.
    """

    gram: Triangle
    start: Numbers
    moments: Float[Array, "rows lobes_images"]
    squares: Float[Array, " pairs_images"]
    rest: Float[Array, ""]


def make_columns(
    columns: Lights, target: Array, weight: Array, strength: Lights
) -> Columns:
    """Columns of one channel; where `weight` is 0, the others are only finite."""
    columns, target, weight, strength = optimization_barrier(
        (columns, target, weight, strength)
    )
    start, gram, rest = (), (), target
    if columns:
        rows = optimization_barrier(jnp.stack([weight * column for column in columns]))
        size = len(columns)
        products = [weighed_sums(rows, vector) for vector in (*columns, target)]
        gram = tuple(tuple(products[j][i] for j in range(i + 1)) for i in range(size))
        moments = tuple(products[-1][i] for i in range(size))
        gram, moments = optimization_barrier((gram, moments))
        start = solve(factorize(gram), moments)
        for column, x in zip(columns, start, strict=True):
            rest = rest - x * column
    weighed = optimization_barrier(tuple(weight * each for each in strength))
    rows = [joined([each * row for each in weighed]) for row in (*columns, rest)]
    squares = joined(pairs(strength, weighed, 2))
    left = jnp.sum(weight * rest**2)
    return optimization_barrier(Columns(gram, start, jnp.stack(rows), squares, left))


def pairs(left: Lights, right: Lights, unequal: float = 1) -> list[Array]:
    """Products of each light with itself, and `unequal` times with those before it."""
    return [
        left[j] * right[k] * (1 if j == k else unequal)
        for j in range(len(left))
        for k in range(j + 1)
    ]


def joined(parts: list[Array]) -> Array:
    """One after another."""
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts)


def weighed_sums(
    rows: Float[Array, "*batch images"], vector: Float[Array, " images"]
) -> Float[Array, "*batch"]:
    """Each row times a vector, in full precision on every machine."""
    if rows.shape[0] == 1:
        # An axis of length 1 makes some compilers' sums ten times slower.
        return weighed_sums(rows[0], vector)[None]
    if rows.ndim == 1:
        return jnp.sum(rows * vector)
    return jnp.matmul(rows, vector, precision=jax.lax.Precision.HIGHEST)
