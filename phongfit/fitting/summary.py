"""From a solution to a [`Fit`][]: images, diagnostics, and warnings in words."""

import dataclasses

import numpy as np

from phongfit.fitting.diagnostics import neighbour_correlation, variance_inflation
from phongfit.fitting.estimate import estimates
from phongfit.fitting.problem import Problem
from phongfit.fitting.result import Fit, errors_as_material
from phongfit.fitting.search import Found
from phongfit.fitting.unknowns import in_units
from phongfit.rendering.film import Film
from phongfit.scene import Scene


def summarize(
    found: Found,
    *,
    film: Film,
    scenes: tuple[Scene, ...],
    photographs: list[np.ndarray],
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
    - `scenes`, `photographs`, `fitted`, `residuals`, `used`: the scenes as fitted,
        images (H, W, 3), and which samples took part.
    - `single`: whether one image was given, not a sequence.
    - `noise_given`: whether the noise level was known.
    """
    problem, unknowns = found.problem, found.problem.unknowns
    correlation = _misfit(problem, residuals, used)
    inflation = variance_inflation(correlation)
    told = estimates(problem, found.y, inflation)
    entries = np.array(in_units(unknowns, found.y)[0])
    exposure = np.array(unknowns.exposures(entries))
    entries[unknowns.reported] = told.values
    errors = np.zeros(len(entries))
    errors[unknowns.reported] = told.errors
    samples = int(sum(mask.sum() for mask in used))
    labels = np.array(unknowns.labels)
    result = Fit(
        material=unknowns.with_leaves(entries),
        stderr=errors_as_material(unknowns, errors),
        scene=scenes[0] if single else scenes,
        exposure=exposure,
        labels=unknowns.labels,
        values=told.values,
        errors=told.errors,
        covariance=told.covariance,
        at_bound=told.at_bound,
        untold=told.untold,
        bounds=unknowns.bounds,
        tied=unknowns.tied,
        photographs=photographs[0] if single else tuple(photographs),
        fitted=fitted[0] if single else tuple(fitted),
        residuals=residuals[0] if single else tuple(residuals),
        noise=_typical_noise(problem),
        noise_given=noise_given,
        samples=samples,
        images=len(used),
        degrees_of_freedom=samples + sum(unknowns.has_prior) - told.free,
        chi_squared=told.chi_squared,
        neighbour_correlation=correlation,
        loss=type(problem.loss).__name__,
        model=type(problem.samples.channels.pixels.terms.model).__name__,
        film=_film_words(film),
        converged=found.converged,
        steps=found.steps,
        reason=_CONVERGED if found.converged else _STOPPED,
        warnings=(
            *(() if found.converged else ("the solver did not converge",)),
            *told.reasons,
            *(
                f"{label} lies at its bound: its error is one-sided"
                for label in labels[told.at_bound]
            ),
            *_misfit_words(correlation, inflation),
        ),
        found=found,
    )
    return _with_noise_warning(result)


_CONVERGED = "steps and changes of the residuals fell below the tolerance"
_STOPPED = "the limit of steps was reached, or the numbers left the finite"


def _typical_noise(problem: Problem) -> float:
    """Median standard deviation of the samples, before rounding."""
    weight = np.asarray(problem.samples.weight)
    weight = weight[weight > 0]
    # Mostly they are all alike, and a median takes long.
    alike = weight.min() == weight.max()
    typical = weight[0] if alike else np.median(weight)
    return float(problem.sigma) / float(np.sqrt(typical))


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
