"""Standard errors of pixels from sums at the solution, and flags for their limits."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from phongfit.fitting.uncertainty.identifiability import SEEN
from phongfit.maps.pixel.columns import Columns
from phongfit.maps.pixel.exponent import At, Box, full_gram, slope_gram
from phongfit.maps.pixel.lobes import Angles
from phongfit.maps.pixel.search import Profile, survey
from phongfit.maps.pixel.settings import MapSettings
from phongfit.maps.pixel.small import (
    Triangle,
    curvatures,
    factorize,
    in_groups,
    of_rank,
)

T = TypeVar("T")

# Converged: the next step is below this fraction of the standard error.
SETTLED = 0.1
# Changes of a reflectance below this are negligible, however small its error.
LEAST = 1e-4
# From this standard error of log f on, the model is not linear within the error.
VAGUE = 0.25
# Profiles are followed to this many standard errors: about a 95 % interval.
FAR = 2.0


class Errors(NamedTuple):
    """Standard errors of all channels; infinite if not identified.

    - `reflectances`: (channels, pixels) for each unknown: those of the columns, then
        ρ_s.
    - `exponent`: of f, (groups, pixels).
    - `dim`, `degenerate`, `at_bound`, `moving`: see [`Flag`][], (groups, pixels).
    """

    reflectances: Float[Array, "unknowns channels pixels"]
    exponent: Float[Array, "groups pixels"]
    dim: Bool[Array, "groups pixels"]
    degenerate: Bool[Array, "groups pixels"]
    at_bound: Bool[Array, "groups pixels"]
    moving: Bool[Array, "groups pixels"]


def standard_errors(
    at: At,
    columns: Columns,
    t: Float[Array, "groups pixels"],
    sigma: Float[Array, "#groups pixels"],
    moved: Float[Array, "unknowns channels pixels"],
    angles: Angles,
    box: Box,
    settings: MapSettings,
    profile: Profile | None = None,
) -> Errors:
    r"""Errors from $\sigma^2 (J^\top J)^{-1}$, with no unknown held by its bound.

    The true value may be inside the bound when the estimate lies at it, and estimates
    that are correlated with it then differ too: so parameters at a bound count as free.
    If the error of the exponent is large, the model is not linear within it. Errors
    then reach at least as far as the profile, for which all other unknowns are fitted
    at exponents over the whole range.

    **Arguments:**

    - `at`, `columns`, `t`: the solution.
    - `sigma`: standard deviation of a sample.
    - `moved`: last change of the reflectances by reweighting; 0 without.
    - `angles`: as in [`Basis`][].
    - `profile`: of these columns; `None`: computed here if a pixel needs it.
    """
    groups = len(t)
    inner = (t > box.lowest) & (t < box.highest)

    def bordered(rest: Array) -> Triangle:
        """Products of all columns and ρ_s S'; `rest`: curvature from other channels."""
        specular = at.point[-1]
        side = tuple(specular * number for number in slope_gram(at.slopes))
        corner = specular**2 * at.slopes.own + rest
        return (*full_gram(columns, at.sums), (*side, corner))

    def any_of(found: Array) -> Array:
        return in_groups(found.astype(t.dtype), groups) > 0

    alone = factorize(bordered(jnp.zeros_like(at.point[-1]))).last
    total = in_groups(alone, groups)
    apart = shared = curvatures(full_gram(columns, at.sums))
    if settings.searched:
        shared = curvatures(bordered(total - alone))[:-1]
    error, error_apart = (
        jnp.stack([sigma * _root_inverse(c) for c in curvature])
        for curvature in (shared, apart)
    )
    if not settings.searched:
        error = jnp.broadcast_to(error, (len(error), *at.point[-1].shape))
    # Without a highlight any exponent is possible: errors are then those at a fixed
    # exponent.
    seen = at.point[-1] >= SEEN * jnp.minimum(error[-1], error_apart[-1])
    dim = ~any_of(seen) & settings.shiny
    log_error = sigma * _root_inverse(total)
    reach = log_error
    open_ended = ~inner
    moving = jnp.zeros_like(dim)
    if settings.searched:
        error = jnp.where(dim[None], error_apart, error)

        def follow() -> tuple[Array, Array, Array]:
            known = profile
            if known is None:
                known = survey(columns, settings.lobes, angles, box, groups)
            wider = _widest(at, known, columns, sigma)
            return (wider, *_ends(at, known, t, sigma, box))

        vague = dim | ~inner | ~(log_error < VAGUE)
        nowhere = jnp.zeros_like(error), t, t
        wider, low, high = _where_wanted(vague, follow, nowhere)
        error = jnp.maximum(error, wider)
        reach = jnp.maximum(log_error, (high - t) / FAR)
        below = (t - low) / FAR
        open_ended = dim | ~inner | (high >= box.highest)
        open_ended |= ~(log_error <= box.highest - box.lowest)
        step = jnp.abs(at.slope) / jnp.where(at.curvature > 0, at.curvature, 1)
        moving = (step > SETTLED * log_error) & (step > 1e-3) & ~open_ended
        upward = jnp.expm1(FAR * reach) / FAR
        downward = -jnp.expm1(-FAR * below) / FAR
        reach = jnp.maximum(upward, downward)
    restless = (moved > SETTLED * error) & (moved > LEAST)
    moving = moving | any_of(jnp.any(restless, axis=0))
    width = np.subtract(box.upper, box.lower)
    identified = (error <= width[:, None, None]) & ~moving[None]
    error = jnp.where(identified, error, jnp.inf)
    exponent = jnp.where(open_ended | moving, jnp.inf, jnp.exp(t) * reach)

    wanted = np.array([True] * len(settings.columns) + [settings.shiny])[:, None, None]
    held = ~jnp.stack(at.free)
    blurred = any_of(jnp.any(~identified & wanted, axis=0)) & ~moving
    return Errors(
        error,
        exponent,
        dim & settings.searched,
        blurred | (settings.searched & open_ended & inner & ~dim),
        any_of(jnp.any(held & wanted, axis=0)) | (settings.searched & ~inner & ~dim),
        moving,
    )


def _widest(
    at: At, profile: Profile, columns: Columns, sigma: Array
) -> Float[Array, "unknowns channels pixels"]:
    r"""Half of the interval that the profile allows at two standard errors.

    For an exponent whose φ is higher by $\Delta\phi$, a reflectance may lie
    $\sqrt{(4 \sigma^2 - \Delta\phi) v}$ from its best value there; $v$ is its variance
    at noise 1 without bounds.
    """
    left = FAR**2 - _rise(at, profile, sigma)
    allowed = left >= 0
    left = jnp.sqrt(jnp.maximum(left, 0))
    found = []
    alone = curvatures(full_gram(columns, profile.sums))
    for here, points, curvature in zip(at.point, profile.point, alone, strict=True):
        spread = left * sigma[None] * _root_inverse(curvature)
        off = jnp.abs(points - here[None]) + spread
        # NaN is 0 · ∞, where the reflectance is not identified. Exponents that the
        # profile excludes add nothing.
        off = jnp.where(allowed, jnp.where(jnp.isnan(off), jnp.inf, off), 0)
        found.append(jnp.max(off, axis=0) / FAR)
    return jnp.stack(found)


def _rise(
    at: At, profile: Profile, sigma: Array
) -> Float[Array, "candidates groups pixels"]:
    """Increase of φ from the solution to each candidate, in variances of a sample."""
    exact = (sigma > 0)[None]
    rise = profile.value - at.value[None]
    rise = rise / jnp.where(exact, sigma[None] ** 2, 1)
    return jnp.where(exact, rise, jnp.inf)


def _ends(
    at: At, profile: Profile, t: Array, sigma: Array, box: Box
) -> tuple[Array, Array]:
    r"""Ends of the interval of log f that the profile allows.

    The signed root of the increase of φ is a straight line in log f where the model is
    linear, so it is interpolated linearly between candidates.

    ??? cite "Source"
        Bates and Watts, *Nonlinear regression analysis and its applications*, 1988,
        section 6.1.
    """
    root = jnp.sqrt(jnp.maximum(_rise(at, profile, sigma), 0))
    grid, t = profile.t[:, None, None], t[None]
    root = jnp.where(grid < t, -root, root)
    here, beyond = root[:-1], root[1:]
    slope = beyond - here
    slope = jnp.where(slope > 0, slope, jnp.inf)
    start, spacing = grid[:-1], grid[1:] - grid[:-1]
    rises = (here <= FAR) & (beyond > FAR)
    high = jnp.where(rises, start + spacing * (FAR - here) / slope, t)
    falls = (here < -FAR) & (beyond >= -FAR)
    low = jnp.where(falls, start + spacing * (-FAR - here) / slope, t)
    # If the candidate at an end of the range is allowed, the interval ends there.
    high = jnp.where(root[-1] <= FAR, box.highest, jnp.max(high, axis=0))
    low = jnp.where(root[0] >= -FAR, box.lowest, jnp.min(low, axis=0))
    return low, high


def _root_inverse(curvature: Array) -> Array:
    positive = curvature > 0
    root = jax.lax.rsqrt(jnp.where(positive, curvature, 1))
    return jnp.where(positive, root, jnp.inf)


def _where_wanted(wanted: Array, compute: Callable[[], T], otherwise: T) -> T:
    """`compute()` where `wanted`, else `otherwise`; skipped if no entry is true.

    The last axes of all leaves are those of `wanted`.
    """

    def some() -> T:
        return jax.tree.map(
            lambda new, old: jnp.where(of_rank(wanted, new.ndim), new, old),
            compute(),
            otherwise,
        )

    return jax.lax.cond(jnp.any(wanted), some, lambda: otherwise)
