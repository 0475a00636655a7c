r"""Basis images: with geometry, lights and f fixed, the image is linear in ρ.

$$I = \text{emission} + \rho_a A + \rho_d D + \rho_s S(f)$$
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from phongfit.edge import checked
from phongfit.geometry.shading import PhongShading
from phongfit.geometry.surfaces import GBuffer
from phongfit.lights import AbstractLight
from phongfit.material import Material
from phongfit.programs import program
from phongfit.reflectance import AbstractSpecular, lambert
from phongfit.scene import Scene
from phongfit.vectors import Scalar, Vec3, normalize

# Largest number of lights whose terms are unrolled; for more, a loop compiles faster.
MAX_UNROLLED = 16


class ShadingTerms(eqx.Module):
    """The basis images A and D, and for each light the cosine and strength of S(f).

    S(f) is the sum over lights of `strength` times the model's lobe of `cosine`.
    `batch` is () for one point, (N,) for samples, faces or vertices, (height,
    width) for an image.

    **Fields:**

    - `ambient`, `diffuse`: RGB for ρ = 1.
    - `cosine`: cosine of the angle from each light's highlight; a named tuple if the
        lobe takes more numbers.
    - `strength`: RGB of each light's specular colour that arrives, by which the lobe is
        multiplied.
    - `model`: turns `cosine` into the height of the highlight.
    - `material_index`: which of `materials` each point is made of: a parameter of shape
        (M, 3) or (M, 1) is then M materials. `None` where there is one.
    - `exponents`: factor of a texture on the exponent; `None` without a texture.
    """

    ambient: Float[Array, "*batch 3"]
    diffuse: Float[Array, "*batch 3"]
    cosine: PyTree[Float[Array, "*batch lights"]]
    strength: Float[Array, "*batch lights 3"]
    model: AbstractSpecular
    material_index: Int[Array, "*batch"] | None = None
    exponents: Float[Array, "*batch"] | None = None
    materials: int = eqx.field(static=True, default=1)

    def specular(self, shininess: Float[Array, "..."]) -> Float[Array, "*batch rgb"]:
        """Basis image S(f), for exponents f as `shininess` of a [`Material`][].

        **Raises:** `ValueError` if their shape does not fit the points.
        """
        shininess = self.leaf("shininess", shininess)
        batch = self.strength.shape[:-2]
        channels = 1 if shininess.ndim == 0 else shininess.shape[-1]
        # Compute one lobe for all channels if they share the exponent.
        exponent = _spread("shininess", shininess, (*batch, channels))
        if self.exponents is not None:
            exponent = self.exponents[..., None] * exponent

        def add(total: Array, light: tuple[PyTree, Array]) -> tuple[Array, None]:
            cosine, strength = light
            cosine = jax.tree.map(lambda one: one[..., None], cosine)
            return total + strength * self.model.lobe(cosine, exponent), None

        # One by one: an innermost loop over a few lights is slow.
        cosines = jax.tree.map(lambda one: jnp.moveaxis(one, -1, 0), self.cosine)
        each = cosines, jnp.moveaxis(self.strength, -2, 0)
        none = jnp.zeros_like(self.diffuse)
        return jax.lax.scan(add, none, each, unroll=MAX_UNROLLED)[0]

    def leaf(self, name: str, leaf: Float[Array, "..."]) -> Float[Array, "..."]:
        """A material's parameter, or for many materials its value at each point.

        **Arguments:** `name`: of the parameter, for messages; `leaf`: its value.

        **Returns:** shape (batch…, 1 or 3) if `leaf` has a row for each material; else
        `leaf`.

        **Raises:** `ValueError` that names the parameter if it has too few rows.
        """
        if self.material_index is None or leaf.ndim != 2 or len(leaf) == 1:
            return leaf
        if len(leaf) < self.materials:
            raise ValueError(
                f"{name}: expected a row for each of the surface's {self.materials} "
                f"materials, got shape {leaf.shape}"
            )
        return leaf[self.material_index]


def _spread(
    name: str, leaf: Float[Array, "..."], shape: tuple[int, ...]
) -> Float[Array, "..."]:
    """A parameter of a material, broadcast to `shape`, whose last axis is colour.

    **Raises:** `ValueError` that names the parameter if that is not possible.
    """
    missing = len(shape) - leaf.ndim
    if missing < 0 or any(
        have not in (1, want)
        for have, want in zip(leaf.shape, shape[missing:], strict=True)
    ):
        raise ValueError(f"{name}: expected shape {shape} or less, got {leaf.shape}")
    return jnp.broadcast_to(leaf.reshape((1,) * missing + leaf.shape), shape)


def point_terms(
    lights: tuple[AbstractLight, ...],
    ambient: Vec3,
    model: AbstractSpecular,
    position: Vec3,
    normal: Vec3,
    to_viewer: Vec3,
    visibility: Float[Array, " lights"] | None = None,
) -> ShadingTerms:
    """Ambient and diffuse term at one point of a surface, and each light's highlight.

    **Arguments:**

    - `lights`, `ambient`, `model`: as in [`Scene`][].
    - `position`: world units; `normal`, `to_viewer`: unit vectors.
    - `visibility`: fraction of each light that reaches the point; default 1. The
        ambient colours of lights and light from all around are not shadowed.
    """
    dtype = ambient.dtype
    if visibility is None:
        visibility = jnp.ones(len(lights), dtype)

    def light_terms(light: AbstractLight, visible: Scalar) -> tuple[Any, ...]:
        """One light's ambient and diffuse term, cosine and strength."""
        arriving = light.illuminate(position)
        fraction = model.diffuse_scale() * lambert(normal, arriving.to_light)
        diffuse_light = visible * fraction * arriving.intensity
        return (
            arriving.ambient,
            diffuse_light if light.directed else diffuse_light + light.surround(normal),
            model.cosine(normal, arriving.to_light, to_viewer),
            visible * arriving.specular,
        )

    if len(lights) > MAX_UNROLLED:
        ambients, diffuses, cosine, strength = _vectorised_terms(
            light_terms, lights, visibility
        )
        ambient, diffuse = ambient + ambients.sum(axis=0), diffuses.sum(axis=0)
        return ShadingTerms(ambient, diffuse, cosine, strength, model)
    diffuse = jnp.zeros_like(ambient)
    cosines, strengths = [], []
    for light, visible in zip(lights, visibility, strict=True):
        ambient_k, diffuse_k, cosine_k, strength_k = light_terms(light, visible)
        ambient, diffuse = ambient + ambient_k, diffuse + diffuse_k
        cosines.append(cosine_k)
        strengths.append(strength_k)
    if lights:
        cosine = jax.tree.map(lambda *each: jnp.stack(each), *cosines)
    else:
        # No lights: an empty array for each number of the model's cosine.
        template = jax.eval_shape(model.cosine, normal, normal, to_viewer)
        cosine = jax.tree.map(lambda _: jnp.zeros((0,), dtype), template)
    return ShadingTerms(
        ambient=ambient,
        diffuse=diffuse,
        cosine=cosine,
        strength=jnp.stack(strengths) if lights else jnp.zeros((0, 3), dtype),
        model=model,
    )


def _vectorised_terms(
    light_terms: Callable[[AbstractLight, Scalar], tuple[Any, ...]],
    lights: tuple[AbstractLight, ...],
    visibility: Float[Array, " lights"],
) -> tuple[Any, ...]:
    """Terms of several lights, vectorised over lights of one kind.

    A loop over lights would compile each of them separately.

    **Arguments:** `light_terms`: from a light and its visibility to its terms.

    **Returns:** arrays of terms whose first axis runs over the lights.
    """
    kinds: dict[Any, list[int]] = {}
    for k, light in enumerate(lights):
        kinds.setdefault(jax.tree.structure(light), []).append(k)
    parts_of_kinds = []
    for numbers in kinds.values():
        alike = [lights[k] for k in numbers]
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *alike)
        parts_of_kinds.append(
            jax.vmap(light_terms)(stacked, visibility[np.array(numbers)])
        )
    # Back to the order of the lights.
    order = np.argsort([k for numbers in kinds.values() for k in numbers])
    return jax.tree.map(lambda *parts: jnp.concatenate(parts)[order], *parts_of_kinds)


@checked
@program()
def terms(scene: Scene, gbuffer: GBuffer) -> ShadingTerms:
    """Light for ρ = 1 at every point that a scene's shading method lights.

    The points are the pixels of the [`GBuffer`][] that was traced from the scene, or
    the faces or vertices of its mesh; [`pixel_terms`][] makes images of them. Outside
    the buffer's mask values are finite and without meaning.

    **Raises:** `ValueError` if the buffer was traced without the scene's shadows, or if
    a texture of the exponent does not go with the shading method.
    """
    points = scene.shading.points(scene.surface, scene.camera, gbuffer)

    def at(
        position: Vec3, normal: Vec3, to_viewer: Vec3, visibility: Array | None
    ) -> ShadingTerms:
        return point_terms(
            scene.lights,
            scene.ambient,
            scene.specular_model,
            position,
            normal,
            _to_viewer(scene, position, to_viewer),
            visibility,
        )

    for _ in points.position.shape[:-1]:
        at = jax.vmap(at)
    visibility = _visibility(scene, gbuffer, points.position.shape[:-1])
    computed = at(points.position, points.normal, points.to_viewer, visibility)
    return ShadingTerms(
        computed.ambient,
        computed.diffuse,
        computed.cosine,
        computed.strength,
        scene.specular_model,
        points.material_index,
        _exponents(scene, gbuffer),
        scene.surface.materials,
    )


def _exponents(scene: Scene, gbuffer: GBuffer) -> Float[Array, "*pixels"] | None:
    """Factor of a texture on each pixel's exponent; `None` without such a texture."""
    factor = scene.surface.exponents(gbuffer)
    if factor is not None:
        check_exponents(scene)
    return factor


def check_exponents(scene: Scene) -> None:
    """Check that textures of the exponent go with the shading method of a scene.

    **Raises:** `ValueError` for any other method than Phong shading.
    """
    if not isinstance(scene.shading, PhongShading):
        raise ValueError(
            "textures: a texture of the exponent needs Phong shading, got "
            f"{type(scene.shading).__name__}"
        )


def _to_viewer(scene: Scene, position: Vec3, to_viewer: Vec3) -> Vec3:
    """Unit vector to the viewer of highlights: see `local_viewer` of [`Scene`][].

    **Arguments:** `position`: a point; `to_viewer`: the camera's direction from there.
    """
    if scene.local_viewer is None:
        return to_viewer
    if scene.local_viewer:
        return normalize(scene.camera.position - position)
    # Infinitely far along the camera's z axis, which points back.
    return scene.camera.rotation[:, 2]


def _visibility(
    scene: Scene, gbuffer: GBuffer, points: tuple[int, ...]
) -> Float[Array, "*points lights"] | None:
    """The buffer's visibilities; `None` if the scene has no shadows.

    **Arguments:** `points`: shape of the points that are lit.

    **Raises:** `ValueError` if the buffer lacks them, or has them for other points.
    """
    if not scene.shadows:
        return None
    wanted = (*points, len(scene.lights))
    if gbuffer.visibility is None or gbuffer.visibility.shape != wanted:
        got = None if gbuffer.visibility is None else gbuffer.visibility.shape
        raise ValueError(
            f"gbuffer: expected visibility of shape {wanted} for the shadows of this "
            f"scene, got {got}: trace it with scene.trace()"
        )
    return gbuffer.visibility


@checked
def combine(terms: ShadingTerms, material: Material) -> Float[Array, "*batch rgb"]:
    r"""$\text{emission} + \rho_a A + \rho_d D + \rho_s S(f)$, before any clamp.

    **Arguments:** `terms`: of any batch shape; `material`: its parameters broadcast to
    the batch shape and 3, or have a row for each material in `terms`.

    **Returns:** linear RGB of the batch shape and 3.

    **Raises:** `ValueError` that names the parameter which does neither.
    """
    emission, ambient, diffuse, specular = parts(terms, material)
    return emission + ambient + diffuse + specular


def parts(
    terms: ShadingTerms, material: Material
) -> tuple[Float[Array, "*batch rgb"], ...]:
    """The terms that [`combine`][] adds: emission, ambient, diffuse, specular."""
    shape = terms.diffuse.shape

    def at_points(name: str, leaf: Float[Array, "..."]) -> Array:
        return _spread(name, terms.leaf(name, leaf), shape)

    return (
        at_points("emission", material.emission),
        at_points("ambient", material.ambient) * terms.ambient,
        at_points("diffuse", material.diffuse) * terms.diffuse,
        at_points("specular", material.specular) * terms.specular(material.shininess),
    )
