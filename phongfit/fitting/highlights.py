"""Is there a highlight at all? Without one nothing is known of its exponent."""

import numpy as np
from jaxtyping import Bool, Float

from phongfit.fitting.diagnostics import SEEN
from phongfit.fitting.identifiability import unfelt
from phongfit.fitting.leaves import LEAVES
from phongfit.fitting.quantiles import chi_squared_reach
from phongfit.fitting.statistics import Sandwich, Statistics, as_quadratic
from phongfit.fitting.unknowns import Unknowns

# Of a highlight below so many standard errors chance has chosen the exponent too.
PLAIN = SEEN + 2


def doubtful_exponents(
    unknowns: Unknowns, position: Float[np.ndarray, " n"], found: Statistics
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Exponents of highlights that are not seen, and of those that are seen faintly.

    Of each material the colours' ρ_s are judged, each alone and all together.

    **Arguments:** `position`, `found`: the solution, and what is known there.
    """
    kinds, owners = unknowns.kinds, unknowns.owners
    unseen, faint = np.zeros((2, len(position)), bool)
    specular = kinds == "specular"
    if not specular.any() or not unknowns.logarithmic.any():
        return unseen, faint
    # An unknown light scales a highlight, but cannot make one out of nothing.
    felt = ~unfelt(found.sums.inside, unknowns, position, found.sums.resolution)
    group = np.flatnonzero(np.isin(kinds, LEAVES) & felt)
    part = found.sums.part(group)
    covariance = part.covariance()
    for owner in np.unique(owners[specular]):
        own = owners == owner
        colours = np.flatnonzero(specular[group] & own[group])
        height = position[group[colours]]
        exponents = own & (kinds == "shininess")
        together = covariance[np.ix_(colours, colours)]
        if _stands_out(height, together, PLAIN):
            continue
        if _stands_out(height, together, SEEN) or _cannot_be_none(
            unknowns, position, part, group, colours
        ):
            faint |= exponents
        else:
            unseen |= exponents
    return unseen, faint


def _stands_out(
    height: Float[np.ndarray, " k"],
    covariance: Float[np.ndarray, "k k"],
    deviations: float,
) -> bool:
    """Whether any is so many standard errors high, or all are, which is as rare."""
    if not len(height):
        return False
    error = np.sqrt(np.maximum(np.diag(covariance), 0))
    if np.any(height >= deviations * error):
        return True
    distance = height @ np.linalg.pinv(covariance, hermitian=True) @ height
    return bool(distance >= chi_squared_reach(deviations, len(height)))


def _cannot_be_none(
    unknowns: Unknowns,
    position: Float[np.ndarray, " n"],
    part: Sandwich,
    group: np.ndarray,
    colours: np.ndarray,
) -> bool:
    """The same of any one, where bounds keep the others from making up for it."""
    here = position[group]
    lower, upper = (
        np.asarray(edge, float)[group] - here
        for edge in (unknowns.lower, unknowns.upper)
    )
    lower[colours] = -np.inf
    along = np.eye(len(group))[colours]
    low = as_quadratic(part, lower, upper).ends(along, SEEN**2)[:, 0]
    return bool(np.any(here[colours] + low >= 0))
