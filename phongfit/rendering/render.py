"""A renderer is trace, terms, radiance and film; nothing more."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from phongfit.edge import checked
from phongfit.geometry.surfaces import GBuffer
from phongfit.material import Material
from phongfit.programs import program
from phongfit.rendering.film import Film
from phongfit.rendering.pixels import pixel_terms
from phongfit.scene import Scene


@checked
def render(
    scene: Scene,
    material: Material,
    *,
    film: Film | None = None,
    gbuffer: GBuffer | None = None,
) -> Float[Array, "height width 3"]:
    """An image of a scene: differentiable in every array, `jit`- and `vmap`-able.

    **Arguments:**

    - `scene`: geometry and lights.
    - `material`: parameters of shape () or (3,), maps of shape (height, width, 3) with
        Phong shading, or (M, 3) where the surface is made of M materials.
    - `film`: default clamps to [0, 1] and leaves the light linear.
    - `gbuffer`: from `scene.trace()`, to render the same geometry again at less cost.

    **Returns:** (height, width, 3), row 0 at the top, as the film stores it.
    """
    gbuffer = scene.trace() if gbuffer is None else gbuffer
    return _shade(scene, material, Film() if film is None else film, gbuffer)


@program()
def _shade(
    scene: Scene, material: Material, film: Film, gbuffer: GBuffer
) -> Float[Array, "height width 3"]:
    light = pixel_terms(scene, gbuffer).radiance(material)
    background = jnp.broadcast_to(scene.background, light.shape)
    return film.expose(jnp.where(gbuffer.mask[..., None], light, background))
