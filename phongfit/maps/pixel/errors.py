"""From sums at the solution to standard errors, and to what they cannot say."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from phongfit.fitting.uncertainty.identifiability import SEEN
from phongfit.maps.pixel.columns import Columns
from phongfit.maps.pixel.exponent import (
    At,
    Box,
    Slopes,
    Sums,
    full_gram,
    slope_gram,
)
from phongfit.maps.pixel.lobes import Angles
from phongfit.maps.pixel.search import (
    Profile,
    candidates,
    survey,
    where_wanted,
)
from phongfit.maps.pixel.settings import MapSettings
from phongfit.maps.pixel.small import (
    Numbers,
    Triangle,
    curvatures,
    factorize,
    over_channels,
)

# A search has ended where the next step would be less than this share of the error.
SETTLED = 0.1
# Moves of a reflectance that do not matter, however small its error.
LEAST = 1e-4
# A standard error of log f from which on the model bends within it.
VAGUE = 0.25
# Standard errors to which a profile is followed: those of intervals of 95 %.
FAR = 2.0


class Errors(NamedTuple):
    """Standard errors of a group of channels; infinite for what is not identified.

    - `reflectances`: (channels, unknowns): the columns', then that of ρ_s.
    - `exponent`: of f.
    - `dim`, `degenerate`, `at_bound`, `moving`: see [`Flag`][].
    - `vague`: whether the profile is wanted.
    """

    reflectances: Float[Array, "channels unknowns"]
    exponent: Float[Array, ""]
    dim: Bool[Array, ""]
    degenerate: Bool[Array, ""]
    at_bound: Bool[Array, ""]
    moving: Bool[Array, ""]
    vague: Bool[Array, ""]


def standard_errors(
    at: At,
    columns: Columns,
    t: Float[Array, ""],
    sigma: Float[Array, ""],
    moved: Float[Array, "channels unknowns"],
    angles: Angles,
    box: Box,
    thorough: Bool[Array, ""],
    settings: MapSettings,
) -> Errors:
    r"""Errors from $\sigma^2 (J^\top J)^{-1}$, with no unknown held by its bound.

    An estimate that lies at its bound may have a truth inside of it, and then all that
    is correlated with it moves: nothing at a bound counts as known. Where the exponent
    is vague, the model bends within its error; errors then reach at least as far as the
    profile does, which holds the exponent all over its range and has all else adapt.

    **Arguments:**

    - `at`, `columns`, `t`: the solution.
    - `sigma`: standard deviation of a sample.
    - `moved`: by how much the reflectances last moved, where weights move them.
    - `angles`: as in [`PixelSamples`][].
    - `thorough`: whether to follow the profile where it is wanted.
    """
    inner = (t > box.lowest) & (t < box.highest)
    nothing = jnp.zeros_like(t)

    def bordered(
        columns: Columns, sums: Sums, slopes: Slopes, specular: Array, rest: Array
    ) -> Triangle:
        """Products of all columns and of ρ_s S'; `rest` is other channels' say on t."""
        side = tuple(specular * number for number in slope_gram(slopes))
        corner = specular**2 * slopes.own + rest
        return (*full_gram(columns, sums), (*side, corner))

    def about_t(columns: Columns, sums: Sums, slopes: Slopes, point: Numbers) -> Array:
        return factorize(bordered(columns, sums, slopes, point[-1], nothing)).last

    here = (columns, at.sums, at.slopes, at.point)
    alone = over_channels(about_t, *here)
    total = jnp.sum(alone)

    def channel(
        columns: Columns, sums: Sums, slopes: Slopes, point: Numbers, alone: Array
    ) -> tuple[Numbers, Numbers]:
        apart = curvatures(full_gram(columns, sums))
        if not settings.searched:
            return apart, apart
        matrix = bordered(columns, sums, slopes, point[-1], total - alone)
        return curvatures(matrix)[:-1], apart

    shared, apart = over_channels(channel, *here, alone)
    error, error_apart = (
        jnp.stack([sigma * _root_inverse(c) for c in curvature], axis=-1)
        for curvature in (shared, apart)
    )
    # Without a highlight the exponent may be anything: ρ_s is identified if it is for
    # all.
    seen = at.point[-1] >= SEEN * jnp.minimum(error[:, -1], error_apart[:, -1])
    dim = ~jnp.any(seen) & settings.shiny
    log_error = sigma * _root_inverse(total)
    reach = log_error
    open_ended = ~inner
    moving = vague = jnp.zeros_like(dim)
    if settings.searched:
        error = jnp.where(dim, error_apart, error)

        def follow(columns: Columns) -> tuple[Array, Array, Array]:
            count = candidates(*settings.log_bounds)
            profile = survey(columns, settings.lobes, angles, box, count)
            return (_widest(at, profile, sigma), *_ends(at, profile, t, sigma, box))

        vague = dim | ~inner | ~(log_error < VAGUE)
        nowhere = (jnp.zeros_like(error), t, t)
        wider, low, high = where_wanted(vague & thorough, follow, columns, nowhere)
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
    moving |= jnp.any((moved > SETTLED * error) & (moved > LEAST))
    width = jnp.stack(box.upper) - jnp.stack(box.lower)
    identified = (error <= width[None, :]) & ~moving
    error = jnp.where(identified, error, jnp.inf)
    exponent = jnp.where(open_ended | moving, jnp.inf, jnp.exp(t) * reach)

    wanted = jnp.array([True] * len(settings.columns) + [settings.shiny])[None, :]
    held = ~jnp.stack(at.free, axis=-1)
    blurred = jnp.any(~identified & wanted) & ~moving
    return Errors(
        error,
        exponent,
        dim & settings.searched,
        blurred | (settings.searched & open_ended & inner & ~dim),
        jnp.any(held & wanted) | (settings.searched & ~inner & ~dim),
        moving,
        vague,
    )


def _widest(
    at: At, profile: Profile, sigma: Array
) -> Float[Array, "channels unknowns"]:
    r"""Half of the interval that the profile allows at two standard errors.

    For an exponent that costs $\Delta\phi$, a reflectance there may lie
    $\sqrt{(4 \sigma^2 - \Delta\phi) v}$ from the best.
    """
    left = FAR**2 - _rise(at, profile, sigma)
    allowed = (left >= 0)[:, None]
    left = jnp.sqrt(jnp.maximum(left, 0))[:, None]
    found = []
    for here, points, variances in zip(
        at.point, profile.point, profile.variance, strict=True
    ):
        off = jnp.abs(points - here[None, :]) + left * sigma * jnp.sqrt(variances)
        # Infinity times 0 is nothing here: such an exponent costs all there is.
        off = jnp.where(allowed, jnp.where(jnp.isnan(off), jnp.inf, off), 0)
        found.append(jnp.max(off, axis=0) / FAR)
    return jnp.stack(found, axis=-1)


def _rise(at: At, profile: Profile, sigma: Array) -> Float[Array, " candidates"]:
    """What candidates cost more than the solution, in variances of a sample."""
    exact = sigma > 0
    rise = (profile.value - at.value) / jnp.where(exact, sigma**2, 1)
    return jnp.where(exact, rise, jnp.inf)


def _ends(
    at: At, profile: Profile, t: Array, sigma: Array, box: Box
) -> tuple[Array, Array]:
    r"""Between which exponents the profile allows any.

    The signed root of what an exponent costs is a straight line where the model is
    linear: it is followed from candidate to candidate.

    ??? cite "Source"
        Bates and Watts, *Nonlinear regression analysis and its applications*, 1988,
        section 6.1.
    """
    root = jnp.sqrt(jnp.maximum(_rise(at, profile, sigma), 0))
    root = jnp.where(profile.t < t, -root, root)
    here, beyond = root[:-1], root[1:]
    slope = beyond - here
    slope = jnp.where(slope > 0, slope, jnp.inf)
    start, spacing = profile.t[:-1], profile.t[1:] - profile.t[:-1]
    rises = (here <= FAR) & (beyond > FAR)
    high = jnp.where(rises, start + spacing * (FAR - here) / slope, t)
    falls = (here < -FAR) & (beyond >= -FAR)
    low = jnp.where(falls, start + spacing * (-FAR - here) / slope, t)
    # A candidate at the end of the range that is allowed leaves that open.
    high = jnp.where(root[-1] <= FAR, box.highest, jnp.max(high))
    low = jnp.where(root[0] >= -FAR, box.lowest, jnp.min(low))
    return low, high


def _root_inverse(curvature: Array) -> Array:
    positive = curvature > 0
    root = jax.lax.rsqrt(jnp.where(positive, curvature, 1))
    return jnp.where(positive, root, jnp.inf)
