"""A renderer is trace, terms, radiance and film; nothing more."""

import dataclasses
import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from phongfit.edge import checked
from phongfit.geometry.surfaces import GBuffer, NormalMap
from phongfit.material import Material
from phongfit.programs import program
from phongfit.rendering.film import Film
from phongfit.rendering.pixels import pixel_terms
from phongfit.scene import Scene

PLAIN = Film()
"""Where none is given. Made once: to make and hand over a new one takes longer than to
render a small image."""


@checked
def render(
    scene: Scene,
    material: Material,
    *,
    film: Film | None = None,
    gbuffer: GBuffer | None = None,
    samples: int = 1,
) -> Float[Array, "height width 3"]:
    """An image of a scene: differentiable in every array, `jit`- and `vmap`-able.

    **Arguments:**

    - `scene`: geometry and lights.
    - `material`: parameters of shape () or (3,), maps of shape (height, width, 3) with
        Phong shading, or (M, 3) where the surface is made of M materials.
    - `film`: default clamps to [0, 1] and leaves the light linear.
    - `gbuffer`: from `scene.trace()`, to render the same geometry again at less cost.
    - `samples`: rays through a pixel, 1, 4, 9, …: their mean light is what the film
        gets, so that outlines and textures are smooth. By default one ray, through the
        pixel's centre, as fits see it.

    **Returns:** (height, width, 3), row 0 at the top, as the film stores it.

    **Raises:** `ValueError` that names the argument.
    """
    times = math.isqrt(samples) if samples > 0 else 0
    if times < 1 or times**2 != samples:
        raise ValueError(f"samples: expected 1, 4, 9 or another square, got {samples}")
    if times > 1:
        if gbuffer is not None:
            raise ValueError("samples: a gbuffer has one ray through each pixel")
        if isinstance(scene.surface, NormalMap):
            raise ValueError("samples: expected 1 of a normal map, which has pixels")
        camera = scene.camera.finer(times)
        scene = dataclasses.replace(scene, camera=camera)
    gbuffer = scene.trace() if gbuffer is None else gbuffer
    film = PLAIN if film is None else film
    return _shade(scene, material, film, gbuffer, times)


@program("times")
def _shade(
    scene: Scene, material: Material, film: Film, gbuffer: GBuffer, times: int
) -> Float[Array, "height width 3"]:
    light = pixel_terms(scene, gbuffer).radiance(material)
    background = jnp.broadcast_to(scene.background, light.shape)
    light = jnp.where(gbuffer.mask[..., None], light, background)
    if times > 1:
        rows, columns, channels = light.shape
        apart = rows // times, times, columns // times, times, channels
        light = jnp.mean(light.reshape(apart), axis=(1, 3))
    return film.expose(light)
