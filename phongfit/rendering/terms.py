r"""The one idea: with geometry, lights and f fixed, the image is linear in ρ.

$$I = \text{emission} + \rho_a A + \rho_d D + \rho_s S(f)$$
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from phongfit.geometry.surfaces import GBuffer
from phongfit.lights import AbstractLight
from phongfit.material import Material
from phongfit.reflectance import AbstractSpecular, lambert
from phongfit.scene import Scene
from phongfit.vectors import Vec3


class ShadingTerms(eqx.Module):
    """The basis images A and D, and what S(f) is made of, light by light.

    `batch` is () for one point, (N,) for samples, (height, width) for an image.
    """

    ambient: Float[Array, "*batch 3"]
    diffuse: Float[Array, "*batch 3"]
    cosine: Float[Array, "*batch lights"]
    strength: Float[Array, "*batch lights 3"]
    model: AbstractSpecular

    def specular(self, shininess: Float[Array, "..."]) -> Float[Array, "*batch 3"]:
        """Basis image S(f), for an exponent as a leaf of a [`Material`][]."""
        *batch, lights = self.cosine.shape
        channels = 1 if shininess.ndim == 0 else shininess.shape[-1]
        # One lobe serves all channels where they share the exponent.
        exponent = _spread("shininess", shininess, (*batch, channels))[..., None, :]
        exponent = jnp.broadcast_to(exponent, (*batch, lights, channels))
        lobe = self.model.lobe(self.cosine[..., None], exponent)
        return jnp.sum(self.strength * lobe, axis=-2)


ShadingTerms.__init__.__doc__ = """**Arguments:**

- `ambient`, `diffuse`: RGB for ρ = 1.
- `cosine`: of the angle from each light's highlight.
- `strength`: RGB of each light's highlight at its centre, for ρ_s = 1.
- `model`: turns `cosine` into the height of the highlight.
"""


def _spread(
    name: str, leaf: Float[Array, "..."], shape: tuple[int, ...]
) -> Float[Array, "..."]:
    """A leaf of a material, broadcast to `shape`, whose last axis is colour."""
    missing = len(shape) - leaf.ndim
    if missing < 0 or any(
        have not in (1, want)
        for have, want in zip(leaf.shape, shape[missing:], strict=True)
    ):
        raise ValueError(f"{name}: shape {leaf.shape} came, {shape} or less is wanted")
    return jnp.broadcast_to(leaf.reshape((1,) * missing + leaf.shape), shape)


def point_terms(
    lights: tuple[AbstractLight, ...],
    ambient: Vec3,
    model: AbstractSpecular,
    position: Vec3,
    normal: Vec3,
    to_viewer: Vec3,
) -> ShadingTerms:
    """The terms at one point.

    **Arguments:**

    - `lights`, `ambient`, `model`: as in [`Scene`][].
    - `position`: world units; `normal`, `to_viewer`: unit vectors.
    """
    diffuse = jnp.zeros_like(ambient)
    cosines, strengths = [], []
    for light in lights:
        arriving = light.illuminate(position)
        ambient = ambient + arriving.ambient
        share = model.diffuse_scale() * lambert(normal, arriving.to_light)
        diffuse = diffuse + share * arriving.intensity
        cosines.append(model.cosine(normal, arriving.to_light, to_viewer))
        strengths.append(arriving.specular)
    dtype = ambient.dtype
    return ShadingTerms(
        ambient=ambient,
        diffuse=diffuse,
        cosine=jnp.stack(cosines) if lights else jnp.zeros((0,), dtype),
        strength=jnp.stack(strengths) if lights else jnp.zeros((0, 3), dtype),
        model=model,
    )


@eqx.filter_jit
def terms(scene: Scene, gbuffer: GBuffer) -> ShadingTerms:
    """The terms of a scene, per pixel of a [`GBuffer`][] that was traced from it.

    Outside the buffer's mask they are finite and mean nothing.
    """

    def at(position: Vec3, normal: Vec3, to_viewer: Vec3) -> ShadingTerms:
        return point_terms(
            scene.lights, scene.ambient, scene.specular, position, normal, to_viewer
        )

    pixels = jax.vmap(jax.vmap(at))
    return pixels(gbuffer.position, gbuffer.normal, gbuffer.to_viewer)


def combine(terms: ShadingTerms, material: Material) -> Float[Array, "*batch 3"]:
    r"""$\text{emission} + \rho_a A + \rho_d D + \rho_s S(f)$, before any clamp.

    **Arguments:** `terms` of any batch shape; `material` whose leaves broadcast to it.

    **Returns:** linear RGB of the batch shape and 3.

    **Raises:** `ValueError` that names the leaf which does not broadcast.
    """
    shape = terms.diffuse.shape
    return (
        _spread("emission", material.emission, shape)
        + _spread("ambient", material.ambient, shape) * terms.ambient
        + _spread("diffuse", material.diffuse, shape) * terms.diffuse
        + _spread("specular", material.specular, shape)
        * terms.specular(material.shininess)
    )
