"""Geometry is resolved once; every render and every step of a fit reuses it."""

import equinox as eqx

from phongfit.geometry.cameras import AbstractCamera
from phongfit.geometry.surfaces import AbstractSurface, GBuffer


@eqx.filter_jit
def trace(surface: AbstractSurface, camera: AbstractCamera) -> GBuffer:
    """What each pixel of `camera` sees of `surface`: see [`GBuffer`][].

    Differentiable in the arrays of both, except for which pixels see the surface.

    **Raises:** `ValueError` if the two do not fit together.
    """
    return surface.trace(camera)
