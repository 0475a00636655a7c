"""Fits of a tile's pixels with shared materials: normals and material probabilities."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from phongfit.maps.materials.bases import (
    Bases,
    as_known,
    everything,
    held,
    reduce,
    sought,
)
from phongfit.maps.pixel.block import judged, samples_of
from phongfit.maps.pixel.samples import Outside, PixelFit, Samples, Tile
from phongfit.maps.pixel.search import SearchResult, search
from phongfit.maps.pixel.settings import Flag, MapSettings
from phongfit.maps.pixel.step import edges_of, free_to_move
from phongfit.maps.pixel.sums import gather

# Least probability of a material at which a pixel is identified as being of it.
TOLD = 0.95
# Materials less probable than this do not contribute to a pixel's errors.
UNLIKELY = 1e-4


class Given(NamedTuple):
    """Inputs that all tiles share: lights, and the materials."""

    outside: Outside
    bases: Bases


class _Try(NamedTuple):
    """Fits of pixels under one material, and terms of its likelihood.

    - `left`: residuals; `scale`: their scale; `log_det`: see [`Reduced`][].
    - `unsettled`: pixels that need a thorough search.
    """

    fit: PixelFit
    left: Float[Array, "images channels pixels"]
    scale: Float[Array, " pixels"]
    log_det: Float[Array, " pixels"]
    unsettled: Bool[Array, " pixels"]


def fit_shared(
    tile: Tile, given: Given, thorough: Bool[Array, ""], settings: MapSettings
) -> tuple[PixelFit, Bool[Array, " pixels"]]:
    """Fit normal, matte light and material of one block of pixels.

    See [`phongfit.maps.pixel.block.fit_block`][].
    """
    outside, bases = given
    own, which = held(settings), sought(settings)
    samples, lost = samples_of(tile, outside, settings)

    def attempt(material: tuple[Array, Array]) -> _Try:
        values, covariance = material
        here = outside._replace(known=as_known(values, outside.known))
        found = search(
            samples, here.known.spread(), outside.noise, own, which, thorough
        )
        fit, unsettled = judged(found, samples, lost, here, own, which, thorough)
        fit, log_det = _inherited(fit, found, samples, covariance, settings)
        return _Try(fit, found.left, found.scale, log_det, unsettled)

    tries = jax.lax.map(attempt, (bases.values, bases.covariance))
    # Likelihoods are compared at one scale: that of the best material, but at least the
    # noise of a typical pixel, since few samples may have small residuals by chance.
    scale = tries.scale[0]
    if not settings.noise_given:
        level = jnp.min(tries.fit.noise, axis=0)
        scale = jnp.maximum(level, bases.noise)
    relative = tries.left / scale[None, None, None]
    # The determinant of two unknowns, converted to that scale.
    log_det = tries.log_det + 4 * jnp.log(tries.scale / scale[None])
    cost = jnp.sum(settings.loss.root(relative) ** 2, axis=(1, 2))
    share = jnp.log(jnp.maximum(bases.shares, jnp.finfo(cost.dtype).tiny))
    odds = jax.nn.softmax(share[:, None] - (cost + log_det) / 2, axis=0)
    return _chosen(tries.fit, odds), jnp.any(tries.unsettled, axis=0)


def _inherited(
    fit: PixelFit,
    found: SearchResult,
    samples: Samples,
    covariance: Float[Array, "unknowns unknowns"],
    settings: MapSettings,
) -> tuple[PixelFit, Float[Array, " pixels"]]:
    """Add the material's errors to a pixel's, and return the normal's `log_det`."""
    mine, point = sought(settings), found.point
    sums = gather(point, samples, found.scale, settings, everything(settings))
    reduced = reduce(sums, free_to_move(point, sums, mine, edges_of(settings, mine)))
    finite = jnp.where(jnp.isfinite(covariance), covariance, 0)

    def through(responses: list[Array]) -> Array:
        moves = jnp.stack(responses)
        return jnp.einsum("i...,ij,j...->...", moves, finite, moves)

    turns = [through([m.shared[k] for m in reduced.adapting]) for k in range(2)]
    turn = jnp.rad2deg(jnp.sqrt(turns[0] + turns[1]))
    errors = dict(fit.stderr)
    for k, name in enumerate(mine.own):
        more = through([m.own[k] for m in reduced.adapting]).T
        errors[name] = jnp.sqrt(errors[name] ** 2 + more)
    spread = jnp.sqrt(jnp.diagonal(covariance))
    errors["specular"] = jnp.broadcast_to(spread[1:], errors["specular"].shape)
    exponent = jnp.exp(point.log_exponent) * spread[0]
    errors["shininess"] = exponent[:, None]
    assert fit.normals_stderr is not None
    error = jnp.sqrt(fit.normals_stderr**2 + turn**2)
    return fit._replace(stderr=errors, normals_stderr=error), reduced.log_det


def _chosen(fits: PixelFit, odds: Float[Array, "materials pixels"]) -> PixelFit:
    """The most probable material of each pixel, with errors that cover the others."""
    best = jnp.argmax(odds, axis=0)

    def pick(leaf: Array) -> Array:
        index = best.reshape(1, -1, *(1,) * (leaf.ndim - 2))
        return jnp.take_along_axis(leaf, index, axis=0)[0]

    found = jax.tree.map(pick, fits)
    likely = odds > UNLIKELY

    def spread(errors: Array, off: Array) -> Array:
        shape = odds.shape + (1,) * (errors.ndim - 2)
        square = jnp.where(likely.reshape(shape), errors**2 + off**2, 0)
        return jnp.sqrt(jnp.sum(odds.reshape(shape) * square, axis=0))

    assert fits.normals_stderr is not None
    cosine = jnp.sum(fits.normals * found.normals[None], axis=-1)
    off = jnp.rad2deg(jnp.arccos(jnp.clip(cosine, -1, 1)))
    error = spread(fits.normals_stderr, jnp.where(cosine > 1 - 1e-6, 0, off))
    told = jnp.max(odds, axis=0) >= TOLD
    # Without an identified normal, no other unknown is identified.
    lost = ~jnp.isfinite(error)
    errors = {}
    for name, each in fits.stderr.items():
        wide = spread(each, getattr(fits, name) - getattr(found, name)[None])
        if name in ("specular", "shininess"):
            wide = jnp.where(told[:, None], wide, jnp.inf)
        errors[name] = jnp.where(lost[:, None] & (wide != 0), jnp.inf, wide)
    hidden = ~jnp.isfinite(found.stderr["shininess"])[:, 0]
    flags = found.flags | jnp.where(told, 0, Flag.SEVERAL_MATERIALS)
    flags = flags | jnp.where(told & hidden, Flag.NO_HIGHLIGHT, 0)
    return found._replace(
        stderr=errors, flags=flags, normals_stderr=error, weights=odds.T
    )
