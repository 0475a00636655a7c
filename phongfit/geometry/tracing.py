"""Tracing of a scene's geometry, once for all its renders and all steps of a fit."""

from collections.abc import Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from phongfit.edge import checked
from phongfit.geometry.cameras import AbstractCamera
from phongfit.geometry.shading import AbstractShading, LightingPoints, PhongShading
from phongfit.geometry.surfaces import AbstractSurface, GBuffer
from phongfit.lights import AbstractLight
from phongfit.programs import program


@checked
def trace(
    surface: AbstractSurface,
    camera: AbstractCamera,
    lights: Iterable[AbstractLight] = (),
    *,
    shadows: bool = False,
    shading: AbstractShading | None = None,
) -> GBuffer:
    """The points of `surface` that the pixels of `camera` see: a [`GBuffer`][].

    Differentiable in all arrays, except for which pixels see the surface and which
    points lie in shadow. [`Scene`][]`.trace()` does this for a scene.

    **Arguments:**

    - `surface`, `camera`: the object, and the camera that sees it.
    - `lights`: those for which shadows are computed, in the scene's order.
    - `shadows`: whether to compute which lights reach the points that are lit.
    - `shading`: the method that chooses these points; default [`PhongShading`][], which
        lights each pixel's point.

    **Raises:** `ValueError` if surface and camera do not fit together, or the surface
    cannot compute shadows.
    """
    gbuffer = surface.trace(camera)
    covered = camera.covered()
    if covered is not None:
        gbuffer = eqx.tree_at(lambda g: g.mask, gbuffer, gbuffer.mask & covered)
    if not shadows:
        return gbuffer
    shading = PhongShading() if shading is None else shading
    points = shading.points(surface, camera, gbuffer)
    return eqx.tree_at(
        lambda g: g.visibility,
        gbuffer,
        visibility(surface, tuple(lights), points),
        is_leaf=lambda leaf: leaf is None,
    )


def visibility(
    surface: AbstractSurface, lights: tuple[AbstractLight, ...], points: LightingPoints
) -> Float[Array, "*points lights"]:
    """1 where a light reaches a point of the surface, 0 in a hard shadow.

    **Arguments:** `points`: the points that the shading method lights.
    """
    *batch, _ = points.position.shape
    seen = []
    for light in lights:
        to_light, distance = towards(light, points.position)
        seen.append(
            surface.reached(points.position, points.surface_normal, to_light, distance)
        )
    if not seen:
        return jnp.zeros((*batch, 0), points.position.dtype)
    return jnp.stack(seen, axis=-1).astype(points.position.dtype)


@program()
def towards(
    light: AbstractLight, position: Float[Array, "*points 3"]
) -> tuple[Float[Array, "*points 3"], Float[Array, "*points"]]:
    """Unit vectors from each position to a light, and distances; inf if it is distant.

    **Arguments:** `position`: world units, as are the distances.
    """
    illumination = jax.vmap(light.illuminate)(position.reshape(-1, 3))
    to_light = illumination.to_light.reshape(position.shape)
    return to_light, illumination.distance.reshape(position.shape[:-1])
