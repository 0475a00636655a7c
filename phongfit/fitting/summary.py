"""Describe the solution of a fit as a [`Fit`][]: images, errors, warnings."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from phongfit.codes import coded
from phongfit.fitting.problem.losses import AbstractLoss
from phongfit.fitting.problem.noise import find_plateau
from phongfit.fitting.problem.posing import FitData
from phongfit.fitting.problem.problem import Problem
from phongfit.fitting.problem.unknowns import Unknowns, in_units
from phongfit.fitting.result import Fit, as_materials
from phongfit.fitting.solve.minimum import Minimum
from phongfit.fitting.uncertainty.estimate import estimates
from phongfit.fitting.uncertainty.grid import grid_significance
from phongfit.fitting.uncertainty.misfit import CORRELATED, Misfit, find_misfit
from phongfit.fitting.uncertainty.outliers import outlier_words
from phongfit.fitting.uncertainty.rejected import rejected_highlights, without_rejected
from phongfit.fitting.uncertainty.scores import with_noise_as_found
from phongfit.fitting.uncertainty.statistics import SandwichSums, sandwich_sums
from phongfit.fitting.uncertainty.tiles import Measured, Tiles, sum_over_tiles
from phongfit.fitting.uncertainty.warnings import (
    bound_words,
    clipped_words,
    coarse_words,
    grid_words,
    misfit_words,
    plateau_words,
    prior_words,
    rival_words,
    spread_words,
)
from phongfit.programs import program
from phongfit.rendering.pixels import PixelTerms, pixel_terms, resolve_terms
from phongfit.scene import Scene

# Fraction by which χ² must exceed its expectation for the given noise to warn.
LEAST_EXCESS = 0.1


def describe(data: FitData, minimum: Minimum) -> Fit:
    """The result of a fit: values with errors, images, diagnostics and warnings."""
    found, noise_given = minimum.found, data.noise_given
    problem, unknowns, y = found.problem, found.problem.unknowns, found.y
    # JAX dispatches these asynchronously, until a value is read.
    in_user_units = in_units(unknowns, y)
    scenes = tuple(source.scene for source in minimum.sources)
    scenes = unknowns.scenes(in_user_units[0], scenes)
    dispatched = [
        _fitted_image(data, minimum, k, scene, in_user_units[0])
        for k, scene in enumerate(scenes)
    ]
    sums = sandwich_sums(problem, y)
    weight = _typical_weight(problem)
    # As NumPy arrays, which are summed ten times as fast as JAX's.
    images = [jax.tree.map(np.asarray, one) for one in dispatched]
    fitted, residuals, tiles = zip(*images, strict=True)
    misfit = find_misfit(tiles, data.side, minimum.drawn)
    blocks = 0.0 if minimum.drawn else grid_significance([t.grid for t in tiles])
    if bool(sums.exact) and not noise_given:
        # Residuals are rounding of the arithmetic, so they cannot show a lack of fit.
        misfit, blocks = Misfit(), 0.0
    samples = round(sum(float(np.sum(one.count, dtype=float)) for one in tiles))
    # Clipped samples do not show the noise, so they do not count.
    effective = round(sum(float(np.sum(one.variance, dtype=float)) for one in tiles))
    spread = _spread(sums, effective, noise_given)
    if not problem.loss.robust:
        # The covariance of a robust loss is computed from the residuals already.
        misfit = dataclasses.replace(misfit, inflation=misfit.inflation * spread**2)
    # A lack of fit also correlates the channels, but it widens the errors already.
    alike = misfit.channel_correlation > CORRELATED and not misfit.significant
    if (alike or misfit.noise_differs) and problem.scatter is None:
        problem = with_noise_as_found(problem, y)
        found = dataclasses.replace(found, problem=problem)
        sums = sandwich_sums(problem, y)
    estimated = estimates(problem, y, misfit.inflation, in_user_units, sums)
    rejected = rejected_highlights(problem, y)
    estimated = without_rejected(estimated, unknowns, rejected)
    entries = np.array(in_user_units[0])
    exposure = np.array(unknowns.exposures(entries))
    entries[unknowns.reported] = estimated.values
    errors = np.zeros_like(entries)
    errors[unknowns.reported] = estimated.errors
    material, stderr = as_materials(unknowns, entries, errors)
    converged = bool(found.converged)
    # No warning about the noise is due in these cases.
    noise_is_irrelevant = noise_given or estimated.unidentified.all()

    def given(every: Sequence[Any]) -> Any:
        return every[0] if data.single else tuple(every)

    return Fit(
        specification=data.specification,
        films=data.films,
        material=material,
        stderr=stderr,
        scene=given(scenes),
        exposure=exposure,
        labels=unknowns.labels,
        values=estimated.values,
        errors=estimated.errors,
        covariance=estimated.covariance,
        at_bound=estimated.at_bound,
        unidentified=estimated.unidentified,
        bounds=unknowns.bounds.copy(),
        tied=unknowns.tied.copy(),
        photographs=given(data.photographs),
        fitted=given(fitted),
        residuals=given(residuals),
        noise=float(problem.sigma) / math.sqrt(weight),
        noise_given=noise_given,
        arrays=data.arrays,
        n_samples=samples,
        n_images=len(images),
        degrees_of_freedom=max(effective + unknowns.n_priors - estimated.free, 0),
        chi_squared=estimated.chi_squared,
        misfit=misfit,
        model=type(problem.samples.channels.pixels.terms.model).__name__,
        converged=converged,
        steps=int(found.steps),
        reason=_CONVERGED if converged else _STOPPED,
        warnings=(
            *(() if converged else (coded("not-converged", f"{_UNDONE}: {_STOPPED}"),)),
            *estimated.reasons,
            *minimum.at_edges,
            *plateau_words(
                find_plateau([one.used() for one in data.sources]), data.films[0]
            ),
            *bound_words(estimated, unknowns),
            *prior_words(estimated, unknowns, misfit.inflation),
            *rival_words(estimated, unknowns, found.rival, misfit.inflation),
            # If all samples are white, a lack of fit cannot be judged.
            *(misfit_words(misfit, len(images)) if np.any(sums.inside) else ()),
            *grid_words(blocks),
            *coarse_words(data.films),
            *spread_words(spread),
            *([] if noise_is_irrelevant else clipped_words(sums, effective, samples)),
            # A deviation that neighbours share is a lack of fit, not outliers.
            *(() if _is_shared(misfit) else outlier_words(problem, y, sums)),
        ),
        region=estimated.region,
        solution=found,
    )


def _fitted_image(
    data: FitData, minimum: Minimum, which: int, scene: Scene, entries: Array
) -> tuple[Array, Array, Tiles]:
    """Fitted image and residuals of one image, and sums over its tiles."""
    source, problem = minimum.sources[which], minimum.found.problem
    mask, view = source.mask, source.pixels
    if source.gbuffer is not None:
        # As the solver has it: shadows of lights that are only uncertain stay.
        view = pixel_terms(scene, source.gbuffer)
    elif problem.unknowns.of_scene:
        mask, view = resolve_terms(scene)
    step = None if source.step is None else jnp.asarray(source.step)
    return _expose(
        Measured(source.image, source.weight, step, problem.sigma),
        mask,
        view,
        problem.unknowns,
        entries,
        np.int32(which),
        scene.background,
        problem.loss,
        data.films[which].clamp,
        data.side,
    )


@program("clamp", "side")
def _expose(
    measured: Measured,
    mask: Array,
    view: PixelTerms,
    unknowns: Unknowns,
    entries: Array,
    which: np.int32 | Int[Array, ""],
    background: Array,
    loss: AbstractLoss,
    clamp: bool,
    side: int,
) -> tuple[Array, Array, Tiles]:
    material = unknowns.as_material(entries)
    exposure = unknowns.exposures(entries)[which]
    light = view.radiance(material) * exposure
    basis = view.basis(material.shininess)
    shapes = basis[..., 1], basis[..., 2]
    tiles = sum_over_tiles(measured, light, *shapes, loss, clamp, side)
    light = jnp.clip(light, 0, 1) if clamp else light
    fitted = jnp.where(mask[..., None], light, background[None, None])
    residual = jnp.where(measured.weight > 0, measured.image - fitted, 0)
    return fitted, residual, tiles


_CONVERGED = "steps and changes of the residuals fell below the tolerance"
_UNDONE = "the solver did not converge"
_STOPPED = "the limit of steps was reached, or the numbers left the finite"


def _is_shared(misfit: Misfit) -> bool:
    return misfit.significant and misfit.neighbour_correlation > CORRELATED


def _typical_weight(problem: Problem) -> float:
    """Median weight of the used samples."""
    weight = np.asarray(problem.samples.weight)
    typical = weight.max()
    # Mostly all weights are equal, and a median takes long.
    if np.count_nonzero(weight == typical) < np.count_nonzero(weight > 0):
        typical = np.median(weight[weight > 0])
    return float(typical)


def _spread(sums: SandwichSums, effective: int, noise_given: bool) -> float:
    """Ratio of the residuals to the given noise; 1 if that is within chance."""
    spread = float(sums.spread)
    beyond = max(LEAST_EXCESS, 5 * math.sqrt(2 / max(effective, 1)))
    return spread if noise_given and spread**2 > 1 + beyond else 1.0
