"""From a solution to a [`Fit`][]: images, diagnostics, and warnings in words."""

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from phongfit.fitting.estimate import estimates
from phongfit.fitting.leaves import EXPOSURE
from phongfit.fitting.misfit import Misfit, find_misfit
from phongfit.fitting.problem import Problem
from phongfit.fitting.result import Fit, as_materials
from phongfit.fitting.search import Found
from phongfit.fitting.statistics import Pieces
from phongfit.fitting.tiles import Tiles
from phongfit.rendering.film import Film
from phongfit.scene import Scene


# Samples from which a noise level is estimated well enough.
FEW = 50


class Shown(NamedTuple):
    """What a fit makes of an image, and what it leaves of it."""

    fitted: Float[Array, "height width 3"]
    residual: Float[Array, "height width 3"]
    tiles: Tiles


def summarize(
    found: Found,
    place: tuple[Array, Array],
    pieces: Pieces,
    *,
    film: Film,
    scenes: tuple[Scene, ...],
    photographs: list[np.ndarray],
    shown: list[Shown],
    side: int,
    single: bool,
    noise_given: bool,
    arrays: tuple[str, ...],
) -> Fit:
    """The result of a fit.

    **Arguments:**

    - `found`: the solution.
    - `place`: it in the user's units: see [`in_units`][].
    - `pieces`: sums over the samples there: see [`add_up`][].
    - `film`: the images'.
    - `photographs`: images (H, W, 3) as they were given.
    - `scenes`, `shown`: the scenes and images as fitted.
    - `side`: pixels along a tile of theirs.
    - `single`: whether one image was given, not a sequence.
    - `noise_given`: whether the noise level was known.
    - `arrays`: which arguments came as arrays.
    """
    problem, unknowns = found.problem, found.problem.unknowns
    # Meanwhile JAX is at work on the images and on the sums.
    weight = _typical_weight(problem)
    fitted = [np.asarray(one.fitted) for one in shown]
    residuals = [np.asarray(one.residual) for one in shown]
    misfit = find_misfit([one.tiles for one in shown], side)
    samples = sum(int(np.sum(one.tiles.neighbours.samples)) for one in shown)
    # Clipped samples say nothing of the noise.
    effective = round(sum(float(np.sum(one.tiles.variance)) for one in shown))
    told = estimates(problem, found.y, misfit.inflation, place, pieces)
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
        samples=samples,
        images=len(shown),
        degrees_of_freedom=max(effective + sum(unknowns.has_prior) - told.free, 0),
        chi_squared=told.chi_squared,
        misfit=misfit,
        loss=type(problem.loss).__name__,
        model=type(problem.samples.channels.pixels.terms.model).__name__,
        film=film_words(film),
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
            *_misfit_words(misfit, len(shown)),
            *([] if noise_given else _few_words(effective, samples)),
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


def _misfit_words(misfit: Misfit, images: int) -> tuple[str, ...]:
    correlation = misfit.neighbour_correlation
    if not misfit.significant and correlation <= 0.1:
        return ()
    widened = math.sqrt(misfit.inflation)
    shown = [f"neighbouring pixels correlate by {correlation:.2f}"]
    if misfit.significant:
        image = f" of image {misfit.image}" if images > 1 else ""
        shown = [
            f"summed {_SUMMED[misfit.along].format(side=misfit.side)} they exceed what "
            f"noise allows ({misfit.significance:.2g} σ), most near row {misfit.row}, "
            f"column {misfit.column}{image}",
            *(shown if correlation > 0.1 else []),
        ]
    return (
        f"residuals are not noise: {'; '.join(shown)}. The model does not describe the "
        f"image fully; errors are widened {widened:.1f} times, which "
        "covers no bias. Look at plot_residuals(); mask what does not belong, try "
        "another specular model, or make what may be wrong unknown",
    )


def _few_words(effective: int, samples: int) -> tuple[str, ...]:
    if effective >= min(FEW, samples / 2):
        return ()
    return (
        f"{samples - effective:,} of {samples:,} samples are clipped: the noise, and "
        "with it all errors, is estimated from the few others. Give noise=, or expose "
        "less",
    )


_SUMMED = {
    "blocks": "over blocks of {side} × {side} pixels",
    "diffuse": "where diffuse light is equal",
    "highlight": "where the highlight is equal",
}


def _with_noise_warning(fit: Fit) -> Fit:
    if not fit.noise_given or fit.reduced_chi_squared <= 1.5:
        return fit
    words = (
        f"residuals are {np.sqrt(fit.reduced_chi_squared):.1f} times as large as the "
        "noise that was given: the noise or the model is wrong, errors are too small"
    )
    return dataclasses.replace(fit, warnings=(*fit.warnings, words))


def film_words(film: Film) -> str:
    """What of a film a fit rests on."""
    rounded = "not rounded" if film.bits is None else f"{film.bits}-bit {film.encoding}"
    return f"{'clamped' if film.clamp else 'not clamped'}, {rounded}"
