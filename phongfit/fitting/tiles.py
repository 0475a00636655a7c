"""Residuals of an image, summed over square tiles: what [`find_misfit`][] looks at."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from phongfit.fitting.grid import Grid, sum_at_places
from phongfit.fitting.losses import AbstractLoss
from phongfit.fitting.noise import (
    clipped_moments,
    shared_rounding_variance,
    unclipped_moments,
)

# Of smaller tiles than the largest there are no more than so many.
LARGEST, MOST_TILES = 8, 1024


class Measured(NamedTuple):
    """An image and how it was measured: `weight` 1 has noise of deviation `sigma`."""

    image: Float[Array, "height width 3"]
    weight: Float[Array, "height width channels"]
    step: Float[Array, "height width 3"] | None
    sigma: Float[Array, ""]


class Rounding(NamedTuple):
    """What the samples of a tile round in common, (3, rows, columns) each.

    - `deviation`: sum of its standard deviations.
    - `low`, `high`: least and largest level that light was rounded to.
    """

    deviation: Float[Any, "3 rows columns"]
    low: Float[Any, "3 rows columns"]
    high: Float[Any, "3 rows columns"]


class Neighbours(NamedTuple):
    """Sums over rows of an image, and over pairs of adjacent pixels; (rows,) each.

    - `products`, `pairs`: of residuals side by side and one above the other.
    - `squares`, `samples`: of all residuals.
    """

    products: Float[Any, " rows"]
    pairs: Int[Any, " rows"]
    squares: Float[Any, " rows"]
    samples: Int[Any, " rows"]


class Tiles(NamedTuple):
    """Sums over the samples of tiles, (3, rows, columns) each.

    - `total`, `squares`: of residuals in standard deviations, as the loss weighs them.
    - `variance`: what it should be: a sample has 1, less what clipping takes.
    - `arithmetic`: of standard deviations that the arithmetic may round in common.
    - `diffuse`, `highlight`: (rows, columns), mean light for reflectances of 1.
    - `rounding`: `None` where nothing was rounded.
    - `neighbours`, `grid`: of pixels, not of tiles.
    """

    total: Float[Any, "3 rows columns"]
    squares: Float[Any, "3 rows columns"]
    variance: Float[Any, "3 rows columns"]
    arithmetic: Float[Any, "3 rows columns"]
    diffuse: Float[Any, "rows columns"]
    highlight: Float[Any, "rows columns"]
    rounding: Rounding | None
    neighbours: Neighbours
    grid: Grid


def tile_side(height: int, width: int) -> int:
    """Pixels along a tile: a power of two, small where the image is."""
    side = 1
    while side < LARGEST and -(-height // side) * -(-width // side) > MOST_TILES:
        side *= 2
    return side


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
    - `side`: pixels along a tile.
    """
    image, weight, step, sigma = measured
    used = jnp.broadcast_to(weight > 0, image.shape)
    noise = sigma / jnp.sqrt(jnp.where(weight > 0, weight, 1))
    noise = jnp.broadcast_to(noise, image.shape)
    film = clipped_moments(light, noise) if clamp else unclipped_moments(light)
    rounding = jnp.zeros_like(light) if step is None else step**2 / 12
    deviation = jnp.sqrt(noise**2 + rounding)
    residual = jnp.where(used, (image - film.mean) / deviation, 0)
    score = loss.score(residual)[0] if loss.robust else residual
    kept = (noise**2 * film.variance_share + rounding) / deviation**2
    exact = 8 * jnp.finfo(light.dtype).eps * jnp.abs(light) / deviation

    def total(values: Array) -> Array:
        tiled = _tiled(jnp.where(used, values, 0), side, 0)
        return jnp.moveaxis(tiled.sum(axis=(1, 3)), -1, 0)

    common = None
    if step is not None:
        level = light / jnp.where(step > 0, step, 1)
        low = _tiled(jnp.where(used, level, jnp.inf), side, jnp.inf)
        high = _tiled(jnp.where(used, level, -jnp.inf), side, -jnp.inf)
        common = Rounding(
            total(jnp.sqrt(shared_rounding_variance(step, noise)) / deviation),
            jnp.moveaxis(low.min(axis=(1, 3)), -1, 0),
            jnp.moveaxis(high.max(axis=(1, 3)), -1, 0),
        )
    count = jnp.maximum(total(jnp.ones_like(light)).sum(axis=0), 1)
    return Tiles(
        total(score),
        total(score**2),
        total(kept),
        total(exact),
        total(diffuse).sum(axis=0) / count,
        total(highlight).sum(axis=0) / count,
        common,
        _neighbours(score, used),
        sum_at_places(score, used),
    )


def _neighbours(residual: Array, used: Array) -> Neighbours:
    """Residuals (H, W, 3), 0 where not used, times those to their left and above."""

    def rows(values: Array) -> Array:
        return jnp.sum(values, axis=(1, 2))

    both = used[:, 1:] & used[:, :-1]
    above = used[1:] & used[:-1]
    products = rows(residual[:, 1:] * residual[:, :-1])
    return Neighbours(
        products.at[1:].add(rows(residual[1:] * residual[:-1])),
        rows(both).at[1:].add(rows(above)),
        rows(residual**2),
        rows(used),
    )


def _tiled(
    values: Array, side: int, empty: float
) -> Float[Array, "rows side columns side 3"]:
    """Tiles along two axes of their own, filled up with `empty`."""
    padding = [(0, -length % side) for length in values.shape[:2]]
    if np.any(padding):
        values = jnp.pad(values, [*padding, (0, 0)], constant_values=empty)
    height, width, channels = values.shape
    return values.reshape(height // side, side, width // side, side, channels)
