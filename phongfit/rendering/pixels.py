"""Light of each pixel, from light at the points that the shading method lights."""

import math
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from phongfit.edge import checked
from phongfit.geometry.shading import Interpolation
from phongfit.geometry.surfaces import GBuffer
from phongfit.material import Material
from phongfit.programs import program
from phongfit.reflectance import AbstractSpecular
from phongfit.rendering.terms import ShadingTerms, combine, parts, terms
from phongfit.scene import Scene
from phongfit.textures import COLOURED, Factors

T = TypeVar("T")


class Haze(eqx.Module):
    """Fog at each pixel: the transmitted fraction of light, and the fog's colour."""

    transmittance: Float[Array, "*batch 1"]
    color: Float[Array, "*batch 3"]

    def __call__(self, light: Float[Array, "*batch rgb"]) -> Float[Array, "*batch rgb"]:
        """Light that reaches the camera, from light that leaves the surface."""
        return self.transmittance * light + (1 - self.transmittance) * self.color


class PixelTerms(eqx.Module):
    r"""Everything an image depends on except the material: geometry, lights and fog.

    [`PixelTerms.radiance`][] is a pure function of the material: light at the points,
    clamped there if the shading method clamps, interpolated, and mixed with fog. Unless
    clamped it is linear in the reflectances and the emission, plus the fog's light.

    **Fields:**

    - `terms`: terms of the light at the points that are lit.
    - `interpolation`: from the points to the pixels; `None` if the points are the
        pixels.
    - `haze`: fog per pixel; `None` without.
    - `clamp`: whether light is cut off at 1 at the points, before interpolation and
        fog.
    - `factors`: factors of the textures at each pixel; `None` without textures.
    """

    terms: ShadingTerms
    interpolation: Interpolation | None
    haze: Haze | None
    clamp: bool = eqx.field(static=True)
    factors: Factors | None = None

    def radiance(self, material: Material) -> Float[Array, "*batch rgb"]:
        """Linear RGB of every pixel, before the film's clamp.

        Outside the surface's mask the numbers have no meaning.

        **Raises:** `ValueError` if the material's parameters do not fit: see
        [`combine`][].
        """
        if self.factors is None:
            light = combine(self.terms, material)
            if self.clamp:
                light = jnp.clip(light, 0, 1)
            if self.interpolation is not None:
                light = self.interpolation(light)
        else:
            light = self._textured(material, self.factors)
        return light if self.haze is None else self.haze(light)

    def _textured(
        self, material: Material, factors: Factors
    ) -> Float[Array, "*batch rgb"]:
        """Sum of the four terms of the light, each times its texture at the pixel."""
        light = jnp.zeros_like(factors.diffuse)
        # In the order of `parts`.
        each = factors.emission, factors.ambient, factors.diffuse, factors.specular
        for factor, part in zip(each, parts(self.terms, material), strict=True):
            to_pixels = self.interpolation
            light += factor * (part if to_pixels is None else to_pixels(part))
        return light

    def basis(self, shininess: Float[Array, "..."]) -> Float[Array, "*batch rgb 4"]:
        """Basis images: radiance for ρ = 1 of ambient, diffuse, specular and emission.

        The last axis has them in this order. Their sum, weighted by the material's
        parameters, plus [`PixelTerms.fog_light`][] is the whole image, unless the
        shading method clamps light at its points.

        **Arguments:** `shininess`: as a parameter of a [`Material`][].
        """
        at_points = (
            self.terms.ambient,
            self.terms.diffuse,
            self.terms.specular(shininess),
            jnp.ones_like(self.terms.diffuse),
        )
        images = [self._to_pixels(values) for values in at_points]
        if self.factors is not None:
            each = [getattr(self.factors, name) for name in COLOURED]
            images = [one * by for one, by in zip(images, each, strict=True)]
        return jnp.stack(images, axis=-1)

    def fog_light(self) -> Float[Array, "*batch rgb"]:
        """RGB that the fog adds to each pixel; 0 without fog."""
        dark = jnp.zeros_like(self._to_pixels(self.terms.diffuse))
        return dark if self.haze is None else self.haze(dark)

    def material_index(self) -> Int[Array, "*batch"] | None:
        """Index of each pixel's material; `None` if there is only one."""
        index = self.terms.material_index
        if index is None or self.interpolation is None:
            return index
        # All points that a pixel interpolates belong to one face, so to one material.
        return index[self.interpolation.index[..., 0]]

    def _to_pixels(
        self, values: Float[Array, "*points rgb"]
    ) -> Float[Array, "*batch rgb"]:
        """Values at the points interpolated to the pixels, times the transmittance."""
        if self.interpolation is not None:
            values = self.interpolation(values)
        return values if self.haze is None else self.haze.transmittance * values

    def select(self, pixels: Int[Array, " n"]) -> "PixelTerms":
        """The terms of some pixels: the batch shape becomes (n,).

        Faces and vertices that these pixels do not show are dropped, unless `pixels` is
        traced.

        **Arguments:** `pixels`: flat indices, row by row: y · width + x.
        """
        whole = self.interpolation, self.haze, self.factors
        interpolation, haze, factors = _select_rows(whole, pixels)
        if interpolation is None:
            chosen = _select_points(self.terms, pixels)
        elif isinstance(interpolation.index, Tracer):
            chosen = self.terms
        else:
            corners = np.asarray(interpolation.index)
            used, renumbered = np.unique(corners, return_inverse=True)
            index = jnp.asarray(renumbered.reshape(corners.shape).astype(np.int32))
            interpolation = Interpolation(index, interpolation.weight)
            # `resize` repeats points, to which no index refers.
            chosen = _select_points(
                self.terms, jnp.asarray(np.resize(used, _padded_count(used)))
            )
        return PixelTerms(chosen, interpolation, haze, self.clamp, factors)


def with_model(terms: T, model: AbstractSpecular | None) -> T:
    """Terms with another specular model, or with `None` in its place.

    `None` is for selecting points from all arrays, since the model's arrays have no
    axis of points.

    **Arguments:** `terms`: [`ShadingTerms`][], or an object that has them as `terms`.
    """

    def model_of(part: Any) -> Any:
        return getattr(part, "terms", part).model

    return eqx.tree_at(model_of, terms, model, is_leaf=lambda leaf: leaf is None)


def _padded_count(used: np.ndarray) -> int:
    """Number of points rounded up to a power of 2 ≥ 64: fewer sizes to compile for."""
    return 2 ** int(max(len(used) - 1, 63)).bit_length()


@program()
def _select_rows(arrays: T, pixels: Int[Array, " n"]) -> T:
    """Select pixels, by flat indices, from arrays of all pixels."""
    return jax.tree.map(lambda a: a.reshape(-1, a.shape[-1])[pixels], arrays)


@program()
def _select_points(terms: ShadingTerms, index: Int[Array, " n"]) -> ShadingTerms:
    """Select points, by flat indices, from terms of all points."""
    *batch, _ = terms.diffuse.shape
    # Not `reshape(-1, …)`: without lights, some arrays are empty.
    points = math.prod(batch)

    def at(array: Any) -> Array:
        return array.reshape(points, *array.shape[len(batch) :])[index]

    return with_model(jax.tree.map(at, with_model(terms, None)), terms.model)


@checked
@program()
def pixel_terms(scene: Scene, gbuffer: GBuffer) -> PixelTerms:
    """Everything the image of a scene depends on, except the material.

    **Arguments:** `gbuffer`: from `scene.trace()`. Outside its mask the pixels are
    finite and mean nothing.

    **Raises:** `ValueError` if the buffer was traced without the scene's shadows, or if
    textures do not go with the shading method.
    """
    haze = None
    if scene.fog is not None:
        depth = scene.camera.depth
        for _ in gbuffer.position.shape[:-1]:
            depth = jax.vmap(depth)
        depth = depth(gbuffer.position)
        color = jnp.broadcast_to(scene.fog.color, (*depth.shape, 3))
        haze = Haze(scene.fog.transmittance(depth)[..., None], color)
    return PixelTerms(
        terms(scene, gbuffer),
        scene.shading.interpolation(scene.surface, gbuffer),
        haze,
        scene.shading.clamp,
        _factors(scene, gbuffer),
    )


def _factors(scene: Scene, gbuffer: GBuffer) -> Factors | None:
    """Factors of the textures at each pixel; `None` without textures.

    **Raises:** `ValueError` if the shading method clamps, before textures multiply.
    """
    factors = scene.surface.factors(gbuffer)
    if factors is not None and scene.shading.clamp:
        raise ValueError(
            "shading: expected clamp=False with textures, which multiply the pixels"
        )
    return factors


def resolve(scene: Scene) -> tuple[GBuffer, PixelTerms]:
    """The traced geometry of a scene, and the [`pixel_terms`][] of all pixels."""
    gbuffer = scene.trace()
    return gbuffer, pixel_terms(scene, gbuffer)


def resolve_terms(scene: Scene) -> tuple[Bool[Array, "height width"], PixelTerms]:
    """Mask of the pixels that see the surface, and the [`pixel_terms`][] of all.

    One compiled program if the surface is traced by JAX, so that positions and normals
    are not stored.
    """
    if scene.surface.on_host:
        return _mask_and_terms(scene)
    return _compiled_mask_and_terms(scene)


def _mask_and_terms(scene: Scene) -> tuple[Bool[Array, "height width"], PixelTerms]:
    """[`resolve_terms`][], for either way of calling it."""
    gbuffer, pixels = resolve(scene)
    return gbuffer.mask, pixels


_compiled_mask_and_terms = program()(_mask_and_terms)
