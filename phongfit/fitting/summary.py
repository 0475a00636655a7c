"""From a solution to a [`Fit`][]: the user's units, and warnings in words."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from phongfit.fitting.diagnostics import neighbour_correlation, variance_inflation
from phongfit.fitting.problem import Evaluation, Problem, evaluate, linearize
from phongfit.fitting.result import Fit
from phongfit.fitting.search import Found
from phongfit.fitting.statistics import Statistics, statistics
from phongfit.fitting.unknowns import Unknowns
from phongfit.material import Material
from phongfit.rendering.film import Film


def summarize(
    found: Found,
    *,
    film: Film,
    fitted: list[np.ndarray],
    residuals: list[np.ndarray],
    used: list[np.ndarray],
    single: bool,
    noise_given: bool,
) -> Fit:
    """The result of a fit.

    **Arguments:**

    - `found`: the solution.
    - `film`: the images'.
    - `fitted`, `residuals`, `used`: images (H, W, 3), and which samples took part.
    - `single`: whether one image was given, not a sequence.
    - `noise_given`: whether the noise level was known.
    """
    problem, unknowns = found.problem, found.problem.unknowns
    y = np.asarray(found.y)
    at = evaluate(problem, found.y)
    correlation = _misfit(problem, residuals, used)
    inflation = variance_inflation(correlation)
    uncertainty = statistics(problem, found.y, at, inflation)
    untold, reasons = _beyond_sense(problem, y, uncertainty)
    at_bound = uncertainty.at_bound & ~untold
    values = np.clip(unknowns.values(y.astype(float)), *unknowns.bounds.T)
    # d f / d log f = f.
    scale = np.where(unknowns.logarithmic, values, 1.0)
    errors = np.where(untold, np.inf, uncertainty.stderr * scale)
    covariance = uncertainty.covariance * np.outer(scale, scale)
    covariance[untold, :] = covariance[:, untold] = np.nan
    covariance[untold, untold] = np.inf
    labels = np.array(unknowns.labels)
    result = Fit(
        material=unknowns.with_leaves(values.astype(y.dtype)),
        stderr=_errors_as_material(unknowns, errors.astype(y.dtype)),
        labels=unknowns.labels,
        values=values,
        errors=errors,
        covariance=covariance,
        at_bound=at_bound,
        untold=untold,
        bounds=unknowns.bounds,
        fitted=fitted[0] if single else tuple(fitted),
        residuals=residuals[0] if single else tuple(residuals),
        noise=_typical_noise(problem, at),
        noise_given=noise_given,
        samples=int(sum(mask.sum() for mask in used)),
        images=len(used),
        chi_squared=float(np.sum(np.asarray(at.residual, float) ** 2)),
        neighbour_correlation=correlation,
        loss=type(problem.loss).__name__,
        model=type(problem.samples.pixels.terms.model).__name__,
        film=_film_words(film),
        converged=found.converged,
        steps=found.steps,
        reason=_CONVERGED if found.converged else _STOPPED,
        warnings=(
            *(() if found.converged else ("the solver did not converge",)),
            *reasons,
            *(
                f"{label} lies at its bound: its error is one-sided"
                for label in labels[at_bound]
            ),
            *_misfit_words(correlation, inflation),
        ),
    )
    return _with_noise_warning(result)


_CONVERGED = "steps and changes of the residuals fell below the tolerance"
_STOPPED = "the limit of steps was reached, or the numbers left the finite"


def _typical_noise(problem: Problem, at: Evaluation) -> float:
    used = np.asarray(problem.samples.weight) > 0
    return float(np.median(np.asarray(at.noise)[used]))


def _misfit(
    problem: Problem, residuals: list[np.ndarray], used: list[np.ndarray]
) -> float:
    """Correlation of neighbouring residuals, where these are more than rounding."""
    total = sum(float(np.sum(r.astype(float) ** 2)) for r in residuals)
    count = sum(int(m.sum()) for m in used)
    step = np.asarray(problem.samples.step)[np.asarray(problem.samples.weight) > 0]
    resolution = float(np.finfo(step.dtype).eps)
    rounding = float((step.astype(float) ** 2).mean()) / 12
    if total / count <= 2 * rounding + (64 * resolution) ** 2:
        return 0.0
    return neighbour_correlation(residuals, used)


def _misfit_words(correlation: float, inflation: float) -> tuple[str, ...]:
    if correlation <= 0.1:
        return ()
    return (
        f"residuals are not noise: neighbouring pixels correlate by {correlation:.2f}. "
        "The model does not describe the image fully; errors are widened "
        f"{np.sqrt(inflation):.1f} times, and cannot tell a bias",
    )


def _with_noise_warning(fit: Fit) -> Fit:
    if not fit.noise_given or fit.reduced_chi_squared <= 1.5:
        return fit
    words = (
        f"residuals are {np.sqrt(fit.reduced_chi_squared):.1f} times as large as the "
        "noise that was given: the noise or the model is wrong, errors are too small"
    )
    return dataclasses.replace(fit, warnings=(*fit.warnings, words))


def _film_words(film: Film) -> str:
    rounded = "not rounded" if film.bits is None else f"{film.bits}-bit {film.encoding}"
    return f"{'clamped' if film.clamp else 'not clamped'}, {rounded}"


def _errors_as_material(unknowns: Unknowns, errors: np.ndarray) -> Material:
    """Errors as a material; what was known has none."""
    none = Material(0.0, 0.0, 0.0, 0.0, 0.0)
    return dataclasses.replace(unknowns, known=none).with_leaves(errors)


def _beyond_sense(
    problem: Problem, y: np.ndarray, uncertainty: Statistics
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Unknowns whose error, though finite, says that nothing is known."""
    unknowns = problem.unknowns
    untold = uncertainty.untold.copy()
    reasons = [*uncertainty.reasons]
    labels = np.array(unknowns.labels)
    width = np.asarray(unknowns.upper) - np.asarray(unknowns.lower)
    kinds, owners = unknowns.kinds, unknowns.owners
    with np.errstate(invalid="ignore"):
        vague = ~untold & (uncertainty.stderr > width)
        dark = (kinds == "specular") & (y < 3 * uncertainty.stderr)
    for label in labels[vague]:
        reasons.append(f"{label} cannot be told: its error is wider than its bounds")
    untold |= vague
    for owner in np.unique(owners[kinds == "specular"]):
        if dark[(kinds == "specular") & (owners == owner)].all():
            unseen = (kinds == "shininess") & (owners == owner) & ~untold
            for label in labels[unseen]:
                reasons.append(
                    f"{label} cannot be told: specular is 0 within its error"
                )
            untold |= unseen
    for entry in np.flatnonzero((kinds == "specular") & ~untold):
        exponents = (kinds == "shininess") & (owners == owners[entry])
        if exponents.any() and untold[exponents].all():
            if not _told_for_all_exponents(problem, y, int(entry), exponents):
                words = "some exponents would hide the highlight where no pixel is used"
                reasons.append(f"{labels[entry]} cannot be told: {words}")
                untold[entry] = True
    return untold, tuple(reasons)


def _told_for_all_exponents(
    problem: Problem, y: np.ndarray, entry: int, exponents: np.ndarray
) -> bool:
    """Whether a reflectance is told whatever the exponent, which is not, may be."""
    lower, upper = (
        np.asarray(edge) for edge in (problem.unknowns.lower, problem.unknowns.upper)
    )
    for share in np.linspace(0, 1, 7):
        there = np.where(exponents, lower + share * (upper - lower), y)
        slope = np.asarray(linearize(problem, jnp.asarray(there, y.dtype))[0])[entry]
        # In standard deviations, and the other unknowns only add to it.
        if 1 / (np.sqrt(np.sum(slope.astype(float) ** 2)) + 1e-30) > (
            upper[entry] - lower[entry]
        ):
            return False
    return True
