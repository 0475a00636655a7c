"""From the solver's vector to numbers in the user's units, with their errors."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.fitting.diagnostics import SEEN
from phongfit.fitting.problem import Problem
from phongfit.fitting.statistics import Pieces, Statistics, statistics
from phongfit.fitting.sums import linearize
from phongfit.fitting.unknowns import Unknowns, in_units


@dataclasses.dataclass(frozen=True)
class Estimates:
    """What is known of every reported entry, in the order of `Unknowns.labels`."""

    values: np.ndarray
    errors: np.ndarray
    covariance: np.ndarray
    at_bound: np.ndarray
    untold: np.ndarray
    free: int
    chi_squared: float
    reasons: tuple[str, ...]


Estimates.__init__.__doc__ = """**Arguments:**

- `values`, `errors`: infinite errors for what cannot be told; at a bound one-sided.
- `covariance`: NaN rows for entries at a bound or not told.
- `free`: how many numbers were free and told.
- `chi_squared`: residuals, priors' too, in standard deviations, squared and summed.
- `reasons`: why some cannot be told, in words.
"""


def estimates(
    problem: Problem,
    y: Float[Array, " n"],
    inflation: float = 1.0,
    place: tuple[Array, Array] | None = None,
    pieces: Pieces | None = None,
) -> Estimates:
    """Values and errors at a solution.

    **Arguments:**

    - `inflation`: factor on all variances.
    - `place`, `pieces`: what [`in_units`][] and [`add_up`][] say of it, if at hand.
    """
    unknowns = problem.unknowns
    place = in_units(unknowns, y) if place is None else place
    found = statistics(problem, y, inflation, pieces)
    untold, reasons = _beyond_sense(problem, y, found)
    at_bound = found.at_bound & ~untold
    entries, slope = (np.asarray(a, float) for a in place)
    touched = slope != 0
    hidden = touched[:, untold].any(axis=1)
    bound = touched[:, at_bound].any(axis=1) & ~hidden

    known = ~untold & ~at_bound
    inner = np.where(np.outer(known, known), found.covariance, 0)
    covariance = slope @ inner @ slope.T
    errors = np.sqrt(np.diag(covariance))
    one_sided = np.where(at_bound, found.stderr, 0)
    errors = np.where(bound, np.abs(slope) @ one_sided, errors)
    errors = np.where(hidden, np.inf, errors)
    covariance[hidden | bound, :] = covariance[:, hidden | bound] = np.nan
    covariance[hidden, hidden] = np.inf
    values = np.clip(entries[unknowns.reported], *unknowns.bounds.T)
    return Estimates(
        values,
        errors,
        covariance,
        bound,
        hidden,
        int(known.sum()),
        found.chi_squared,
        reasons,
    )


def _beyond_sense(
    problem: Problem, y: Float[Array, " n"], found: Statistics
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Unknowns whose error, though finite, says that nothing is known."""
    unknowns = problem.unknowns
    position = np.asarray(y)
    untold = found.untold.copy()
    reasons = [*found.reasons]
    labels = np.array(unknowns.y_labels)
    kinds, owners = unknowns.kinds, unknowns.owners
    with np.errstate(invalid="ignore"):
        vague = ~untold & (found.stderr > _width(unknowns))
        # An unknown light scales a highlight, but cannot make one out of nothing.
        dark = (kinds == "specular") & (position < SEEN * found.apart)
    for label in dict.fromkeys(labels[vague]):
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
            if not _told_for_all_exponents(problem, position, int(entry), exponents):
                words = "some exponents would hide the highlight where no pixel is used"
                reasons.append(f"{labels[entry]} cannot be told: {words}")
                untold[entry] = True
    return untold, tuple(reasons)


def _width(unknowns: Unknowns) -> np.ndarray:
    """How wide the box is; an angle's is a quarter of a circle."""
    width = np.asarray(unknowns.upper, float) - np.asarray(unknowns.lower, float)
    is_angle = np.isin(unknowns.forms[unknowns.owned], ("direction", "rotation"))
    return np.where(is_angle, np.pi / 2, width)


def _told_for_all_exponents(
    problem: Problem, y: np.ndarray, entry: int, exponents: np.ndarray
) -> bool:
    """Whether a reflectance is told whatever the exponent, which is not, may be."""
    lower, upper = (
        np.asarray(edge) for edge in (problem.unknowns.lower, problem.unknowns.upper)
    )
    for share in np.linspace(0, 1, 7):
        there = y.copy()
        low, high = lower[exponents], upper[exponents]
        there[exponents] = low + share * (high - low)
        felt = float(_curvature(problem, jnp.asarray(there, y.dtype))[entry])
        # In standard deviations, and the other unknowns only add to it.
        if 1 / (np.sqrt(felt) + 1e-30) > upper[entry] - lower[entry]:
            return False
    return True


@eqx.filter_jit
def _curvature(problem: Problem, y: Float[Array, " n"]) -> Float[Array, " n"]:
    return jnp.diag(linearize(problem, y).jacobian.gram())
