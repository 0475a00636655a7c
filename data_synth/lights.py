"""Lights spread around the camera, under which a fit identifies the whole material.

In world axes the camera stands at +z of the object and looks along −z.
"""

from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from phongfit import (
    AbstractLight,
    DirectionalLight,
    Film,
    Material,
    PointLight,
    Scene,
    SpotLight,
    render,
)
from phongfit.geometry import trace

LightKind = Literal["directional", "point", "spot", "mixed"]

WIDEST = np.deg2rad(60)
"""Largest angle between a light and +z, radians, so that the camera sees highlights."""

DISTANCE = 4.0
"""Distance of point and spot lights from the object's centre, in its radii."""

PEAK = 0.95
"""Value of the brightest sample before noise, where white is 1: nothing is clipped."""


def spread_directions(count: int) -> Float[np.ndarray, "count 3"]:
    """Unit vectors, spread evenly over the directions within 60° (`WIDEST`) of +z.

    ??? cite "Source"
        Swinbank and Purser, *Fibonacci grids: a novel approach to global modelling*,
        Q. J. R. Meteorol. Soc. 132, 2006.
    """
    steps = np.arange(count)
    z = 1 - (steps + 0.5) / count * (1 - np.cos(WIDEST))
    # The first direction is at the upper right, as is usual for a single lamp.
    azimuth = np.pi / 4 + steps * np.pi * (3 - np.sqrt(5))
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], axis=1)


def make_lights(
    count: int = 4,
    kind: LightKind = "directional",
    *,
    intensity: Any = 1.0,
    center: Any = (0.0, 0.0, 0.0),
    radius: float = 1.0,
) -> tuple[AbstractLight, ...]:
    """Lights around an object that is seen from +z.

    **Arguments:**

    - `count`: number of lights, ≥ 1.
    - `kind`: `"mixed"` cycles through directional, point and spot.
    - `intensity`: light that arrives at the object's centre from each of them, RGB or
        one number.
    - `center`, `radius`: of the object, world units. Point and spot lights stand 4
        radii from the centre, and spots point to it.

    **Raises:** `ValueError` that names the argument.
    """
    if count < 1:
        raise ValueError(f"lights: expected at least 1, got {count}")
    makers = {"directional": _directional, "point": _point, "spot": _spot}
    kinds = tuple(makers) if kind == "mixed" else (kind,)
    # Four digits are short to read in a file; lights scale directions to unit length.
    return tuple(
        makers[kinds[index % len(kinds)]](
            direction, intensity, np.asarray(center), radius
        )
        for index, direction in enumerate(spread_directions(count).round(4))
    )


def _directional(
    direction: np.ndarray, intensity: Any, center: np.ndarray, radius: float
) -> AbstractLight:
    """A directional light; all makers take the same arguments."""
    del center, radius
    return DirectionalLight(direction, intensity)


def _point(
    direction: np.ndarray, intensity: Any, center: np.ndarray, radius: float
) -> AbstractLight:
    """A point light 4 radii from `center`, where `intensity` arrives."""
    distance = DISTANCE * radius
    # The inverse-square law, with 1 at the object's centre.
    return PointLight(
        center + distance * direction, intensity, attenuation=(0, 0, distance**-2.0)
    )


def _spot(
    direction: np.ndarray, intensity: Any, center: np.ndarray, radius: float
) -> AbstractLight:
    """A spot 4 radii from `center`: it points there, and there `intensity` arrives."""
    distance = DISTANCE * radius
    # The object's rim is 14.5° off the cone's axis, so the cone's hard edge misses it:
    # at an edge, pixels would depend on rounding errors. At the rim the exponent leaves
    # half of the light.
    return SpotLight(
        center + distance * direction,
        -direction,
        intensity,
        cutoff=20.0,
        exponent=20.0,
        attenuation=(0, 0, distance**-2.0),
    )


def brightest_intensity(scenes: tuple[Scene, ...], material: Material) -> float:
    """Factor on the lights of all scenes that makes the brightest sample 0.95 (`PEAK`).

    **Arguments:** `scenes`: of one surface and one camera.

    **Returns:** the factor, rounded down to three digits; 1 if no light reaches any
    pixel.

    **Raises:** `ValueError` if a sample that lights reach is as bright as that by
    ambient light and emission alone.
    """
    gbuffer = trace(scenes[0].surface, scenes[0].camera)
    film = Film(clamp=False)
    factors = []
    for scene in scenes:
        unlit = Scene(scene.surface, scene.camera, ambient=scene.ambient)
        base = render(unlit, material, film=film, gbuffer=gbuffer)
        light = render(scene, material, film=film, gbuffer=gbuffer) - base
        lit = gbuffer.mask[..., None] & (light > 0)
        headroom = jnp.where(lit, (PEAK - base) / jnp.where(lit, light, 1), jnp.inf)
        factors.append(float(headroom.min()))
    factor = min(factors)
    if factor <= 0:
        raise ValueError(
            "ambient_light: expected less, or the intensity of the lights given: with "
            "the material's ambient and emission it is nearly white by itself"
        )
    # Three digits, rounded down, are easier to read in a file.
    unit = 10.0 ** (np.floor(np.log10(factor)) - 2) if np.isfinite(factor) else 1.0
    return float(np.floor(factor / unit) * unit) if np.isfinite(factor) else 1.0
