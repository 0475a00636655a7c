"""Make a [`Fit`][] from a solution: images, diagnostics, and warnings."""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from phongfit.codes import coded
from phongfit.fitting.problem.noise import Plateau
from phongfit.fitting.problem.parameters import EXPOSURE
from phongfit.fitting.problem.problem import Problem
from phongfit.fitting.problem.specification import Specification
from phongfit.fitting.result import Fit, as_materials
from phongfit.fitting.solve.jpeg import Drawn
from phongfit.fitting.solve.search import Rival, SearchResult
from phongfit.fitting.uncertainty.estimate import estimates
from phongfit.fitting.uncertainty.grid import grid_significance
from phongfit.fitting.uncertainty.misfit import (
    CORRELATED,
    Misfit,
    find_misfit,
)
from phongfit.fitting.uncertainty.outliers import outlier_words
from phongfit.fitting.uncertainty.rejected import rejected_highlights, without_rejected
from phongfit.fitting.uncertainty.scores import with_noise_as_found
from phongfit.fitting.uncertainty.statistics import SandwichSums, sandwich_sums
from phongfit.fitting.uncertainty.tiles import Tiles
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
from phongfit.rendering.film import Film
from phongfit.scene import Scene

# Fraction by which χ² must exceed its expectation for the given noise to warn.
LEAST_EXCESS = 0.1


class FittedImage(NamedTuple):
    """A fitted image, its residuals, and their sums over tiles."""

    fitted: Float[Array, "height width 3"]
    residual: Float[Array, "height width 3"]
    tiles: Tiles


def summarize(
    found: SearchResult,
    in_user_units: tuple[Array, Array],
    sums: SandwichSums,
    *,
    specification: Specification,
    films: tuple[Film, ...],
    scenes: tuple[Scene, ...],
    photographs: list[np.ndarray],
    images: list[FittedImage],
    side: int,
    single: bool,
    noise_given: bool,
    arrays: tuple[str, ...],
    at_edges: tuple[str, ...],
    plateau: Plateau | None,
    drawn: Sequence[Drawn] | None = None,
    rival: Rival | None = None,
) -> Fit:
    """The result of a fit.

    **Arguments:**

    - `found`: the solution.
    - `in_user_units`: the solution in the user's units: see [`in_units`][].
    - `sums`: sums over the samples at the solution: see [`sandwich_sums`][].
    - `specification`: the options of the fit.
    - `films`: the film of each image.
    - `photographs`: images (H, W, 3) as they were given.
    - `scenes`, `images`: the scenes and images as fitted.
    - `side`: pixels along the side of a tile.
    - `single`: whether one image was given, not a sequence.
    - `noise_given`: whether the noise level was given.
    - `arrays`: names of the arguments that were given as arrays.
    - `at_edges`: warnings about pixels at moving edges.
    - `plateau`: the value at which the images were cut off, if that is below white.
    - `drawn`: sums over tiles of simulated residuals: see [`find_misfit`][].
    - `rival`: another minimum at which the search ended.
    """
    problem, unknowns = found.problem, found.problem.unknowns
    # JAX computes the images and sums meanwhile.
    weight = _typical_weight(problem)
    fitted = [np.asarray(one.fitted) for one in images]
    residuals = [np.asarray(one.residual) for one in images]
    # As NumPy arrays, which are summed ten times as fast as JAX's.
    tiles = [jax.tree.map(np.asarray, one.tiles) for one in images]
    misfit = find_misfit(tiles, side, drawn)
    blocks = 0.0 if drawn else grid_significance([t.grid for t in tiles])
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
        correlation = misfit.channel_correlation if alike else 0.0
        problem = with_noise_as_found(
            problem, found.y, correlation, misfit.noise_differs
        )
        found = dataclasses.replace(found, problem=problem)
        sums = sandwich_sums(problem, found.y)
    estimated = estimates(problem, found.y, misfit.inflation, in_user_units, sums)
    rejected = rejected_highlights(problem, found.y)
    estimated = without_rejected(estimated, unknowns, rejected)
    entries = np.array(in_user_units[0])
    exposure = np.ones(len(images))
    if unknowns.exposed:
        exposure = np.array(unknowns.parts(entries)[EXPOSURE])
    entries[unknowns.reported] = estimated.values
    errors = np.zeros_like(entries)
    errors[unknowns.reported] = estimated.errors
    material, stderr = as_materials(unknowns, entries, errors)
    converged = bool(found.converged)
    # No warning about the noise is due in these cases.
    noise_is_irrelevant = noise_given or estimated.unidentified.all()
    return Fit(
        specification=specification,
        films=films,
        material=material,
        stderr=stderr,
        scene=scenes[0] if single else scenes,
        exposure=exposure.ravel(),
        labels=unknowns.labels,
        values=estimated.values,
        errors=estimated.errors,
        covariance=estimated.covariance,
        at_bound=estimated.at_bound,
        unidentified=estimated.unidentified,
        bounds=unknowns.bounds.copy(),
        tied=unknowns.tied.copy(),
        photographs=photographs[0] if single else tuple(photographs),
        fitted=fitted[0] if single else tuple(fitted),
        residuals=residuals[0] if single else tuple(residuals),
        noise=float(problem.sigma) / math.sqrt(weight),
        noise_given=noise_given,
        arrays=arrays,
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
            *at_edges,
            *plateau_words(plateau, films[0]),
            *bound_words(estimated, unknowns),
            *prior_words(estimated, unknowns, misfit.inflation),
            *rival_words(estimated, unknowns, rival, misfit.inflation),
            # If all samples are white, a lack of fit cannot be judged.
            *(misfit_words(misfit, len(images)) if np.any(sums.inside) else ()),
            *grid_words(blocks),
            *coarse_words(films),
            *spread_words(spread),
            *([] if noise_is_irrelevant else clipped_words(sums, effective, samples)),
            # A deviation that neighbours share is a lack of fit, not outliers.
            *(() if _is_shared(misfit) else outlier_words(problem, found.y, sums)),
        ),
        region=estimated.region,
        solution=found,
    )


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
