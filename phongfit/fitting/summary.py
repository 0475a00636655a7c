"""From a solution to a [`Fit`][]: images, diagnostics, and warnings in words."""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from phongfit.fitting.diagnostics import (
    Expected,
    Neighbours,
    all_neighbours,
    compare_neighbours,
    correlation_beyond,
    neighbour_correlation,
    variance_inflation,
)
from phongfit.fitting.estimate import estimates
from phongfit.fitting.leaves import EXPOSURE
from phongfit.fitting.problem import Problem
from phongfit.fitting.result import Fit, as_materials
from phongfit.fitting.search import Found
from phongfit.fitting.statistics import Pieces
from phongfit.rendering.film import Film
from phongfit.scene import Scene


class Shown(NamedTuple):
    """What a fit makes of an image, what it leaves of it, and what of it counts."""

    fitted: Float[Array, "height width 3"]
    residual: Float[Array, "height width 3"]
    weight: Float[Array, "height width channels"]


def summarize(
    found: Found,
    place: tuple[Array, Array],
    pieces: Pieces,
    *,
    films: tuple[Film, ...],
    scenes: tuple[Scene, ...],
    photographs: list[np.ndarray],
    shown: list[Shown],
    single: bool,
    noise_given: bool,
    arrays: tuple[str, ...],
    expected: Expected | None = None,
) -> Fit:
    """The result of a fit.

    **Arguments:**

    - `found`: the solution.
    - `place`: it in the user's units: see [`in_units`][].
    - `pieces`: sums over the samples there: see [`add_up`][].
    - `films`: of each image.
    - `photographs`: images (H, W, 3) as they were given.
    - `scenes`, `shown`: the scenes and images as fitted.
    - `single`: whether one image was given, not a sequence.
    - `noise_given`: whether the noise level was known.
    - `arrays`: which arguments came as arrays.
    - `expected`: how neighbours would correlate in the right model, if not at random.
    """
    problem, unknowns = found.problem, found.problem.unknowns
    # Meanwhile JAX is at work on the images and on the sums.
    weight = _typical_weight(problem)
    fitted = [np.asarray(one.fitted) for one in shown]
    residuals = [np.asarray(one.residual) for one in shown]
    used = [np.asarray(one.weight) > 0 for one in shown]
    neighbours = all_neighbours(map(compare_neighbours, residuals, used))
    if expected is None:
        correlation = _misfit(problem, neighbours)
    else:
        correlation = correlation_beyond(neighbours, expected)
    inflation = variance_inflation(correlation)
    told = estimates(problem, found.y, inflation, place, pieces)
    entries = np.array(place[0])
    exposure = np.ones(len(shown))
    if unknowns.exposed:
        exposure = np.array(unknowns.parts(entries)[EXPOSURE])
    entries[unknowns.reported] = told.values
    errors = np.zeros_like(entries)
    errors[unknowns.reported] = told.errors
    material, stderr = as_materials(unknowns, entries, errors)
    converged = bool(found.converged)
    labels = np.array(unknowns.labels)
    result = Fit(
        material=material,
        stderr=stderr,
        scene=scenes[0] if single else scenes,
        exposure=exposure.ravel(),
        labels=unknowns.labels,
        values=told.values,
        errors=told.errors,
        covariance=told.covariance,
        at_bound=told.at_bound,
        untold=told.untold,
        bounds=unknowns.bounds.copy(),
        tied=unknowns.tied.copy(),
        photographs=photographs[0] if single else tuple(photographs),
        fitted=fitted[0] if single else tuple(fitted),
        residuals=residuals[0] if single else tuple(residuals),
        noise=float(problem.sigma) / math.sqrt(weight),
        noise_given=noise_given,
        arrays=arrays,
        samples=neighbours.samples,
        images=len(shown),
        degrees_of_freedom=neighbours.samples + sum(unknowns.has_prior) - told.free,
        chi_squared=told.chi_squared,
        neighbour_correlation=correlation,
        loss=type(problem.loss).__name__,
        model=type(problem.samples.channels.pixels.terms.model).__name__,
        film=films_words(films),
        converged=converged,
        steps=int(found.steps),
        reason=_CONVERGED if converged else _STOPPED,
        warnings=(
            *(() if converged else ("the solver did not converge",)),
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


def _typical_weight(problem: Problem) -> float:
    """The median over the samples that are used."""
    weight = np.asarray(problem.samples.weight)
    typical = weight.max()
    # Mostly they are all alike, and a median takes long.
    if np.count_nonzero(weight == typical) < np.count_nonzero(weight > 0):
        typical = np.median(weight[weight > 0])
    return float(typical)


def _misfit(problem: Problem, neighbours: Neighbours) -> float:
    """Correlation of neighbouring residuals, where these are more than rounding."""
    rounding, resolution = 0.0, float(np.finfo(problem.sigma.dtype).eps)
    if problem.samples.step is not None:
        step = np.asarray(problem.samples.step, float)
        rounding = (step[np.asarray(problem.samples.weight) > 0] ** 2).mean() / 12
    variance = neighbours.squares / neighbours.samples
    if variance <= 2 * rounding + (64 * resolution) ** 2:
        return 0.0
    return neighbour_correlation(neighbours)


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


def films_words(films: Sequence[Film]) -> str:
    """What of the images' films a fit rests on."""
    return " / ".join(dict.fromkeys(map(film_words, films)))


def film_words(film: Film) -> str:
    """What of a film a fit rests on."""
    rounded = "not rounded" if film.bits is None else f"{film.bits}-bit {film.encoding}"
    kind = "" if film.jpeg is None else f" JPEG {film.jpeg.subsampling}".rstrip()
    return f"{'clamped' if film.clamp else 'not clamped'}, {rounded}{kind}"
