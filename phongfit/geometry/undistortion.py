"""Removal of lens distortion from photographs, for programs without lens models."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Array, Bool, Float

from phongfit.checks import as_floats
from phongfit.edge import checked
from phongfit.geometry.cameras import PinholeCamera, over_pixels
from phongfit.programs import program
from phongfit.vectors import Scalar


class Undistorted(NamedTuple):
    """A photograph without lens distortion, from [`undistort`][].

    - `image`: of the shape of the photograph; 0 where `mask` is false. If the camera
        has no distortion, the photograph itself, also where `mask` is false.
    - `mask`: true where the image is known.
    - `camera`: the camera of this image, without distortion.
    """

    image: Float[np.ndarray, "height width *channels"]
    mask: Bool[np.ndarray, "height width"]
    camera: PinholeCamera


@checked
def undistort(image: Any, camera: PinholeCamera, *, mask: Any = None) -> Undistorted:
    """Remove the lens distortion from a photograph.

    This is for other programs and for pictures. Fits do not need it: a
    [`PinholeCamera`][] with its `distortion` fits the photograph as it is.
    Interpolation averages pixels, which lowers the noise and correlates neighbours; a
    fit of such an image warns of lack of fit.

    **Arguments:**

    - `image`: (H, W) or (H, W, channels), linear light.
    - `camera`: the camera that took the photograph.
    - `mask`: (H, W), true where a pixel may be used; default everywhere.

    **Returns:** image, mask and camera: see [`Undistorted`][]. Bilinear interpolation,
    as OpenCV's `undistort` has it; the camera keeps its focal lengths and principal
    point. A pixel is known if all four pixels that it is interpolated from are usable.

    **Raises:** `ValueError` that names the argument.
    """
    pixels = as_floats("image", image)
    size = (camera.height, camera.width)
    if pixels.ndim not in (2, 3) or pixels.shape[:2] != size:
        raise ValueError(
            f"image: expected shape {size}, as the camera has pixels, perhaps with "
            f"channels, got {pixels.shape}"
        )
    usable = jnp.ones(size, bool) if mask is None else as_floats("mask", mask) != 0
    if usable.shape != size:
        raise ValueError(f"mask: expected shape {size}, got {usable.shape}")
    straight = eqx.tree_at(
        lambda c: c.distortion, camera, None, is_leaf=lambda leaf: leaf is None
    )
    if camera.distortion is None:
        return Undistorted(np.array(pixels), np.array(usable), straight)
    resampled, known = _resample(pixels.reshape(*size, -1), usable, camera)
    return Undistorted(
        np.asarray(resampled).reshape(pixels.shape), np.asarray(known), straight
    )


@program()
def _resample(
    image: Float[Array, "height width channels"],
    usable: Bool[Array, "height width"],
    camera: PinholeCamera,
) -> tuple[Float[Array, "height width channels"], Bool[Array, "height width"]]:
    """The image that a camera without distortion would take, and where it is known."""
    lens = camera.distortion
    assert lens is not None

    def source(x: Scalar, y: Scalar) -> tuple[Scalar, Scalar]:
        """Row and column in the photograph for an image point without distortion."""
        place = camera.place_of(x, y)
        direction = jnp.append(place, jnp.ones_like(x))
        bent = lens.place(direction)
        column, row = camera.pixel_of(bent)
        # Rows and columns count from the centre of the first pixel, at (0.5, 0.5).
        return row - 0.5, column - 0.5

    # NaN where the lens has no image of the direction: taken from outside the image.
    row, column = (jnp.nan_to_num(at, nan=-2.0) for at in over_pixels(source, camera))
    known = _interpolate((~usable).astype(image.dtype), row, column, 1.0) == 0
    image = jnp.where(usable[..., None], image, 0)
    channels = jax.vmap(lambda channel: _interpolate(channel, row, column, 0.0), -1, -1)
    return jnp.where(known[..., None], channels(image), 0), known


def _interpolate(
    channel: Float[Array, "height width"],
    row: Float[Array, "height width"],
    column: Float[Array, "height width"],
    outside: float,
) -> Float[Array, "height width"]:
    """Bilinear interpolation at rows and columns; the value `outside` beyond edges."""
    return map_coordinates(channel, [row, column], 1, "constant", outside)
