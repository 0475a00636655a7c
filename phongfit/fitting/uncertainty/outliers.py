"""Samples far from the model, and the bias that they cause.

Standard errors are due to noise alone. Objects that are not in the model, such as dust
or a passer-by, bias least squares, and any loss that does not reject them.

??? cite "Source"
    Belsley, Kuh and Welsch, *Regression diagnostics*, 1980, chapter 2: what a fit would
    be with some samples left out, to first order.
"""

from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from phongfit.codes import coded
from phongfit.fitting.problem.noise import median_deviation
from phongfit.fitting.problem.problem import Problem
from phongfit.fitting.solve.sums import Linearization, linearize
from phongfit.fitting.uncertainty.rejected import gathered_at_highlights
from phongfit.fitting.uncertainty.statistics import SandwichSums
from phongfit.programs import program

# Standard deviations: less than one of a million samples of normal noise lies beyond.
FAR = 5.0
# Standard errors: a smaller bias is covered by the error.
FELT = 1.0
# Iterations of the weights for least absolute deviations.
ROUNDS = 12
# Significance of the kurtosis, in its standard deviations for normal noise.
HEAVY = 5.0


class _Far(eqx.Module):
    """Samples far from the model, their gradient, and the curvature of the others."""

    which: Bool[Array, "3 samples"]
    used: Int[Array, ""]
    pull: Float[Array, " n"]
    others: Float[Array, "n n"]


def outlier_words(
    problem: Problem, y: Float[Array, " n"], sums: SandwichSums
) -> Iterator[str]:
    """A warning, if samples that are far off move an estimate by its standard error.

    **Arguments:**

    - `y`: the solution.
    - `sums`: sums over the samples there: see [`sandwich_sums`][].
    """
    heavy = float(sums.tails) > HEAVY and not bool(sums.exact)
    if not problem.loss.robust and not heavy:
        return
    far, unknowns = _far(problem, y), problem.unknowns
    position = np.asarray(y)
    free = (np.asarray(unknowns.lower) < position) & (
        position < np.asarray(unknowns.upper)
    )
    shifts = np.where(free, _shifts(far, sums, free), 0)
    most = int(np.argmax(shifts))
    # A highlight of another shape than the model's is not an outlier.
    if shifts[most] < FELT or gathered_at_highlights(problem, y, far.which).any():
        return
    count = int(jnp.sum(far.which))
    share = 100 * count / int(far.used)
    other = '"tukey"' if problem.loss.robust else '"cauchy" or "tukey"'
    yield coded(
        "outliers",
        f"outliers: {count} samples ({share:.2g} %) lie more than {FAR:g} standard "
        "deviations off the model and bias the estimates, "
        f"{unknowns.free_labels[most]} by {shifts[most]:.1f} of its standard "
        "errors",
        f"Leave them out by a mask, or try loss={other}",
    )


def _shifts(far: _Far, sums: SandwichSums, free: np.ndarray) -> np.ndarray:
    """Bias of each free unknown, in standard errors; 0 for the others."""
    both = np.ix_(free, free)
    bread, meat, others = (
        np.asarray(part, float)[both] for part in (sums.bread, sums.meat, far.others)
    )
    inverse = np.linalg.pinv(bread, hermitian=True)
    variance = np.diag(inverse @ meat @ inverse)
    shift = np.linalg.pinv(others, hermitian=True) @ np.asarray(far.pull, float)[free]
    shifts = np.zeros(len(free))
    shifts[free] = np.abs(shift) / np.sqrt(np.where(variance > 0, variance, np.inf))
    return shifts


@program()
def _far(problem: Problem, y: Float[Array, " n"]) -> _Far:
    found = linearize(problem, y)
    jacobian, used = found.jacobian, problem.samples.weight > 0
    left, scale = found.at.residual, jnp.ones((), y.dtype)
    if not problem.loss.robust:
        # Least squares follow outliers, which then have small residuals.
        left = _absolute_deviations(problem, y, found)
        scale = median_deviation(left, problem.unclipped())
    far = used & (jnp.abs(left) > FAR * scale)
    score, slope = problem.loss.score(found.at.residual)
    others = jacobian.gram(jnp.where(far, 0, slope))
    return _Far(
        far,
        jnp.sum(used),
        jacobian.pull(jnp.where(far, score, 0)),
        others + jacobian.priors.T @ jacobian.priors,
    )


def _absolute_deviations(
    problem: Problem, y: Float[Array, " n"], found: Linearization
) -> Float[Array, "3 samples"]:
    """Residuals of a fit by least absolute deviations, to first order about y.

    By iteratively reweighted least squares.
    """
    unknowns, jacobian, priors = problem.unknowns, found.jacobian, found.jacobian.priors
    free = (unknowns.lower < y) & (y < unknowns.upper)
    chosen, identity = problem.unclipped(), jnp.eye(len(y), dtype=y.dtype)

    def again(step: Array, _: None) -> tuple[Array, None]:
        left = found.at.residual + jacobian.change(step)
        weight = 1 / jnp.hypot(left, median_deviation(left, chosen))
        pull = jacobian.pull(weight * left) + priors.T @ (found.priors + priors @ step)
        curvature = jacobian.gram(weight) + priors.T @ priors
        scale = jnp.sqrt(jnp.where(free, jnp.diag(curvature), 0))
        scale = jnp.where(scale > 0, scale, 1)
        known = free & (jnp.diag(curvature) > 0)
        both = known[:, None] & free[None, :]
        matrix = jnp.where(both, curvature / jnp.outer(scale, scale), 0)
        # Unknowns without influence are held, and degenerate ones hardly move.
        matrix = jnp.where(both | ~identity.astype(bool), matrix, 1) + 1e-5 * identity
        more = jnp.linalg.solve(matrix, jnp.where(free, pull / scale, 0)) / scale
        return step - more, None

    step, _ = jax.lax.scan(again, jnp.zeros_like(y), length=ROUNDS)
    return found.at.residual + jacobian.change(step)
