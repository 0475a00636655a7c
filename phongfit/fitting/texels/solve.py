"""Sparse symmetric systems of texels: solved, and the diagonal of their inverses."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg

from phongfit.fitting.texels.sums import Grid

EXACT = 2000
"""Unknowns up to which a matrix is inverted as a whole."""

SPACING = 8
"""Texels between those that are probed at once; further away they hardly covary."""

AT_ONCE = 16
"""Right-hand sides that are solved for together."""

STEPS = 2000


class Preconditioned(NamedTuple):
    """A positive definite matrix, scaled to a diagonal of 1, and by what."""

    matrix: sparse.csr_array
    scale: Float[np.ndarray, " n"]

    def solve(
        self,
        right: Float[np.ndarray, "n k"],
        tolerance: float,
        free: Bool[np.ndarray, " n"] | None = None,
    ) -> Float[np.ndarray, "n k"]:
        """The solution for k right-hand sides, by conjugate gradients.

        **Arguments:** `free`: the others stay 0, as if they were known.
        """
        count, sides = right.shape
        kept = np.ones(count) if free is None else free.astype(float)
        scaled = right * (self.scale * kept)[:, None]
        length = np.linalg.norm(scaled, axis=0)
        length = np.where(length > 0, length, 1)

        def apply(x: np.ndarray) -> np.ndarray:
            x = x.reshape(count, sides)
            return (kept[:, None] * (self.matrix @ (kept[:, None] * x))).ravel()

        shape = (count * sides, count * sides)
        operator = LinearOperator(shape, matvec=apply, dtype=float)  # pyright: ignore
        found, _ = cg(
            operator, (scaled / length).ravel(), rtol=tolerance, maxiter=STEPS
        )
        return found.reshape(count, sides) * length * (self.scale * kept)[:, None]


def precondition(matrix: sparse.csr_array) -> Preconditioned:
    """A matrix with a positive diagonal, ready to be solved."""
    scale = 1 / np.sqrt(matrix.diagonal())
    scaling = sparse.diags_array(scale)
    return Preconditioned(sparse.csr_array(scaling @ matrix @ scaling), scale)


def inverse_diagonal(
    system: Preconditioned, grid: Grid, parameters: int, tolerance: float = 1e-3
) -> Float[np.ndarray, " n"]:
    r"""The diagonal of the inverse: exactly if small, else by probing.

    Texels eight apart are probed at once, with random signs $v$: what the solution $x$
    of $N x = v$ has at each is its own variance, and what is left of the covariance
    with the next ones.

    ??? cite "Source"
        Tang and Saad, *A probing method for computing the diagonal of a matrix
        inverse*, Numer. Linear Algebra Appl. 19(3), 2012.
    """
    count = len(system.scale)
    if count <= EXACT:
        return np.diag(np.linalg.inv(system.matrix.toarray())) * system.scale**2
    row, column = np.divmod(np.arange(grid.texels), grid.columns)
    # Layers come one below the other.
    colour = row % grid.rows % SPACING * SPACING + column % SPACING
    colour = np.concatenate([colour + p * SPACING**2 for p in range(parameters)])
    sign = np.random.default_rng(0).choice([-1.0, 1.0], count)
    found = np.zeros(count)
    for start in range(0, parameters * SPACING**2, AT_ONCE):
        probed = colour[:, None] == start + np.arange(AT_ONCE)
        # Scaled, the solution's own entry is the variance over that of one alone.
        probes = np.where(probed, (sign / system.scale)[:, None], 0)
        solved = system.solve(probes, tolerance)
        found += np.where(probed, solved * (sign * system.scale)[:, None], 0).sum(
            axis=1
        )
    # What covaries with the next ones may make it too small: alone it has no less.
    return np.maximum(found, system.scale**2)
