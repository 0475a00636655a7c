r"""$B^{-1} M B^{-1}$: covariance from the curvature of a cost and from its gradient's.

??? cite "Source"
    Huber, *The behavior of maximum likelihood estimates under nonstandard conditions*,
    Proc. 5th Berkeley Symp. 1, 1967; White, *A heteroskedasticity-consistent covariance
    matrix estimator*, Econometrica 48(4), 1980.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from phongfit.fitting.uncertainty.intervals import SHARE, WIDTHS, Quadratic


class Sandwich(NamedTuple):
    r"""The parts of $B^{-1} M B^{-1}$ at a point, in double precision.

    - `bread`: $B$, the curvature of half the cost.
    - `meat`: $M$, the covariance of its gradient, widened for residuals that are not
        independent.
    - `pull`: that gradient.
    - `inside`: $J^\top J$ of the samples that are not white.
    - `resolution`: machine epsilon of the numbers that were summed.
    """

    bread: np.ndarray
    meat: np.ndarray
    pull: np.ndarray
    inside: np.ndarray
    resolution: float

    def part(self, chosen: np.ndarray) -> "Sandwich":
        """The sandwich of some unknowns, with the others held."""
        both = np.ix_(chosen, chosen)
        return Sandwich(
            self.bread[both],
            self.meat[both],
            self.pull[chosen],
            self.inside[both],
            self.resolution,
        )

    def strain(self, held: Bool[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Scores of held unknowns in standard deviations, with the others optimal.

        0 for unknowns that are not held. For a single unknown this is the score test of
        the held value.

        ??? cite "Source"
            Rao, *Large sample tests of statistical hypotheses concerning several
            parameters*, Proc. Camb. Phil. Soc. 44(1), 1948.
        """
        free = np.flatnonzero(~held)
        inverse = inverse_of(self.bread[np.ix_(free, free)], self.resolution)
        # Scores of the held unknowns, minus the part that the others take over.
        weights = np.diag(held.astype(float))
        weights[:, free] -= weights @ self.bread[:, free] @ inverse
        variance = np.einsum("ki,ij,kj->k", weights, self.meat, weights)
        score = np.abs(weights @ self.pull)
        return np.where(held, score / np.sqrt(np.where(variance > 0, variance, 1)), 0)

    def covariance(self) -> np.ndarray:
        """Covariance of all unknowns, without bounds."""
        inverse = inverse_of(self.bread, self.resolution)
        return inverse @ self.meat @ inverse


def as_quadratic(
    sandwich: Sandwich,
    lower: Float[np.ndarray, " n"],
    upper: Float[np.ndarray, " n"],
    *,
    steep: Bool[np.ndarray, " n"] | None = None,
    rise: float = 0.0,
    center: Float[np.ndarray, " n"] | None = None,
) -> Quadratic:
    r"""$\Delta\chi^2$ about a point, of which a sandwich is the covariance.

    Without bounds the estimates have the covariance $V = B^{-1} M B^{-1}$. A cost with
    the curvature $V^{-1}$ is then equivalent to $\chi^2$ for $M = B$.

    **Arguments:**

    - `sandwich`: the sandwich at the point.
    - `lower`, `upper`: the box, in steps from the point.
    - `steep`: true for unknowns that were held there, with a slope.
    - `rise`: increase of $\chi^2$ at the point.
    - `center`: the point, as a step from the solution; default none.
    """
    scaled, root = unit_diagonal(sandwich.bread)
    values, vectors = np.linalg.eigh(scaled)
    identified = values > threshold(sandwich.resolution)
    half = vectors[:, identified] * np.sqrt(values[identified])
    dual = vectors[:, identified] / np.sqrt(values[identified])
    # The meat in units of the bread: 1 if residuals are as expected.
    core = dual.T @ (sandwich.meat / np.outer(root, root)) @ dual
    shares, axes = np.linalg.eigh(core)
    # Rounding may make eigenvalues of barely identified directions 0 or negative.
    shares = np.maximum(shares, 1e-6 * shares.max(initial=1e-30))
    half = half @ axes
    precision = (half / shares) @ half.T * np.outer(root, root)
    # P B⁻¹ converts a gradient of the cost to one of this quadratic.
    slope = root * ((half / shares) @ (axes.T @ (dual.T @ (sandwich.pull / root))))
    # The slope of free unknowns is rounding; at a bound it points beyond the bound.
    slope_held = np.where(lower >= 0, np.maximum(slope, 0), 0)
    slope_held = np.where(upper <= 0, np.minimum(slope, 0), slope_held)
    free = (lower < 0) & (upper > 0)
    kept = free & (np.zeros_like(free) if steep is None else steep)
    slope = np.where(kept, slope, np.where(free, 0, slope_held))
    # Directions that the data do not determine are limited by the box.
    width = np.maximum(upper - lower, 1e-12)
    known = np.diag(precision)
    ridge = SHARE * known + 1 / (WIDTHS * width) ** 2 + 1e-30
    center = np.zeros_like(slope) if center is None else center
    precision = (precision + precision.T) / 2 + np.diag(ridge)
    return Quadratic(precision, slope, lower, upper, rise, center)


def inverse_of(bread: np.ndarray, resolution: float) -> np.ndarray:
    """Inverse on the identified directions; 0 on the others."""
    scaled, root = unit_diagonal(bread)
    values, vectors = np.linalg.eigh(scaled)
    identified = values > threshold(resolution)
    inverse = (vectors[:, identified] / values[identified]) @ vectors[:, identified].T
    return inverse / np.outer(root, root)


def unit_diagonal(bread: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A matrix with a unit diagonal, and the roots of the old one (1 for 0)."""
    root = np.sqrt(np.diag(bread))
    root = np.where(root > 0, root, 1)
    return bread / np.outer(root, root), root


def threshold(resolution: float) -> float:
    """Eigenvalue of a normalised JᵀJ below which a direction is rounding alone."""
    return max((32 * resolution) ** 2, 1e-14)
