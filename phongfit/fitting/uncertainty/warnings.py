"""Warnings of a fit: what is wrong, how large it is, what to try."""

import math
from collections.abc import Iterable, Iterator

import numpy as np

from phongfit.codes import coded
from phongfit.fitting.problem.noise import Plateau
from phongfit.fitting.problem.parameters import REFLECTANCES
from phongfit.fitting.problem.unknowns import Unknowns
from phongfit.fitting.solve.search import Rival
from phongfit.fitting.uncertainty.estimate import Estimates
from phongfit.fitting.uncertainty.grid import SIDE, SIGNIFICANT
from phongfit.fitting.uncertainty.misfit import CORRELATED, Misfit
from phongfit.fitting.uncertainty.statistics import SandwichSums
from phongfit.rendering.film import Film, encode

# Number of samples that suffices to estimate a noise level.
FEW = 50
# Least fraction of the samples that must not be clipped for this.
FEW_SHARE = 0.1
# Largest change of a parameter by an error of the noise level, in standard errors.
MOVED = 0.25
# Standard deviations above which images contradict a prior or a bound.
CONTRADICTION = 4.0
# Difference of two minima's costs, in standard deviations, above which one is excluded;
# least distance between them in standard errors; most numbers in the warning.
SEPARATE, DISTANT, NAMED = 3.0, 5.0, 3


def misfit_words(misfit: Misfit, images: int) -> Iterator[str]:
    """Warning of residuals that are not noise."""
    correlation = misfit.neighbour_correlation
    if not misfit.significant and correlation <= CORRELATED:
        return
    widened = math.sqrt(misfit.inflation)
    shown = [f"neighbouring pixels correlate by {correlation:.2f}"]
    if misfit.significant:
        image = f" of image {misfit.image}" if images > 1 else ""
        shown = [
            f"summed {_SUMMED[misfit.along].format(side=misfit.side)} they exceed what "
            f"noise allows ({misfit.significance:.2g} σ), most near row {misfit.row}, "
            f"column {misfit.column}{image}",
            *(shown if correlation > CORRELATED else []),
        ]
    yield coded(
        "lack-of-fit",
        f"residuals are not noise: {'; '.join(shown)}. The model does not describe "
        f"the image fully; errors are widened {widened:.1f} times, which does not "
        "cover a bias",
    )


def plateau_words(plateau: Plateau | None, film: Film) -> Iterator[str]:
    """Warning of images that were cut off below white."""
    if plateau is None:
        return
    value = f"{plateau.value:.4g}"
    if film.bits is not None:
        highest = 2**film.bits - 1
        level = float(encode(np.float64(plateau.value), film.encoding)) * highest
        value += f" (the number {level:.0f} of {highest})"
    yield coded(
        "low-white",
        f"{plateau.n_samples:,} samples share the largest value, {value}, and few "
        "lie just below it: they are saturated, and white is not 1",
    )


def clipped_words(sums: SandwichSums, effective: int, samples: int) -> Iterator[str]:
    """Warning of a noise level that is estimated from too few unclipped samples."""
    enough = effective >= max(FEW, FEW_SHARE * samples)
    if effective == samples or (enough and not _drifts(sums, effective)):
        return
    yield coded(
        "few-unclipped",
        f"{samples - effective:,} of {samples:,} samples are clipped: the noise is "
        "estimated from the others, and its own error is not in those stated",
    )


def _drifts(sums: SandwichSums, effective: int) -> bool:
    """Whether an error of the noise level changes the solution noticeably."""
    drift = np.asarray(sums.drift, float)
    # Mostly nothing is clipped, and a pseudo-inverse takes long.
    if not drift.any():
        return False
    bread = np.asarray(sums.bread, float)
    inverse = np.linalg.pinv(bread, rcond=1e-6, hermitian=True)
    moved = inverse @ drift / math.sqrt(2 * max(effective, 1))
    error = np.sqrt(np.maximum(np.diag(inverse), 1e-300))
    return not np.all(np.abs(moved) < MOVED * error)


_SUMMED = {
    "blocks": "over blocks of {side} × {side} pixels",
    "diffuse": "where diffuse light is equal",
    "highlight": "where the highlight is equal",
}


def coarse_words(films: Iterable[Film]) -> Iterator[str]:
    """Warning of JPEG files so compressed that simulated errors are too small."""
    if not any(film.jpeg is not None and film.jpeg.is_coarse for film in films):
        return
    yield coded(
        "coarse-jpeg",
        "a JPEG file is compressed as at quality 35 or below: most of the "
        "highlight's colour is rounded to zero, and errors of specular may be too "
        "small by half",
    )


def grid_words(significance: float) -> Iterator[str]:
    """Warning of an image from a JPEG file whose compression was not given."""
    if significance <= SIGNIFICANT:
        return
    yield coded(
        "jpeg-blocks",
        f"residuals jump between blocks of {SIDE} × {SIDE} pixels "
        f"({significance:.2g} σ), as in a JPEG file, whose rounding errors are "
        "correlated: errors may be several times too small",
    )


def spread_words(spread: float) -> Iterator[str]:
    """Warning of residuals that are larger than the given noise."""
    if spread == 1:
        return
    yield coded(
        "noise-level",
        f"residuals are {spread:.1f} times as large as the noise that was given: "
        "the noise or the model is wrong; errors are widened by this factor",
    )


def bound_words(estimated: Estimates, unknowns: Unknowns) -> Iterator[str]:
    """Warnings of estimates at their bounds."""
    for k in np.flatnonzero(estimated.at_bound):
        label, (low, high) = unknowns.labels[k], unknowns.bounds[k]
        above = high - estimated.values[k] < estimated.values[k] - low
        words = f"{label} lies at its {'upper' if above else 'lower'} bound "
        words += f"{high if above else low:g}: its error is one-sided"
        code, remedy = "at-bound", None
        if estimated.strain[k] > CONTRADICTION:
            code = "bound-decides"
            words += f". Without it the estimate would be {estimated.strain[k]:.2g} σ "
            words += "beyond it, so estimates that depend on it are biased"
        parameter = unknowns.table.parameter[unknowns.reported[k]]
        # Reflectances cannot be negative.
        if above or parameter not in REFLECTANCES:
            low, high = (low, 5 * high) if above else (low / 5, high)
            remedy = f"If it may lie beyond, try bounds={{'{label}': ({low:g}, "
            remedy += f"{high:g})}}, or --bounds {label}={low:g}:{high:g}"
        yield coded(code, words, remedy)


def rival_words(
    estimated: Estimates, unknowns: Unknowns, rival: Rival | None, inflation: float
) -> Iterator[str]:
    """Warning of another minimum that the images do not exclude."""
    excess = 0.0 if rival is None else float(rival.excess) / inflation
    if rival is None or not excess < SEPARATE**2:
        return
    other = np.asarray(rival.entries, float)[unknowns.reported]
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.nan_to_num(np.abs(other - estimated.values) / estimated.errors)
    if off.max(initial=0) <= DISTANT:
        return
    named = [k for k in np.argsort(-off)[:NAMED] if off[k] > DISTANT]
    shown = ", ".join(
        f"{unknowns.labels[k]} {other[k]:.4g} in place of {estimated.values[k]:.4g} "
        f"({off[k]:.2g} standard errors)"
        for k in named
    )
    yield coded(
        "two-solutions",
        f"another solution fits as well (its χ² is larger by {excess:.2g}): {shown}",
    )


def prior_words(
    estimated: Estimates, unknowns: Unknowns, inflation: float
) -> Iterator[str]:
    """Warnings of priors that the images contradict."""
    for k, entry in enumerate(unknowns.reported):
        if not unknowns.has_prior[entry] or unknowns.table.form[entry] == "direction":
            continue
        mean, deviation = (
            float(each[entry])
            for each in (unknowns.prior_mean, unknowns.prior_deviation)
        )
        off = (estimated.values[k] - mean) / deviation
        # Fraction of the information in the estimate that comes from its prior.
        share = estimated.covariance[k, k] / inflation / deviation**2
        share = min(share, 1 - 1e-6) if np.isfinite(share) else 0.0
        conflict = abs(off) / math.sqrt(1 - share)
        if conflict > CONTRADICTION:
            yield coded(
                "prior-conflict",
                f"the prior of {unknowns.labels[k]}, {mean:g} ± {deviation:g}, and the "
                f"images contradict each other ({conflict:.2g} σ): the estimate agrees "
                "with neither",
            )
