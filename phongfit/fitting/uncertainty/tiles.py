"""Residuals of an image, summed over square tiles, for [`find_misfit`][]."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from phongfit.fitting.problem.losses import AbstractLoss
from phongfit.fitting.problem.noise import film_moments, shared_rounding_variance
from phongfit.fitting.uncertainty.grid import Grid, sum_at_places
from phongfit.programs import program


class Measured(NamedTuple):
    """An image and its noise: samples of weight 1 have the deviation `sigma`."""

    image: Float[Array, "height width 3"]
    weight: Float[Array, "height width channels"]
    step: Float[Array, "height width 3"] | None
    sigma: Float[Array, ""]


class Rounding(NamedTuple):
    """Rounding errors that the samples of a tile share, (3, rows, columns) each.

    - `deviation`: sum of their standard deviations.
    - `low`, `high`: least and largest level that light was rounded to.
    """

    deviation: Float[Any, "3 rows columns"]
    low: Float[Any, "3 rows columns"]
    high: Float[Any, "3 rows columns"]


class Neighbours(NamedTuple):
    """Sums over pairs of adjacent pixels, side by side and one above the other.

    For each column and channel: `products` of residuals, and the number of `pairs`.
    `channels` has the products of two channels, over all pixels.
    """

    products: Float[Any, " columns*3"]
    pairs: Float[Any, " columns*channels"]
    channels: Float[Any, ""]


class Tiles(NamedTuple):
    """Sums over the samples of tiles, (3, rows, columns) each.

    - `total`, `squares`: residuals in standard deviations, weighted by the loss, and
        their squares.
    - `variance`: their expected variance: 1 for a sample, and less if it is clipped.
    - `arithmetic`: standard deviations of shared rounding of the arithmetic.
    - `count`: number of samples.
    - `diffuse`, `highlight`: (rows, columns), mean light for reflectances of 1.
    - `rounding`: `None` where nothing was rounded.
    - `neighbours`, `grid`: sums over pixels, not over tiles.
    """

    total: Float[Any, "3 rows columns"]
    squares: Float[Any, "3 rows columns"]
    variance: Float[Any, "3 rows columns"]
    arithmetic: Float[Any, "3 rows columns"]
    count: Float[Any, "3 rows columns"]
    diffuse: Float[Any, "rows columns"]
    highlight: Float[Any, "rows columns"]
    rounding: Rounding | None
    neighbours: Neighbours
    grid: Grid


@program("clamp", "side")
def sum_over_tiles(
    measured: Measured,
    light: Float[Array, "height width 3"],
    diffuse: Float[Array, "height width 3"],
    highlight: Float[Array, "height width 3"],
    loss: AbstractLoss,
    clamp: bool,
    side: int,
) -> Tiles:
    """The sums over one image's tiles.

    **Arguments:**

    - `light`: what the model predicts, before the film.
    - `diffuse`, `highlight`: light for reflectances of 1.
    - `side`: pixels along the side of a tile.
    """
    weight, step, sigma = measured.weight, measured.step, measured.sigma
    none = jnp.zeros_like(light)
    # The condition is always true; without it XLA computes this again for each sum.
    left = jax.lax.cond(
        ~(sigma < 0),
        lambda: _leave(measured, light, loss, clamp),
        lambda: _Scores(none > 0, none, none, none, None if step is None else none),
    )
    used, score = left.used, left.score

    def total(values: Array) -> Array:
        return _fold(jnp.where(used, values, 0), side, jnp.add, 0)

    common = None
    if step is not None:
        level = light / jnp.where(step > 0, step, 1)
        common = Rounding(
            total(left.rounding),
            _fold(jnp.where(used, level, jnp.inf), side, jnp.minimum, jnp.inf),
            _fold(jnp.where(used, level, -jnp.inf), side, jnp.maximum, -jnp.inf),
        )
    count = total(jnp.ones_like(light))
    samples = jnp.maximum(count.sum(axis=0), 1)
    return Tiles(
        total(score),
        total(score**2),
        total(left.variance),
        total(left.arithmetic),
        count,
        total(diffuse).sum(axis=0) / samples,
        total(highlight).sum(axis=0) / samples,
        common,
        _neighbours(score, weight),
        sum_at_places(score, used),
    )


class _Scores(NamedTuple):
    """Summands of [`Tiles`][] for each sample, and deviations of shared rounding."""

    used: Bool[Array, "height width 3"]
    score: Float[Array, "height width 3"]
    variance: Float[Array, "height width 3"]
    arithmetic: Float[Array, "height width 3"]
    rounding: Float[Array, "height width 3"] | None


def _leave(
    measured: Measured,
    light: Float[Array, "height width 3"],
    loss: AbstractLoss,
    clamp: bool,
) -> _Scores:
    image, weight, step, sigma = measured
    used = jnp.broadcast_to(weight > 0, image.shape)
    noise = sigma / jnp.sqrt(jnp.where(weight > 0, weight, 1))
    film = film_moments(light, noise, clamp)
    deviation, variance, shared = noise, film.variance_share, None
    if step is not None:
        deviation = jnp.sqrt(noise**2 + step**2 / 12)
        shared = jnp.sqrt(shared_rounding_variance(step, noise)) / deviation
        variance = (noise**2 * variance + step**2 / 12) / deviation**2
    residual = jnp.where(used, (image - film.mean) / deviation, 0)
    return _Scores(
        used,
        loss.score(residual)[0] if loss.robust else residual,
        variance,
        8 * jnp.finfo(light.dtype).eps * jnp.abs(light) / deviation,
        shared,
    )


def _neighbours(residual: Array, weight: Array) -> Neighbours:
    """Products of residuals (H, W, 3), 0 where not used, with those left and above."""

    height, _, kinds = weight.shape
    flat = residual.reshape(height, -1)
    products = _down(flat[1:] * flat[:-1]).at[3:].add(_shifted(flat, 3))
    # Not repeated for the channels, which would be the slowest part.
    used = (weight > 0).astype(residual.dtype).reshape(height, -1)
    pairs = _down(used[1:] * used[:-1]).at[kinds:].add(_shifted(used, kinds))
    # Red with green, green with blue, red with blue; the rest are of two pixels.
    one, two = _shifted(flat, 1), _shifted(flat, 2)
    channels = jnp.sum(one[0::3]) + jnp.sum(one[1::3]) + jnp.sum(two[0::3])
    return Neighbours(products, pairs * (3 // kinds), channels)


def _shifted(values: Float[Array, "rows columns"], by: int) -> Float[Array, " places"]:
    """Sums of products of values with those `by` places to the right."""
    return _down(values[:, by:] * values[:, :-by])


def _down(values: Float[Array, "rows columns"]) -> Float[Array, " columns"]:
    """Sums over rows, as a product with ones, which is three times as fast in XLA."""
    ones = jnp.ones(len(values), values.dtype)
    return jnp.matmul(ones, values, precision="highest")


def _fold(
    values: Float[Array, "height width 3"],
    side: int,
    two: Callable[[Array, Array], Array],
    empty: float,
) -> Float[Array, "3 rows columns"]:
    """Combine all pixels of each tile; incomplete tiles are filled up with `empty`."""
    padding = [(0, -length % side) for length in values.shape[:2]]
    if np.any(padding):
        values = jnp.pad(values, [*padding, (0, 0)], constant_values=empty)
    height, width, channels = values.shape
    # Row by row, since XLA's sums along several axes take twice as long.
    rows = values.reshape(height // side, side, width * channels)
    folded = functools.reduce(two, [rows[:, k] for k in range(side)])
    tiles = folded.reshape(height // side, width // side, side, channels)
    folded = functools.reduce(two, [tiles[:, :, k] for k in range(side)])
    return jnp.moveaxis(folded, -1, 0)
