"""Fits of the pixels of a tile, as pure functions of arrays."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from phongfit.maps.pixel.errors import Profile, standard_errors
from phongfit.maps.pixel.samples import (
    Outside,
    PixelFit,
    Samples,
    Tile,
    measured,
    pixels_last,
)
from phongfit.maps.pixel.scale import (
    count_used,
    final_scale,
    median_scale,
    most_by_chance,
    students_t,
    widening,
)
from phongfit.maps.pixel.search import SearchResult, follow_exponent, search
from phongfit.maps.pixel.settings import Flag, MapSettings, Unknowns, unknowns_of
from phongfit.maps.pixel.small import KEEP_BARRIERS
from phongfit.maps.pixel.step import edges_of

BLOCK = 512
"""Pixels of a block: few enough that its arrays stay in cache."""

T = TypeVar("T")


def in_two_passes(tile: Tile, fit: Callable[[Tile, Array], tuple[T, Array]]) -> T:
    """Fit all blocks of a tile quickly, then thoroughly the pixels that need it.

    The pixels of a block run in lock step, so one hard pixel slows all of them. Pixels
    that the first pass leaves unsettled are therefore gathered into separate blocks.

    **Arguments:** `fit`: from a block, and whether to be thorough, to its result and
    the pixels that need a thorough fit.

    **Returns:** the results, with the pixels as their first axis.
    """
    pixels = tile.normal.shape[0]
    # Jitted, so that it is traced once for `eval_shape` and for the loop.
    compiled = jax.jit(fit)

    def work(state: _Work) -> _Work:
        start = state.block * BLOCK
        thorough = start >= pixels
        these = jax.lax.dynamic_slice_in_dim(state.queue, start, BLOCK)
        part = jax.lax.cond(
            thorough, lambda: tile.rows(these), lambda: tile.span(start, BLOCK)
        )
        result, unsettled = compiled(part, thorough)
        (which,) = jnp.nonzero(unsettled & ~thorough, size=BLOCK, fill_value=BLOCK)
        more = jnp.take(these, which, mode="fill", fill_value=pixels)
        following = state.block + 1
        # Blocks of padding are skipped, so that a part of a tile takes less time.
        padding = (following * BLOCK >= tile.count) & ~thorough
        return _Work(
            jnp.where(padding, pixels // BLOCK, following),
            jax.tree.map(
                lambda all, some: all.at[these].set(some, mode="drop"),
                state.result,
                result,
            ),
            jax.lax.dynamic_update_slice_in_dim(state.queue, more, state.length, 0),
            state.length + jnp.sum(more < pixels),
        )

    zero = jnp.zeros((), int)
    span = tile.span(zero, BLOCK)
    shapes, _ = jax.eval_shape(compiled, span, jnp.array(False))
    first = _Work(
        zero,
        jax.tree.map(
            lambda leaf: jnp.zeros((pixels, *leaf.shape[1:]), leaf.dtype), shapes
        ),
        jnp.minimum(jnp.arange(2 * pixels + BLOCK), pixels),
        zero + pixels,
    )
    return jax.lax.while_loop(lambda s: s.block * BLOCK < s.length, work, first).result


class _Work(NamedTuple):
    """State of [`in_two_passes`][].

    - `block`: number of the next block of the queue.
    - `result`: results so far of all pixels.
    - `queue`: all pixels, then those of the second pass; padded with the number of
        pixels.
    - `length`: length of the queue so far.
    """

    block: Array
    result: Any
    queue: Array
    length: Array


@functools.partial(
    jax.jit, static_argnames=("settings", "fit"), compiler_options=KEEP_BARRIERS
)
def fit_tile(
    tile: Tile, among: Any, settings: MapSettings, fit: Callable[..., Any]
) -> dict[str, Array]:
    """Fit the material, and the normal if unknown, of a tile's pixels.

    **Arguments:**

    - `tile`: a multiple of [`BLOCK`][] pixels; unknown normals are not read.
    - `among`, `settings`: equal for all tiles.
    - `fit`: [`fit_block`][], or a function like it for other inputs `among`.

    **Returns:** the arrays of a [`PixelFit`][] by their names in files, with the pixels
    as their first axis.
    """
    fitted = in_two_passes(
        tile, lambda part, thorough: fit(part, among, thorough, settings)
    )
    return fitted.arrays()


# Efficiency of a median of absolute values as a measure of scale: Hampel, *The
# influence curve and its role in robust estimation*, J. Am. Stat. Assoc. 69(346), 1974.
MEDIAN = 0.37


def fit_block(
    tile: Tile, outside: Outside, thorough: Bool[Array, ""], settings: MapSettings
) -> tuple[PixelFit, Bool[Array, " pixels"]]:
    """Fit one block of pixels.

    **Arguments:** `thorough`: whether to search thoroughly instead of fast.

    **Returns:** the fit, and the pixels that need a thorough search.
    """
    which = unknowns_of(settings)
    samples, lost = samples_of(tile, outside, settings)
    known, normal = outside.known.spread(), None
    if not which.normal:
        normal = pixels_last(tile.normal)
    if not settings.shared:
        # Without a common exponent each channel is fitted like a pixel.
        apart = functools.partial(_each_channel, pixels=len(tile.normal))
        known = jax.tree.map(apart, known)
        samples = _channels_apart(samples, apart)
        normal = None if normal is None else jnp.tile(normal, 3)
    found = search(samples, known, outside.noise, settings, which, thorough, normal)
    return judged(found, samples, lost, outside, settings, which, thorough)


def _each_channel(
    values: Float[Array, "*batch channels #pixels"], pixels: int
) -> Float[Array, "*batch 1 all_pixels"]:
    """Values of the pixels in the first channel, then those in the next ones."""
    values = jnp.broadcast_to(values, (*values.shape[:-1], pixels))
    return values.reshape(*values.shape[:-2], 1, -1)


def _channels_apart(samples: Samples, apart: functools.partial) -> Samples:
    """Samples of pixels that have one channel each."""
    lamps = samples.lamps

    def vectors(array: Array) -> Array:
        return array if array.shape[-1] == 1 else jnp.tile(array, 3)

    lamps = jax.tree.map(apart, lamps)._replace(
        to_light=vectors(lamps.to_light), to_viewer=vectors(lamps.to_viewer)
    )
    return Samples(apart(samples.target), apart(samples.share), lamps)


def samples_of(
    tile: Tile, outside: Outside, settings: MapSettings
) -> tuple[Samples, Float[Array, "#images #pixels"]]:
    """Samples of a tile, and the number of samples per image that are not finite.

    Samples that no light reaches are left out, since they show only reflected light of
    other surfaces, which is not modelled.
    """
    seen, lighting, normal = tile.visibility, outside.lighting, None
    if settings.normals == "given":
        normal = pixels_last(tile.normal)
    if seen is not None and seen.shape[1] == 1:
        # With one light per image, shadowed samples are removed below, so that the
        # visibility is not needed as a factor on the light.
        tile = tile._replace(visibility=None)
    samples, lost = measured(tile, lighting, settings)
    directed = lighting.directed[..., None]
    reaches = directed if seen is None else directed & (seen > 0)
    if normal is not None:
        lamps, light = samples.lamps, samples.lamps.to_light
        rows = [light[:, :, k] * normal[k][None, None] for k in range(3)]
        cosine = rows[0] + rows[1] + rows[2]
        reaches = reaches & (cosine > settings.min_cosine)
        around = lighting.around(tile.position, tile.normal)
        samples = samples._replace(lamps=lamps._replace(around=around))
    if seen is None and normal is None:
        return samples, lost
    reached = jnp.any(reaches, axis=1) | ~np.any(directed, axis=1)
    target, share = (jnp.where(reached[:, None], one, 0) for one in samples[:2])
    return samples._replace(target=target, share=share), jnp.where(reached, lost, 0)


def judged(
    found: SearchResult,
    samples: Samples,
    lost: Array,
    outside: Outside,
    settings: MapSettings,
    which: Unknowns,
    thorough: Array | bool = True,
) -> tuple[PixelFit, Bool[Array, " pixels"]]:
    """Add errors and flags to a result, and mark pixels for a thorough search."""
    point, channels = found.point, fitted_apart(settings)
    level, unit, misfit = _noise_left(found, samples, outside, settings)
    edges = edges_of(settings, which)
    rival = found.rival / unit**2

    def follow(log_exponents: Array, wanted: Array) -> Profile:
        return follow_exponent(
            found, samples, log_exponents, wanted, settings, which, thorough
        )

    def any_of(flag: Array) -> Array:
        return jnp.any(flag.reshape(channels, -1), axis=0)

    def rows(values: Array) -> Array:
        """Values of pixels, with the channels as second axis."""
        return jnp.broadcast_to(values, point.diffuse.shape).reshape(3, -1)

    errors = standard_errors(
        point, found.sums, unit, samples, rival, which, edges, follow
    )
    count = jnp.sum(samples.share > 0, axis=(0, 1)).reshape(channels, -1).sum(axis=0)
    unknowns = settings.unknowns()
    enough = (count > unknowns) | (settings.noise_given & (count >= unknowns))
    black = ~any_of(jnp.any(samples.target != 0, axis=(0, 1)))
    sound, settled = enough & ~black, ~any_of(~found.settled)
    flags = jnp.where(black, Flag.BLACK, 0)
    for flag, where in (
        (Flag.NOT_FINITE, jnp.any(lost > 0, axis=0)),
        (Flag.TOO_FEW, ~enough),
        (Flag.NOT_CONVERGED, sound & ~settled),
        (Flag.NO_HIGHLIGHT, sound & any_of(errors.dim)),
        (Flag.DEGENERATE, sound & any_of(errors.degenerate)),
        (Flag.AT_BOUND, sound & any_of(errors.at_bound)),
        (Flag.IN_A_PLANE, sound & any_of(errors.in_a_plane)),
        (Flag.AMBIGUOUS, sound & any_of(errors.ambiguous)),
        (Flag.MISFIT, sound & misfit),
    ):
        flags = flags | jnp.where(where, flag, 0)
    identified = sound & settled

    def error_of(name: str) -> Array:
        if name in which.own:
            error = errors.own[which.own.index(name)]
        elif name == "specular" and which.one_specular:
            error = errors.specular[None]
        else:
            return jnp.zeros((len(level), 3), level.dtype)
        return jnp.where(identified[None], rows(error), jnp.inf).T

    exponent = jnp.broadcast_to(
        outside.known.shininess[:, None], (channels, len(level))
    )
    exponent_error = jnp.zeros_like(exponent)
    if which.exponent:
        t, error = (
            values.reshape(channels, -1)
            for values in (point.log_exponent, errors.exponent)
        )
        exponent = jnp.clip(jnp.exp(t), *settings.bound("shininess"))
        exponent_error = jnp.where(identified[None], error, jnp.inf)
    names = ("ambient", "diffuse", "specular")
    deviations = {name: error_of(name) for name in names}
    deviations["shininess"] = exponent_error.T
    fit = PixelFit(
        ambient=rows(point.ambient).T,
        diffuse=rows(point.diffuse).T,
        specular=rows(point.specular).T,
        shininess=exponent.T,
        stderr=deviations,
        noise=level,
        samples=count.astype(jnp.int32),
        flags=flags,
    )
    if which.normal:
        error = jnp.where(identified, errors.normal, jnp.inf)
        fit = fit._replace(normals=point.normal.T, normals_stderr=error)
    unsettled = sound & any_of(~found.settled | found.near | ~errors.settled)
    return fit, unsettled & ~thorough


def fitted_apart(settings: MapSettings) -> int:
    """Number of channels that are fitted separately, as pixels of one channel."""
    return 1 if settings.shared else 3


def _noise_left(
    found: SearchResult,
    samples: Samples,
    outside: Outside,
    settings: MapSettings,
) -> tuple[Array, Array, Array]:
    """The noise level of the residuals, the unit of the errors, and flags of misfit.

    The unit of the errors is in units of the search's scale of the residuals.
    """
    channels, noise, loss = fitted_apart(settings), outside.noise, settings.loss
    unknowns = settings.unknowns(samples.target.shape[1])
    left, used = found.left, samples.share > 0
    count = count_used(samples.share)
    freedom = jnp.maximum(count - unknowns, 1)
    own = final_scale(left, samples.share, found.scale, loss, unknowns)
    unit = jnp.ones_like(freedom)
    if loss.robust:
        relative = left / found.scale[None, None]

        def widened(relative: Array, used: Array) -> Array:
            return widening(loss, relative, used, unknowns)

        unit = jax.vmap(widened, in_axes=-1)(relative, used)
        weight = jnp.where(used, loss.weight(relative), 0)
        kept = jnp.sum(weight, axis=(0, 1)) / jnp.maximum(count, 1)
        # The sums are of weighted samples, so their inverse overestimates the variance.
        unit = (jnp.maximum(unit, 1) if settings.noise_given else unit) * jnp.sqrt(kept)

    def whole(values: Array) -> Array:
        return jnp.sum(values.reshape(channels, -1), axis=0)

    total = whole(freedom)
    level = jnp.sqrt(whole(freedom * own**2) / total)
    everywhere = jnp.tile(level, channels)
    wider = unit * jnp.tile(students_t(total), channels)
    if not settings.noise_given:
        sigma = own if loss.robust else everywhere
        return level, wider * sigma / found.scale, jnp.zeros(level.shape, bool)
    seen, heard = level, total
    if loss.robust:
        # The weights of the loss hide samples that the model does not describe.
        middle = median_scale(left, samples.share, unknowns)
        seen = jnp.sqrt(whole(freedom * middle**2) / total)
        heard = MEDIAN * total
    misfit = (seen / noise) ** 2 > most_by_chance(heard)
    wider = wider * jnp.tile(seen, channels) / noise
    unit = jnp.where(jnp.tile(misfit, channels), wider, unit)
    return level, unit, misfit
