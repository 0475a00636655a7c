"""Fits of normals and materials of a tile, as pure functions of arrays."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from phongfit.maps.normals.errors import Profile, standard_errors
from phongfit.maps.normals.scale import count_used, weighed_scale
from phongfit.maps.normals.search import SearchResult, follow_exponent, search
from phongfit.maps.normals.step import edges_of
from phongfit.maps.normals.unknowns import Unknowns, unknowns_of
from phongfit.maps.pixel.flags import Flag
from phongfit.maps.pixel.pixel import MEDIAN, Outside, PixelFit, most_by_chance
from phongfit.maps.pixel.robust import widening
from phongfit.maps.pixel.samples import Samples, Tile, measured
from phongfit.maps.pixel.settings import MapSettings
from phongfit.maps.pixel.tile import in_two_passes


def fit_normals(tile: Tile, outside: Outside, settings: MapSettings) -> PixelFit:
    """Fit the normal and the material of every pixel of a tile, block by block.

    **Arguments:** as for [`fit_tile`][]; the tile's normals are not read.
    """
    return in_two_passes(
        tile, lambda part, thorough: fit_block(part, outside, thorough, settings)
    )


def fit_block(
    tile: Tile, outside: Outside, thorough: Bool[Array, ""], settings: MapSettings
) -> tuple[PixelFit, Bool[Array, " pixels"]]:
    """Fit the normals and materials of one block of pixels.

    **Arguments:** `thorough`: whether to search thoroughly instead of fast.

    **Returns:** the fit, and the pixels that need a thorough search.
    """
    which = unknowns_of(settings)
    samples, lost = samples_of(tile, outside, settings)
    known, noise = outside.known, outside.noise
    found = search(samples, known, noise, settings, which, thorough)
    return judged(found, samples, lost, outside, settings, which, thorough)


def samples_of(
    tile: Tile, outside: Outside, settings: MapSettings
) -> tuple[Samples, Float[Array, "#images #pixels"]]:
    """Samples of a tile, and the number of samples per image that are not finite."""
    seen = tile.visibility
    if seen is not None and seen.shape[1] == 1:
        # With one light per image, shadowed samples are removed below, so that the
        # visibility is not needed as a factor on the light.
        tile = tile._replace(visibility=None)
    samples, lost = measured(tile, outside.lighting, settings)
    if seen is not None:
        # In shadow there is only reflected light of other surfaces, which is not
        # modelled.
        directed = outside.lighting.directed[..., None]
        reached = jnp.any(directed & (seen > 0), axis=1, keepdims=True)
        reached = reached | ~np.any(directed, axis=1, keepdims=True)
        target, share = (jnp.where(reached, one, 0) for one in samples[:2])
        samples = samples._replace(target=target, share=share)
    return samples, lost


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
    point = found.point
    level, unit, misfit = _noise_left(found, samples, outside, settings)
    edges = edges_of(settings, which)
    rival = found.rival / unit**2

    def follow(log_exponents: Array, wanted: Array) -> Profile:
        return follow_exponent(
            found, samples, log_exponents, wanted, settings, which, thorough
        )

    errors = standard_errors(
        point, found.sums, unit, samples, rival, which, edges, follow
    )
    count = jnp.sum(samples.share > 0, axis=(0, 1))
    unknowns = settings.unknowns()
    enough = (count > unknowns) | (settings.noise_given & (count >= unknowns))
    black = ~jnp.any(samples.target > 0, axis=(0, 1))
    sound = enough & ~black
    flags = jnp.where(black, Flag.BLACK, 0)
    for flag, where in (
        (Flag.NOT_FINITE, jnp.any(lost, axis=0)),
        (Flag.TOO_FEW, ~enough),
        (Flag.NOT_CONVERGED, sound & ~found.settled),
        (Flag.NO_HIGHLIGHT, sound & errors.dim),
        (Flag.DEGENERATE, sound & errors.degenerate),
        (Flag.AT_BOUND, sound & errors.at_bound),
        (Flag.IN_A_PLANE, sound & errors.in_a_plane),
        (Flag.AMBIGUOUS, sound & errors.ambiguous),
        (Flag.MISFIT, sound & misfit),
    ):
        flags = flags | jnp.where(where, flag, 0)
    identified = sound & found.settled

    def error_of(name: str) -> Array:
        if name in which.own:
            error = errors.own[which.own.index(name)]
        elif name == "specular" and which.one_specular:
            error = errors.specular[None]
        else:
            return jnp.zeros((level.shape[0], 3), level.dtype)
        error = jnp.where(identified[None], error, jnp.inf)
        return jnp.broadcast_to(error, (3, level.shape[0])).T

    exponent = jnp.where(identified, errors.exponent, jnp.inf)
    exponent_error = exponent if which.exponent else jnp.zeros_like(exponent)
    specular = jnp.broadcast_to(point.specular, point.diffuse.shape)
    fit = PixelFit(
        point.ambient.T,
        point.diffuse.T,
        specular.T,
        jnp.clip(jnp.exp(point.log_exponent), *settings.bound("shininess"))[:, None]
        if which.exponent
        else jnp.exp(point.log_exponent)[:, None],
        {
            "ambient": error_of("ambient"),
            "diffuse": error_of("diffuse"),
            "specular": error_of("specular"),
            "shininess": exponent_error[:, None],
        },
        level,
        count.astype(jnp.int32),
        flags,
        point.normal.T,
        jnp.where(identified, errors.normal, jnp.inf),
    )
    unsettled = sound & (~found.settled | found.near | ~errors.settled)
    return fit, unsettled & ~thorough


def _noise_left(
    found: SearchResult,
    samples: Samples,
    outside: Outside,
    settings: MapSettings,
) -> tuple[Array, Array, Array]:
    """The noise level of the residuals, the unit of the errors, and flags of misfit.

    The unit of the errors is in units of the search's scale of the residuals.
    """
    unknowns, noise = settings.unknowns(), outside.noise
    left, used = found.left, samples.share > 0
    count = count_used(samples.share)
    freedom = jnp.maximum(count - unknowns, 1)
    level = jnp.sqrt(jnp.sum(left**2, axis=(0, 1)) / freedom)
    unit = jnp.ones_like(level)
    heard = freedom
    if settings.loss.robust:
        level = weighed_scale(left, samples.share, found.scale, settings.loss, unknowns)
        heard = freedom * MEDIAN
        relative = left / found.scale[None, None]

        def widened(relative: Array, used: Array) -> Array:
            return widening(settings.loss, relative, used, unknowns)

        unit = jax.vmap(widened, in_axes=-1)(relative, used)
        weight = jnp.where(used, settings.loss.weight(relative), 0)
        kept = jnp.sum(weight, axis=(0, 1)) / jnp.maximum(count, 1)
        # The sums are of weighted samples, so their inverse overestimates the variance.
        unit = (jnp.maximum(unit, 1) if settings.noise_given else unit) * jnp.sqrt(kept)
    if not settings.noise_given:
        return level, unit * level / found.scale, jnp.zeros(level.shape, bool)
    misfit = (level / noise) ** 2 > most_by_chance(heard)
    return level, jnp.where(misfit, unit * level / noise, unit), misfit
