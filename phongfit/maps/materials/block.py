"""A tile of pixels, each of one of several materials: which, and its normal."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from phongfit.maps.materials.bases import Bases, as_known, held, sought
from phongfit.maps.materials.reduced import reduce, take_apart
from phongfit.maps.normals.block import NormalFit, judged, samples_of
from phongfit.maps.normals.search import SearchResult, search
from phongfit.maps.normals.step import edges_of, free_to_move
from phongfit.maps.normals.sums import gather
from phongfit.maps.normals.unknowns import unknowns_of
from phongfit.maps.pixel.flags import Flag
from phongfit.maps.pixel.pixel import Outside, PixelFit
from phongfit.maps.pixel.samples import Samples, Tile
from phongfit.maps.pixel.settings import MapSettings
from phongfit.maps.pixel.tile import in_blocks

# Share of one material from which on a pixel is told to be of it.
TOLD = 0.95
# A material that is less likely says nothing of a pixel's errors.
UNLIKELY = 1e-4


class Given(NamedTuple):
    """What all tiles share: lights, and the materials."""

    outside: Outside
    bases: Bases


class MaterialFit(NamedTuple):
    """Normals and materials of pixels, which are the first axis.

    - `weights`: (pixels, K), how likely a pixel is of each material.
    """

    pixel: NormalFit
    weights: Float[Array, "pixels materials"]


class _Try(NamedTuple):
    """Pixels of one material: what was found, and how likely that is.

    - `left`: residuals, in `scale`; `log_det`: see [`Reduced`][].
    - `unsettled`: where a thorough search is wanted.
    """

    fit: NormalFit
    left: Float[Array, "images channels pixels"]
    scale: Float[Array, " pixels"]
    log_det: Float[Array, " pixels"]
    unsettled: Bool[Array, " pixels"]


def fit_shared(tile: Tile, given: Given, settings: MapSettings) -> MaterialFit:
    """The normal, matte light and material of every pixel of a tile, block by block."""
    return in_blocks(
        tile, lambda part, effort: _fit_block(part, given, effort > 0, settings)
    )


def _fit_block(
    tile: Tile, given: Given, thorough: Bool[Array, ""], settings: MapSettings
) -> tuple[MaterialFit, Bool[Array, " pixels"]]:
    """As [`phongfit.maps.normals.block.fit_block`][]."""
    outside, bases = given
    own, which = held(settings), sought(settings)
    samples, lost = samples_of(tile, outside, settings)

    def attempt(material: tuple[Array, Array]) -> _Try:
        values, covariance = material
        here = outside._replace(known=as_known(values, outside.known))
        found = search(samples, here.known, outside.noise, own, which, thorough)
        fit, unsettled = judged(found, samples, lost, here, own, which, thorough)
        fit, log_det = _inherited(fit, found, samples, covariance, settings)
        return _Try(fit, found.left, found.scale, log_det, unsettled)

    tries = jax.lax.map(attempt, (bases.values, bases.covariance))
    # One scale for all: that of the best, and of a few samples not below all others'.
    scale = tries.scale[0]
    if not settings.noise_given:
        level = jnp.min(tries.fit.material.noise, axis=0)
        scale = jnp.maximum(level, bases.noise)
    relative = tries.left / scale[None, None, None]
    # The determinant is of two unknowns, in another scale.
    log_det = tries.log_det + 4 * jnp.log(tries.scale / scale[None])
    cost = jnp.sum(settings.loss.root(relative) ** 2, axis=(1, 2))
    share = jnp.log(jnp.maximum(bases.shares, jnp.finfo(cost.dtype).tiny))
    odds = jax.nn.softmax(share[:, None] - (cost + log_det) / 2, axis=0)
    return _chosen(tries.fit, odds), jnp.any(tries.unsettled, axis=0)


def _inherited(
    fit: NormalFit,
    found: SearchResult,
    samples: Samples,
    covariance: Float[Array, "unknowns unknowns"],
    settings: MapSettings,
) -> tuple[NormalFit, Float[Array, " pixels"]]:
    """Errors that contain the material's; and how well the normal is known."""
    which, mine = unknowns_of(settings), sought(settings)
    point = found.point
    whole = point
    if settings.one_specular:
        whole = point._replace(specular=point.specular[:1])
    sums = gather(whole, samples, found.scale, settings.loss, settings.model, which)
    parts = take_apart(sums, which)
    edges = edges_of(settings, mine)
    free = free_to_move(point, parts.pixel, mine, edges)
    reduced = reduce(parts, free)
    finite = jnp.where(jnp.isfinite(covariance), covariance, 0)

    def through(responses: list[Array]) -> Array:
        moves = jnp.stack(responses)
        return jnp.einsum("i...,ij,j...->...", moves, finite, moves)

    turns = [through([m.shared[k] for m in reduced.adapting]) for k in range(2)]
    turn = jnp.rad2deg(jnp.sqrt(turns[0] + turns[1]))
    errors: dict[str, Array] = dict(zip(_NAMES, fit.material.errors, strict=True))
    for k, name in enumerate(mine.own):
        more = through([m.own[k] for m in reduced.adapting]).T
        errors[name] = jnp.sqrt(errors[name] ** 2 + more)
    spread = jnp.sqrt(jnp.diagonal(covariance))
    errors["specular"] = jnp.broadcast_to(spread[1:], errors["specular"].shape)
    exponent = jnp.exp(point.log_exponent) * spread[0]
    errors["shininess"] = exponent[:, None]
    material = fit.material._replace(errors=tuple(errors[name] for name in _NAMES))
    error = jnp.sqrt(fit.error**2 + turn**2)
    return NormalFit(material, fit.normal, error), reduced.log_det


_NAMES = ("ambient", "diffuse", "specular", "shininess")


def _chosen(fits: NormalFit, odds: Float[Array, "materials pixels"]) -> MaterialFit:
    """Each pixel's likeliest material, with errors that reach as far as the others."""
    best = jnp.argmax(odds, axis=0)

    def pick(leaf: Array) -> Array:
        index = best.reshape(1, -1, *(1,) * (leaf.ndim - 2))
        return jnp.take_along_axis(leaf, index, axis=0)[0]

    found: NormalFit = jax.tree.map(pick, fits)
    likely = odds > UNLIKELY

    def spread(errors: Array, off: Array) -> Array:
        shape = odds.shape + (1,) * (errors.ndim - 2)
        square = jnp.where(likely.reshape(shape), errors**2 + off**2, 0)
        return jnp.sqrt(jnp.sum(odds.reshape(shape) * square, axis=0))

    cosine = jnp.sum(fits.normal * found.normal[None], axis=-1)
    off = jnp.rad2deg(jnp.arccos(jnp.clip(cosine, -1, 1)))
    error = spread(fits.error, jnp.where(cosine > 1 - 1e-6, 0, off))
    told = jnp.max(odds, axis=0) >= TOLD
    errors = []
    for name, each in zip(_NAMES, fits.material.errors, strict=True):
        values = getattr(fits.material, name)
        wide = spread(each, values - getattr(found.material, name)[None])
        if name in ("specular", "shininess"):
            wide = jnp.where(told[:, None], wide, jnp.inf)
        errors.append(wide)
    hidden = ~jnp.isfinite(pick(fits.material.errors[3]))[:, 0]
    flags = found.material.flags | jnp.where(told, 0, Flag.SEVERAL_MATERIALS)
    flags = flags | jnp.where(told & hidden, Flag.NO_HIGHLIGHT, 0)
    material: PixelFit = found.material._replace(errors=tuple(errors), flags=flags)
    # Of what has no normal nothing else is known.
    lost = ~jnp.isfinite(error)
    wide = tuple(
        jnp.where(lost[:, None] & (each != 0), jnp.inf, each) for each in errors
    )
    return MaterialFit(
        NormalFit(material._replace(errors=wide), found.normal, error), odds.T
    )
