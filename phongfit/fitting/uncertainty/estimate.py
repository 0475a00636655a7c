"""Estimates in the user's units with their errors, from the solver's vector."""

import dataclasses
import functools

import numpy as np
from jaxtyping import Array, Bool, Float

from phongfit.codes import coded
from phongfit.fitting.problem.problem import Problem
from phongfit.fitting.problem.unknowns import Unknowns, in_units
from phongfit.fitting.uncertainty.exponents import Doubts, parts_over_exponents
from phongfit.fitting.uncertainty.identifiability import (
    doubtful_exponents,
    not_identifiable,
)
from phongfit.fitting.uncertainty.region import Part, Region
from phongfit.fitting.uncertainty.statistics import (
    SandwichSums,
    Statistics,
    quadratic_about,
    statistics,
)

# Error of log f above which one quadratic does not describe the range of f.
VAGUE = 0.1
# Factor above which an error that a bound makes larger has no covariance.
MISLEADING = 1.25


@dataclasses.dataclass(frozen=True)
class Estimates:
    """Estimates and errors of the reported entries, in the order of their labels.

    **Fields:**

    - `values`, `errors`: estimates, and the larger side of the interval in which Δχ²
        stays below 1; infinite for entries that are not identifiable.
    - `covariance`: covariance of the free entries, with those at a bound held there.
        Rows are NaN for entries at a bound or not identified. They are NaN too if a
        bound or a barely identified exponent makes an error more than a quarter larger.
    - `strain`: for entries at a bound, the number of standard deviations by which the
        images favour values beyond it.
    - `free`: number of free and identified entries.
    - `chi_squared`: sum of squared residuals of samples and priors, in standard
        deviations.
    - `reasons`: warnings on entries that are not identifiable.
    - `region`: intervals at any level.
    """

    values: np.ndarray
    errors: np.ndarray
    covariance: np.ndarray
    at_bound: np.ndarray
    strain: np.ndarray
    unidentified: np.ndarray
    free: int
    chi_squared: float
    reasons: tuple[str, ...]
    region: Region


def estimates(
    problem: Problem,
    y: Float[Array, " n"],
    inflation: float = 1.0,
    in_user_units: tuple[Array, Array] | None = None,
    sums: SandwichSums | None = None,
) -> Estimates:
    """Values and errors at a solution.

    **Arguments:**

    - `inflation`: factor on all variances.
    - `in_user_units`, `sums`: results of [`in_units`][] and [`sandwich_sums`][] at y,
        if they are known already.
    """
    unknowns = problem.unknowns
    in_user_units = in_units(unknowns, y) if in_user_units is None else in_user_units
    found = statistics(problem, y, inflation, sums)
    position = np.asarray(y, float)
    entries, slope = (np.asarray(a, float) for a in in_user_units)
    values = np.clip(entries[unknowns.reported], *unknowns.bounds.T)
    touched = slope != 0
    inner = np.where(np.isfinite(found.covariance), found.covariance, 0)
    covariance = slope @ inner @ slope.T
    errors = np.sqrt(np.maximum(np.diag(covariance), 0))

    unseen, faint = doubtful_exponents(unknowns, position, found.sandwich)
    vague = _vague(unknowns, position, found, unseen)
    make = functools.partial(_one_part, found, unknowns, position)
    if vague.any():
        doubts = Doubts(vague, unseen, faint)
        parts = parts_over_exponents(problem, y, found, inflation, doubts)
        make = functools.partial(tuple, parts)
    region = Region(
        values,
        slope,
        unknowns.table.form[unknowns.reported] == "logarithm",
        unknowns.bounds,
        np.zeros(len(values), bool),
        make,
    )
    unidentified = found.unidentified | unseen | np.isinf(found.stderr)
    reasons = [*found.reasons]
    if vague.any() or _near_bounds(unknowns, position, found):
        ends = region.ends(1.0)
        errors = np.max(np.abs(ends - values[:, None]), axis=1)
        wide = np.all(ends == unknowns.bounds, axis=1) & np.isfinite(errors)
        unidentified |= touched[wide].any(axis=0)
    directions = np.isin(
        unknowns.table.form[unknowns.y_entry], ("direction", "rotation")
    )
    unidentified |= directions & (found.stderr > np.pi / 2)
    reasons += _reasons(unknowns, unidentified & ~found.unidentified, unseen)

    at_bound = found.at_bound & ~unidentified
    strain = (
        found.sandwich.strain(at_bound) if at_bound.any() else np.zeros(len(position))
    )
    hidden = touched[:, unidentified].any(axis=1)
    bound = touched[:, at_bound].any(axis=1) & ~hidden
    errors = np.where(hidden, np.inf, errors)
    with np.errstate(invalid="ignore"):
        misled = errors > MISLEADING * np.sqrt(np.diag(covariance))
    without = hidden | bound | misled
    covariance[without, :] = covariance[:, without] = np.nan
    covariance[hidden, hidden] = np.inf
    return Estimates(
        values,
        errors,
        covariance,
        bound,
        np.where(touched, strain, 0).max(axis=1, initial=0),
        hidden,
        int(np.count_nonzero(~unidentified & ~at_bound & ~unknowns.y_nuisance)),
        found.chi_squared,
        tuple(reasons),
        dataclasses.replace(region, open_ended=hidden),
    )


def _one_part(
    found: Statistics, unknowns: Unknowns, position: Float[np.ndarray, " n"]
) -> tuple[Part, ...]:
    """One quadratic for all unknowns."""
    everything = np.arange(len(position))
    quadratic = quadratic_about(found, unknowns, position, everything)
    return (Part(everything, (quadratic,)),)


def _near_bounds(
    unknowns: Unknowns, position: Float[np.ndarray, " n"], found: Statistics
) -> bool:
    """Whether a bound may cut an interval of one standard error."""
    lower, upper = np.asarray(unknowns.lower), np.asarray(unknowns.upper)
    with np.errstate(invalid="ignore"):
        near = np.minimum(position - lower, upper - position) < found.stderr
    return bool(np.any(found.at_bound | (near & ~found.unidentified)))


def _vague(
    unknowns: Unknowns,
    position: Float[np.ndarray, " n"],
    found: Statistics,
    unseen: Bool[np.ndarray, " n"],
) -> Bool[np.ndarray, " n"]:
    """Exponents, and other shapes of lobes, for which one quadratic is not enough."""
    exponents = unknowns.shapes
    # Errors of logarithms are relative already.
    wide = VAGUE * np.where(unknowns.logarithmic, 1, np.abs(position))
    if found.unidentified[~exponents & ~unknowns.y_nuisance].all():
        return np.zeros(len(position), bool)
    with np.errstate(invalid="ignore"):
        vague = exponents & (unseen | (found.stderr > wide))
    held = np.flatnonzero(exponents & found.at_bound & ~vague)
    if len(held):
        (part,) = _one_part(found, unknowns, position)
        ends = part.ends(np.eye(len(position))[held], 1.0)
        vague[held] = np.abs(ends).max(axis=1) > wide[held]
    return vague


def _reasons(
    unknowns: Unknowns,
    unidentified: Bool[np.ndarray, " n"],
    unseen: Bool[np.ndarray, " n"],
) -> list[str]:
    """Warnings on unknowns that the data do not identify although the Jacobian does."""
    labels = np.array(unknowns.free_labels)
    parameters, materials = unknowns.y_parameter, unknowns.y_material
    hiding = (parameters == "specular") & np.isin(materials, materials[unseen])
    hidden = "some exponents would hide the highlight where no pixel is used"
    wide = "its error is wider than its bounds"
    return [
        coded(code, f"{not_identifiable([label])}: {why}", remedy)
        for code, why, remedy, chosen in (
            ("not-identifiable", wide, _WIDE, ~unseen & ~hiding),
            ("no-highlight", "specular is 0 within its error", None, unseen),
            ("no-highlight", hidden, _HIDDEN, hiding),
        )
        for label in dict.fromkeys(labels[unidentified & chosen])
    ]


_WIDE = "Hold it (fixed), give it a prior, or add images that depend on it"
_HIDDEN = "Use more of the pixels, or light it so that a highlight is seen"
