"""From sums at the solution to standard errors, and to what they cannot say."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from phongfit.fitting.diagnostics import SEEN
from phongfit.fitting.maps.columns import Columns
from phongfit.fitting.maps.exponent import (
    At,
    Box,
    Slopes,
    Sums,
    full_gram,
    slope_gram,
)
from phongfit.fitting.maps.settings import Settings
from phongfit.fitting.maps.small import (
    Numbers,
    Triangle,
    curvatures,
    factorize,
    only,
    over_channels,
)

# A search has ended where the next step would be less than this share of the error.
SETTLED = 0.1


class Errors(NamedTuple):
    """Standard errors of a group of channels; infinite for what cannot be told.

    - `reflectances`: (channels, unknowns): the columns', then that of ρ_s.
    - `exponent`: of f.
    - `dim`, `alike`, `at_bound`, `moving`: see [`Flag`][].
    """

    reflectances: Float[Array, "channels unknowns"]
    exponent: Float[Array, ""]
    dim: Bool[Array, ""]
    alike: Bool[Array, ""]
    at_bound: Bool[Array, ""]
    moving: Bool[Array, ""]


def standard_errors(
    at: At,
    columns: Columns,
    t: Float[Array, ""],
    sigma: Float[Array, ""],
    faintest: Float[Array, ""],
    box: Box,
    settings: Settings,
) -> Errors:
    r"""Errors from $\sigma^2 (J^\top J)^{-1}$ of what is free.

    At a bound the error is one-sided: how far into the box the data let a reflectance
    go until the squares have risen by σ².

    **Arguments:**

    - `at`, `columns`, `t`: the solution.
    - `sigma`: standard deviation of a sample.
    - `faintest`: the least curvature that ρ_s has at any exponent.
    """
    inner = (t > box.lowest) & (t < box.highest)
    searched = settings.searched & inner
    whole = jnp.ones_like(inner)

    def bordered(
        columns: Columns, sums: Sums, slopes: Slopes, specular: Array, rest: Array
    ) -> Triangle:
        """Products of all columns and of ρ_s S'; `rest` is other channels' say on t."""
        side = tuple(specular * number for number in slope_gram(slopes))
        corner = specular**2 * slopes.own + rest
        return (*full_gram(columns, sums), (*side, corner))

    def about_t(
        columns: Columns, sums: Sums, slopes: Slopes, point: Numbers, free: Numbers
    ) -> Array:
        matrix = bordered(columns, sums, slopes, point[-1], jnp.zeros_like(t))
        return factorize(only(matrix, (*free, whole))).last

    here = (columns, at.sums, at.slopes, at.point, at.free)
    alone = over_channels(about_t, *here)
    total = jnp.sum(alone)

    def channel(
        columns: Columns,
        sums: Sums,
        slopes: Slopes,
        point: Numbers,
        free: Numbers,
        alone: Array,
    ) -> tuple[Numbers, Numbers]:
        apart = curvatures(full_gram(columns, sums), free)
        if not settings.searched:
            return apart, apart
        matrix = bordered(columns, sums, slopes, point[-1], total - alone)
        return curvatures(matrix, (*free, searched))[:-1], apart

    shared, apart = over_channels(channel, *here, alone)

    def reach(curvature: Numbers) -> Array:
        return jnp.stack(
            [
                _reach(c, jnp.abs(pull), free, sigma)
                for c, pull, free in zip(curvature, at.pull, at.free, strict=True)
            ],
            axis=-1,
        )

    error, error_apart = reach(shared), reach(apart)
    # Without a highlight the exponent may be anything: ρ_s is told if it is for all.
    seen = at.point[-1] >= SEEN * jnp.minimum(error[:, -1], error_apart[:, -1])
    dim = ~jnp.any(seen) & settings.shiny
    told = jnp.stack(shared, axis=-1) > 0
    if settings.searched:
        error = jnp.where(dim, error_apart, error)
        told = jnp.where(dim, jnp.stack(apart, axis=-1) > 0, told)
        hidden = jnp.where(dim, sigma * _root_inverse(faintest), 0)
        is_last = jnp.arange(error.shape[-1]) == error.shape[-1] - 1
        error = jnp.where(is_last[None, :], jnp.maximum(error, hidden), error)
    width = jnp.stack(box.upper) - jnp.stack(box.lower)
    told = told & (error <= width[None, :])
    error = jnp.where(told, error, jnp.inf)

    log_error = sigma * _root_inverse(total)
    open_ended = dim | ~inner | ~(log_error <= box.highest - box.lowest)
    exponent = jnp.where(open_ended, jnp.inf, jnp.exp(t) * log_error)
    step = jnp.abs(at.slope) / jnp.where(at.curvature > 0, at.curvature, 1)
    moving = (step > SETTLED * log_error) & (step > 1e-3) & ~open_ended & searched

    wanted = jnp.array([True] * len(settings.columns) + [settings.shiny])[None, :]
    held = ~jnp.stack(at.free, axis=-1)
    return Errors(
        error,
        exponent,
        dim & settings.searched,
        jnp.any(~told & wanted) | (settings.searched & open_ended & inner & ~dim),
        jnp.any(held & wanted) | (settings.searched & ~inner & ~dim),
        moving,
    )


def _reach(curvature: Array, pull: Array, free: Array, sigma: Array) -> Array:
    """How far each unknown may go until the squares have risen by σ²."""
    pull = jnp.where(free, 0, pull)
    # pull·d + curvature·d²/2 = σ²/2, solved without cancellation.
    root = jnp.sqrt(pull**2 + sigma**2 * curvature)
    whole = pull + root
    positive = whole > 0
    reach = sigma**2 / jnp.where(positive, whole, 1)
    # Without any noise there is no error, save where nothing is told anyway.
    reach = jnp.where(positive, reach, jnp.where(curvature > 0, 0, jnp.inf))
    return jnp.where(jnp.isfinite(sigma), reach, jnp.inf)


def _root_inverse(curvature: Array) -> Array:
    positive = curvature > 0
    root = jax.lax.rsqrt(jnp.where(positive, curvature, 1))
    return jnp.where(positive, root, jnp.inf)
