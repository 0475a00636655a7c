"""Error bars from the Jacobian at the solution, and unidentified unknowns."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from phongfit.codes import coded
from phongfit.fitting.problem.noise import median_deviation, shared_rounding_variance
from phongfit.fitting.problem.problem import Evaluation, Problem
from phongfit.fitting.problem.unknowns import Unknowns
from phongfit.fitting.solve.sums import (
    Linearization,
    in_double,
    linearize,
    linearized,
)
from phongfit.fitting.uncertainty.identifiability import find_unidentified
from phongfit.fitting.uncertainty.intervals import Quadratic
from phongfit.fitting.uncertainty.sandwich import (
    Sandwich,
    as_quadratic,
    inverse_of,
    unit_diagonal,
)
from phongfit.fitting.uncertainty.scores import (
    independent_variance,
    shared_rounding,
)
from phongfit.programs import program

# Residuals up to this many times the arithmetic floor count as rounding.
ROUNDED = 2


@dataclasses.dataclass(frozen=True)
class Statistics:
    """Uncertainty of a solution in the solver's units.

    `covariance` is that of the free and identifiable unknowns, with those at a bound
    held there: these have NaN, and unidentified ones infinite variance. `spread` is the
    standard error from the curvature of the cost alone. Intervals are computed from
    `sandwich`: see [`as_quadratic`][].
    """

    sandwich: Sandwich
    covariance: np.ndarray
    spread: np.ndarray
    unidentified: np.ndarray
    at_bound: np.ndarray
    chi_squared: float
    reasons: tuple[str, ...]
    nuisance: np.ndarray

    @property
    def stderr(self) -> np.ndarray:
        """Standard errors of the free unknowns.

        Infinite where rounding of barely identified directions makes a variance
        negative.
        """
        variance = np.diag(self.covariance)
        return np.sqrt(np.where(variance < 0, np.inf, variance))

    @property
    def scale(self) -> float:
        """Factor from the increase of the cost to Δχ², from the variances."""
        chosen = np.isfinite(self.stderr) & ~self.nuisance
        ratios = (self.spread / self.stderr)[chosen] ** 2
        return float(np.mean(ratios)) if len(ratios) else 1.0


def statistics(
    problem: Problem,
    y: Float[Array, " n"],
    inflation: float,
    sums: "SandwichSums | None" = None,
) -> Statistics:
    """Sandwich covariance of a bounded fit, its free part, and what is unidentified.

    **Arguments:**

    - `problem`, `y`: the problem, and its solution.
    - `inflation`: factor on all variances for residuals that are not independent.
    - `sums`: sums over the samples, if they are known already.
    """
    found = in_numpy(sandwich_sums(problem, y) if sums is None else sums)
    sandwich = sandwich_at(problem, y, inflation, found)
    position = np.asarray(y)
    unknowns = problem.unknowns
    at_bound = (position <= np.asarray(unknowns.lower)) | (
        position >= np.asarray(unknowns.upper)
    )
    unidentified, reasons = find_unidentified(
        sandwich.inside, unknowns, position, sandwich.resolution
    )
    if unidentified[~unknowns.y_nuisance].all() and _all_white(problem):
        words = "nothing is identifiable: all samples that are used are white"
        reasons = (coded("all-white", words),)
    at_bound &= ~unidentified

    size = len(position)
    covariance, spread = np.full((size, size), np.nan), np.full(size, np.nan)
    free = ~at_bound
    part = sandwich.part(free)
    inverse = inverse_of(part.bread, part.resolution)
    covariance[np.ix_(free, free)] = inverse @ part.meat @ inverse
    spread[free] = np.sqrt(np.diag(inverse))
    covariance[unidentified, :] = covariance[:, unidentified] = np.nan
    covariance[unidentified, unidentified] = np.inf
    chi_squared = float(found.chi_squared)
    return Statistics(
        sandwich,
        covariance,
        spread,
        unidentified,
        at_bound,
        chi_squared,
        reasons,
        unknowns.y_nuisance,
    )


def _all_white(problem: Problem) -> bool:
    used = np.asarray(problem.samples.weight) > 0
    return problem.clamp and bool(np.all(np.asarray(problem.samples.target)[used] >= 1))


def sandwich_at(
    problem: Problem, y: Float[Array, " n"], inflation: float, sums: Any
) -> Sandwich:
    """The sandwich at a point, with sums in double precision if single is too coarse.

    **Arguments:** `sums`: those of [`sandwich_sums`][], as NumPy's arrays.
    """
    resolution, found = float(np.finfo(y.dtype).eps), sums
    if found.exact:
        # Residuals are rounding of the arithmetic, which samples share.
        inflation = inflation * float(np.sum(np.asarray(problem.samples.weight) > 0))
    if _too_coarse(found.inside + found.known, resolution):
        found = in_numpy(sandwich_sums_in_double(problem, y))
    meat = found.meat
    if found.shared > 1e-6:
        meat = meat + found.loss_variance * shared_rounding(problem, y)
    # Priors of uncertain arrays come from a calibration: a lack of fit here does not
    # widen them.
    factor = np.where(problem.unknowns.y_nuisance, 1, inflation)
    meat = inflation * meat + factor * found.known
    inside = found.inside + found.known
    return Sandwich(found.bread, meat, found.pull, inside, resolution)


def quadratic_about(
    found: Statistics,
    unknowns: Unknowns,
    y: Float[np.ndarray, " n"],
    group: Int[np.ndarray, " k"],
) -> Quadratic:
    """The quadratic of some unknowns about the solution, in their box."""
    box = unknowns.lower, unknowns.upper
    lower, upper = (np.asarray(edge, float)[group] - y[group] for edge in box)
    return as_quadratic(found.sandwich.part(group), lower, upper)


def in_numpy(sums: "SandwichSums") -> Any:
    """Sums as NumPy arrays in double precision."""
    return jax.tree.map(lambda part: np.asarray(part, float), sums)


def _too_coarse(bread: np.ndarray, resolution: float) -> bool:
    """Whether the sums are too coarse to decide if a direction is identified."""
    if resolution < 1e-10 or not np.all(np.isfinite(bread)):
        return False
    heard = np.diag(bread) > 0
    values = np.linalg.eigvalsh(unit_diagonal(bread[np.ix_(heard, heard)])[0])
    return bool(np.any(values < 1e4 * resolution))


def sandwich_sums_in_double(problem: Problem, y: Float[Array, " n"]) -> "SandwichSums":
    """The sums at a solution, added up in double precision."""
    return in_double(_sandwich_sums, problem, linearized(problem, y))


class SandwichSums(eqx.Module):
    """Sums over the samples, from which all statistics are computed.

    `known` is the information of the priors; `bread` and `pull` include them.
    """

    bread: Float[Array, "n n"]
    meat: Float[Array, "n n"]
    inside: Float[Array, "n n"]
    known: Float[Array, "n n"]
    pull: Float[Array, " n"]
    drift: Float[Array, " n"]
    loss_variance: Float[Array, ""]
    shared: Float[Array, ""]
    chi_squared: Float[Array, ""]
    spread: Float[Array, ""]
    # Excess kurtosis of the residuals, in its standard deviations.
    tails: Float[Array, ""]
    exact: Bool[Array, ""]


@program()
def sandwich_sums(problem: Problem, y: Float[Array, " n"]) -> SandwichSums:
    """The sums at a solution."""
    return _sandwich_sums(problem, linearize(problem, y))


@program()
def _sandwich_sums(problem: Problem, found: Linearization) -> SandwichSums:
    at, priors, jacobian = found.at, found.priors, found.jacobian
    samples = at.residual
    kind = samples.dtype
    used = problem.samples.weight > 0
    count = jnp.maximum(jnp.sum(used), 1).astype(kind)

    score, slope = problem.loss.score(samples)
    variance, steepness = jnp.ones((), kind), jnp.ones((), kind)
    if problem.loss.robust:
        # A robust loss: the variance of its score, and its mean slope.
        variance = jnp.sum(jnp.where(used, score**2, 0)) / count
        steepness = jnp.sum(jnp.where(used, slope, 0)) / count
    independent, shared = independent_variance(problem, at), jnp.zeros((), kind)
    step = problem.samples.step
    if step is not None:
        common = shared_rounding_variance(step, at.noise)
        shared = jnp.max(common / at.deviation**2)
    squares = jnp.sum(samples**2)
    kurtosis = count * jnp.sum((samples * jax.lax.rsqrt(squares)) ** 4)
    known = jacobian.priors.T @ jacobian.priors
    # A white sample only shows that the light is at least white, so it identifies
    # nothing.
    below_white = (problem.samples.target < 1).astype(kind) if problem.clamp else None
    bread, meat, inside = jacobian.grams(None, independent, below_white)
    meat = variance * meat
    if problem.scatter is not None:
        root = jnp.sqrt(jnp.diag(bread))
        meat, shared = problem.scatter * jnp.outer(root, root), jnp.zeros((), kind)
        # The slope of a robust loss may differ where the noise does.
        bread, steepness = jacobian.gram(slope), jnp.ones((), kind)
    return SandwichSums(
        bread=steepness * bread + known,
        meat=meat,
        inside=inside,
        known=known,
        pull=jacobian.pull(score) + jacobian.priors.T @ priors,
        drift=jacobian.pull(at.drift),
        loss_variance=variance,
        shared=shared,
        chi_squared=squares + jnp.sum(priors**2),
        spread=_spread(problem, at),
        tails=(kurtosis - 3) * jnp.sqrt(count / 24),
        exact=_is_exact(problem, at),
    )


def _spread(problem: Problem, at: Evaluation) -> Float[Array, ""]:
    """Size of the residuals in standard deviations: 1 if the noise level is right.

    For a robust loss it is a median, which ignores outliers.
    """
    used = problem.samples.weight > 0
    if problem.loss.robust:
        return median_deviation(at.residual, used & (at.variance_share > 0.5))
    expected = jnp.sum(jnp.where(used, at.variance_share, 0))
    return jnp.sqrt(jnp.sum(at.residual**2) / jnp.maximum(expected, 1))


def _is_exact(problem: Problem, at: Evaluation) -> Bool[Array, ""]:
    """Whether residuals are only rounding of the arithmetic."""
    exact = problem.sigma <= ROUNDED * at.floor
    return exact & (problem.samples.step is None)
