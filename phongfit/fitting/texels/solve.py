"""Sparse symmetric systems of texels: solved, and the diagonal of their inverses."""

import abc
import dataclasses
import functools
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, SuperLU, cg, splu

from phongfit.fitting.texels.sums import AbstractTexels

EXACT = 2000
"""Unknowns up to which a matrix is inverted as a whole."""

AT_ONCE, ROOM = 16, 4_000_000
"""Right-hand sides that are solved for together, and numbers in them, at the most."""

BLOCK = 100_000
"""Rows of a matrix that are scaled at a time."""

STEPS = 2000

SYMMETRIC: dict[str, Any] = {
    "permc_spec": "MMD_AT_PLUS_A",
    "diag_pivot_thresh": 0.0,
    "options": {"SymmetricMode": True},
}
"""Of SuperLU, for positive definite matrices."""


DIRECT = 150_000
"""Unknowns up to which a matrix is factored, where steps of descent take too many."""

PATIENCE = 150
"""Steps of conjugate gradients that are tried before."""


class AbstractSystem(abc.ABC):
    """A positive definite matrix, scaled to a diagonal of 1, and by what."""

    scale: Float[np.ndarray, " n"]

    @abc.abstractmethod
    def solve(
        self,
        right: Float[np.ndarray, "n k"],
        tolerance: float,
        free: Bool[np.ndarray, " n"] | None = None,
    ) -> Float[np.ndarray, "n k"]:
        """The solution for k right-hand sides.

        **Arguments:** `free`: the others stay 0, as if they were known.
        """

    @abc.abstractmethod
    def variances(self) -> Float[np.ndarray, " n"] | None:
        """The diagonal of the inverse, if the matrix is small enough to be inverted."""


@dataclasses.dataclass(frozen=True, eq=False)
class Preconditioned(AbstractSystem):
    """A matrix that is solved by conjugate gradients, or by its factors.

    Few steps do where photographs tell each texel apart; where they do not, factors, if
    there is room for them.
    """

    matrix: sparse.csr_array
    scale: Float[np.ndarray, " n"]

    @functools.cached_property
    def factor(self) -> SuperLU:
        """Of the whole matrix."""
        return splu(sparse.csc_array(self.matrix), **SYMMETRIC)

    def solve(
        self,
        right: Float[np.ndarray, "n k"],
        tolerance: float,
        free: Bool[np.ndarray, " n"] | None = None,
    ) -> Float[np.ndarray, "n k"]:
        count, sides = right.shape
        together = at_once(count)
        if sides > together:
            parts = np.split(right, range(together, sides, together), axis=1)
            return np.hstack([self.solve(part, tolerance, free) for part in parts])
        kept = np.ones(count) if free is None else free.astype(float)
        scaled = right * (self.scale * kept)[:, None]
        length = np.linalg.norm(scaled, axis=0)
        length = np.where(length > 0, length, 1)

        def apply(x: np.ndarray) -> np.ndarray:
            x = x.reshape(count, sides)
            return (kept[:, None] * (self.matrix @ (kept[:, None] * x))).ravel()

        shape = (count * sides, count * sides)
        operator = LinearOperator(shape, matvec=apply, dtype=float)  # pyright: ignore
        direct = count <= DIRECT
        whole = free is None or bool(free.all())
        found, info = np.zeros(count * sides), 1
        if not (whole and "factor" in self.__dict__):
            start, steps = (scaled / length).ravel(), PATIENCE if direct else STEPS
            found, info = cg(operator, start, rtol=tolerance, maxiter=steps)
        found = found.reshape(count, sides) * length
        if info and direct:
            found = self._direct(scaled, None if whole else kept)
        return found * (self.scale * kept)[:, None]

    def variances(self) -> Float[np.ndarray, " n"] | None:
        if len(self.scale) > EXACT:
            return None
        return np.diag(np.linalg.inv(self.matrix.toarray())) * self.scale**2

    def _direct(self, scaled: np.ndarray, kept: np.ndarray | None) -> np.ndarray:
        if kept is None:
            return self.factor.solve(scaled)
        mask = sparse.diags_array(kept)
        # What is known has a row of its own.
        matrix = mask @ self.matrix @ mask + sparse.diags_array(1 - kept)
        return splu(sparse.csc_array(matrix), **SYMMETRIC).solve(scaled)


def at_once(count: int) -> int:
    """How many right-hand sides of so many numbers are solved for together."""
    return int(np.clip(ROOM // count, 1, AT_ONCE))


def precondition(matrix: sparse.csr_array) -> Preconditioned:
    """A matrix with a positive diagonal, ready to be solved: scaled in its place."""
    scale = 1 / np.sqrt(matrix.diagonal())
    rescale(matrix, scale)
    return Preconditioned(matrix, scale)


def rescale(matrix: sparse.csr_array, scale: Float[np.ndarray, " n"]) -> None:
    """Multiply rows and columns, in place."""
    each = np.diff(matrix.indptr)
    # Some rows at a time: of every entry a number more would be half a matrix.
    for start in range(0, len(scale), BLOCK):
        rows = slice(start, start + BLOCK)
        ends = matrix.indptr[[start, min(start + BLOCK, len(scale))]]
        own = np.repeat(scale[rows], each[rows])
        matrix.data[slice(*ends)] *= own * scale[matrix.indices[slice(*ends)]]


def inverse_diagonal(
    system: AbstractSystem,
    grid: AbstractTexels,
    parameters: int,
    tolerance: float = 1e-2,
) -> Float[np.ndarray, " n"]:
    r"""The diagonal of the inverse: exactly if small, else by probing.

    Of 9 216 texels that four samples see each, its roots were 0.3 % off, root mean
    square, and one in a thousand 2 %; with a tolerance of 1e-3 it is a third of that.

    Texels far apart are probed at once, with random signs $v$: what the solution $x$
    of $N x = v$ has at each is its own variance, and what is left of the covariance
    with the next ones.

    ??? cite "Source"
        Tang and Saad, *A probing method for computing the diagonal of a matrix
        inverse*, Numer. Linear Algebra Appl. 19(3), 2012.
    """
    count, exact = len(system.scale), system.variances()
    if exact is not None:
        return exact
    own = grid.colours()
    kinds = int(own.max()) + 1
    colour = np.concatenate([own + p * kinds for p in range(parameters)])
    sign = np.random.default_rng(0).choice([-1.0, 1.0], count)
    found = np.zeros(count)
    together = at_once(count)
    for start in range(0, parameters * kinds, together):
        probed = colour[:, None] == start + np.arange(together)
        # Scaled, the solution's own entry is the variance over that of one alone.
        probes = np.where(probed, (sign / system.scale)[:, None], 0)
        solved = system.solve(probes, tolerance)
        found += np.where(probed, solved * (sign * system.scale)[:, None], 0).sum(
            axis=1
        )
    # What covaries with the next ones may make it too small: alone it has no less.
    return np.maximum(found, system.scale**2)
