"""Measured samples of pixels under many lights, and results of their fits.

Pixels are the last axis.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Shaped

from phongfit.maps.pixel.lighting import Lamps, Lighting, make_lamps
from phongfit.maps.pixel.settings import MapSettings


class Tile(NamedTuple):
    """Geometry and measured light of pixels; padding is never used.

    - `target`: (images, pixels, 3), in the order of the lighting's rows: light, or
        whole numbers that stand for it.
    - `used`: (images, pixels, 3), (1, pixels, 3) or (1, pixels, 1), weights of the
        samples: 1, or the inverse of the sample's noise; 0 where it is left out.
    - `normal`: (pixels, 3).
    - `position`, `to_viewer`: (pixels, 3), or (1, 3) if equal for all pixels.
    - `visibility`: (images, lobes, pixels), or `None` without shadows.
    - `table`: (levels,) or (images, levels), the light of each whole number; `None`
        if the target is light.
    - `count`: number of pixels before the padding.
    """

    target: Shaped[Any, "images pixels 3"]
    used: Shaped[Any, "some_images pixels some_channels"]
    normal: Float[Any, "pixels 3"]
    position: Float[Any, "some_pixels 3"]
    to_viewer: Float[Any, "some_pixels 3"]
    visibility: Any
    table: Any
    count: Int[Any, ""]

    def rows(self, rows: Int[Array, " n"]) -> "Tile":
        """Some pixels of a tile of JAX arrays."""
        return self._each(lambda array, axis: jnp.take(array, rows, axis, mode="clip"))

    def span(self, start: Int[Array, ""], size: int) -> "Tile":
        """`size` consecutive pixels, in a tenth of the time that `rows` takes."""
        return self._each(
            lambda array, axis: jax.lax.dynamic_slice_in_dim(array, start, size, axis)
        )

    def _each(self, take: Callable[[Array, int], Array]) -> "Tile":
        def unless_one(array: Array) -> Array:
            return array if array.shape[0] == 1 else take(array, 0)

        return Tile(
            take(self.target, 1),
            take(self.used, 1),
            take(self.normal, 0),
            unless_one(self.position),
            unless_one(self.to_viewer),
            None if self.visibility is None else take(self.visibility, 2),
            self.table,
            self.count,
        )


class Samples(NamedTuple):
    """Measured samples of pixels.

    - `target`: (images, channels, pixels), linear light without fog; 0 if unused.
    - `share`: the inverse of each sample's noise, or 1; 0 if unused.
    - `lamps`: the light that arrives.
    """

    target: Float[Array, "images channels pixels"]
    share: Float[Array, "images #channels pixels"]
    lamps: Lamps


def measured(
    tile: Tile, lighting: Lighting, settings: MapSettings
) -> tuple[Samples, Float[Array, "#images #pixels"]]:
    """Samples of a tile, and the number of samples per image that are not finite."""
    target = _light(pixels_last(tile.target), tile.table)
    finite = jnp.isfinite(target) if tile.table is None else jnp.array(True)
    if settings.exactly:
        sound = finite & (target != settings.cutoff)
    else:
        sound = finite & (target < settings.cutoff)
    given = jnp.broadcast_to(pixels_last(tile.used.astype(target.dtype)), target.shape)
    share = jnp.where(sound, given, 0)
    lamps = make_lamps(lighting, tile.position, tile.to_viewer, tile.visibility)
    light = jnp.where(share > 0, target - lamps.veil, 0)
    # A table has only finite numbers.
    lost = jnp.zeros((1, 1), light.dtype)
    if tile.table is None:
        # As floats, since sums of booleans are slow.
        unused = jnp.where(finite | (given <= 0), 0.0, 1.0).astype(light.dtype)
        lost = unused[:, 0] + unused[:, 1] + unused[:, 2]
    return Samples(light, share, lamps), lost


def _light(
    target: Array, table: Array | None
) -> Float[Array, "images channels pixels"]:
    """Light that the target's whole numbers stand for."""
    if table is None:
        return target
    if table.ndim == 2:
        # A row of the table for each image.
        first = table.shape[1] * jnp.arange(len(table), dtype=jnp.int32)
        target = target.astype(jnp.int32) + first[:, None, None]
    return table.reshape(-1).at[target].get(mode="promise_in_bounds")


def pixels_last(values: Shaped[Array, "*images pixels channels"]) -> Array:
    """Array of shape (…, channels, pixels), contiguous along the pixels."""
    return jnp.stack([values[..., k] for k in range(values.shape[-1])], axis=-2)


class PixelFit(NamedTuple):
    """Fits of pixels, which are the first axis.

    - `ambient`, `diffuse`, `specular`: reflectances; `shininess`: exponents, one for
        each channel or one for all.
    - `stderr`: standard errors of these four by name, infinite if not identified and 0
        if known.
    - `noise`: root mean square of the residuals per degree of freedom, in linear light,
        or in standard deviations of the samples.
    - `samples`: number of samples in use.
    - `flags`: bits of [`Flag`][].
    - `normals`, `normals_stderr`: if fitted, unit vectors in world axes and their
        errors in degrees.
    - `weights`: if pixels share materials, probability of each material.
    """

    ambient: Float[Array, "pixels 3"]
    diffuse: Float[Array, "pixels 3"]
    specular: Float[Array, "pixels 3"]
    shininess: Float[Array, "pixels exponents"]
    stderr: dict[str, Array]
    noise: Float[Array, " pixels"]
    samples: Int[Array, " pixels"]
    flags: Int[Array, " pixels"]
    normals: Float[Array, "pixels 3"] | None = None
    normals_stderr: Float[Array, " pixels"] | None = None
    weights: Float[Array, "pixels materials"] | None = None

    def arrays(self) -> dict[str, Array]:
        """All arrays, by their names in files of maps."""
        named: dict[str, Any] = self._asdict()
        errors = {f"stderr_{name}": e for name, e in named.pop("stderr").items()}
        return {name: a for name, a in named.items() if a is not None} | errors


class Known(NamedTuple):
    """Known parameters of the material, and the start value of the exponent.

    (3,) each, and (1,) for a shared exponent.
    """

    ambient: Float[Array, "3"]
    diffuse: Float[Array, "3"]
    specular: Float[Array, "3"]
    shininess: Float[Array, " exponents"]

    def spread(self) -> "Known":
        """The values with an axis along the pixels, of length 1."""
        return Known(*(leaf[:, None] for leaf in self))


class Outside(NamedTuple):
    """Values that all pixels share: lights, known parameters, and the noise level.

    `noise` is the standard deviation of a sample in linear light, 1 if
    `settings.weighted`; not read if `settings.noise_given` is false.
    """

    lighting: Lighting
    known: Known
    noise: Float[Array, ""]
