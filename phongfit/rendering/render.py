"""Rendering: trace the geometry, compute terms and radiance, apply the film."""

import dataclasses
import math
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from phongfit.edge import checked
from phongfit.geometry.surfaces import GBuffer, NormalMap
from phongfit.material import Material
from phongfit.programs import program
from phongfit.rendering.film import Film
from phongfit.rendering.pixels import pixel_terms
from phongfit.scene import Scene

DEFAULT_FILM = Film()
"""The default film. It is made once, since making one for each call takes longer than
rendering a small image."""


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
    - `material`: parameters of shape (), (1,) or (3,); maps of shape (height, width, 1
        or 3) with Phong shading; or (M, 1 or 3) where the surface is made of M
        materials.
    - `film`: default clamps to [0, 1] and leaves the light linear.
    - `gbuffer`: from `scene.trace()`, to render the same geometry again at less cost;
        default: it is traced.
    - `samples`: rays through a pixel, 1, 4, 9, …: their light is averaged before the
        film, which smooths outlines and textures. The default is one ray through the
        pixel's centre, as in [`fit`][].

    **Returns:** (height, width, 3) after the film, row 0 at the top.

    **Raises:** `ValueError` that names `samples`, if it is not a square, or above 1
    with a `gbuffer` or a normal map; or that names a parameter of `material` whose
    shape does not fit.
    """
    side = math.isqrt(samples) if samples > 0 else 0
    if side < 1 or side**2 != samples:
        raise ValueError(f"samples: expected 1, 4, 9 or another square, got {samples}")
    if side > 1:
        if gbuffer is not None:
            raise ValueError(
                "samples: expected 1 with a gbuffer, which has one ray for each pixel"
            )
        if isinstance(scene.surface, NormalMap):
            raise ValueError(
                "samples: expected 1 for a normal map, with one normal per pixel"
            )
        camera = scene.camera.finer(side)
        scene = dataclasses.replace(scene, camera=camera)
    gbuffer = scene.trace() if gbuffer is None else gbuffer
    film = DEFAULT_FILM if film is None else film
    return _shade(scene, material, film, gbuffer, side)


@program("side")
def _shade(
    scene: Scene, material: Material, film: Film, gbuffer: GBuffer, side: int
) -> Float[Array, "height width 3"]:
    """The image of a traced scene; `side` × `side` pixels are averaged into one."""
    light = pixel_terms(scene, gbuffer).radiance(material)
    background = jnp.broadcast_to(scene.background, light.shape)
    light = jnp.where(gbuffer.mask[..., None], light, background)
    return film.expose(block_means(light, side) if side > 1 else light)


def block_means(image: Any, side: int) -> Any:
    """An image of linear light, averaged over blocks of `side` × `side` pixels.

    **Arguments:** `image`: (height, width, channels), of NumPy or JAX; rows and columns
    beyond whole blocks are left out.
    """
    height, width = (size // side for size in image.shape[:2])
    whole = image[: height * side, : width * side]
    return whole.reshape(height, side, width, side, -1).mean(axis=(1, 3))
