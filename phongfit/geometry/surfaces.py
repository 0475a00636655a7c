"""Surfaces: the point and the normal that each pixel sees, before any light."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from phongfit.checks import (
    as_floats,
    as_indices,
    as_positive,
    as_vector,
    finite,
    require,
)
from phongfit.edge import checked
from phongfit.geometry.cameras import AbstractCamera, Ray
from phongfit.geometry.grids import triangles
from phongfit.programs import program
from phongfit.textures import Factors
from phongfit.vectors import Vec3, dot, normalize, normalize_all


class GBuffer(eqx.Module):
    """Geometry buffer: the point of the surface that each pixel sees, and its normal.

    Outside `mask` the entries are finite placeholders.

    **Fields:**

    - `position`: world units.
    - `normal`, `to_viewer`: unit vectors in the world's axes, away from the surface.
    - `mask`: true where the pixel sees the surface.
    - `material_index`: which of several materials; `None` where there is one.
    - `surface_normal`: unit normal of the face itself where `normal` is interpolated;
        `None` where the two are the same.
    - `face`, `barycentrics`: index of the mesh's face, and the weights of its corners,
        which sum to 1; `None` for other surfaces.
    - `uv`: texture coordinates; `None` where the surface has no uv.
    - `visibility`: 1 where the light reaches the point and 0 in shadow, for each light
        at the points where the shading method lights the surface (pixels, faces,
        vertices); `None` without shadows.
    """

    position: Float[Array, "*pixels 3"]
    normal: Float[Array, "*pixels 3"]
    to_viewer: Float[Array, "*pixels 3"]
    mask: Bool[Array, "*pixels"]
    material_index: Int[Array, "*pixels"] | None = None
    surface_normal: Float[Array, "*pixels 3"] | None = None
    face: Int[Array, "*pixels"] | None = None
    barycentrics: Float[Array, "*pixels 3"] | None = None
    uv: Float[Array, "*pixels 2"] | None = None
    visibility: Float[Array, "*points lights"] | None = None

    @program()
    def select(self, pixels: Int[Array, " n"]) -> "GBuffer":
        """The buffer of some pixels, of shape (n,) in place of (H, W).

        **Arguments:** `pixels`: flat indices, row by row: y · width + x.
        """
        size = self.mask.shape

        def at(array: Any) -> Any:
            """Entries of the chosen pixels; `None` stays `None`."""
            if array is None:
                return None
            return array.reshape(-1, *array.shape[len(size) :])[pixels]

        fields = {
            field.name: getattr(self, field.name) for field in dataclasses.fields(self)
        }
        seen = fields.pop("visibility")
        # Flat and Gouraud shading have visibilities of faces or vertices, not pixels.
        per_pixel = seen is not None and seen.shape[:-1] == size
        chosen = {name: at(array) for name, array in fields.items()}
        return GBuffer(**chosen, visibility=at(seen) if per_pixel else seen)


class AbstractSurface(eqx.Module):
    """Base class of surfaces: `trace` gives the [`GBuffer`][] of a camera.

    `on_host` is true if `trace` calls a library outside JAX. It is then faster outside
    of compiled programs.
    """

    on_host: ClassVar[bool] = False

    @abc.abstractmethod
    def trace(self, camera: AbstractCamera) -> GBuffer:
        """The point of this surface that each pixel of `camera` sees."""

    @abc.abstractmethod
    def reached(
        self,
        position: Float[Array, "*batch 3"],
        normal: Float[Array, "*batch 3"],
        to_light: Float[Array, "*batch 3"],
        distance: Float[Array, "*batch"],
    ) -> Bool[Array, "*batch"]:
        """Whether light reaches points of the surface without being blocked by it.

        **Arguments:**

        - `position`, `normal`: points and their unit normals, of any batch shape.
        - `to_light`, `distance`: unit vector to the light and how far away it is, world
            units (may be inf).

        **Raises:** `ValueError` if this surface cannot compute shadows.
        """

    @property
    def materials(self) -> int:
        """Number of materials of the surface."""
        return 1

    def factors(self, gbuffer: GBuffer) -> Factors | None:
        """Factors of the colour textures at each pixel; `None` without textures."""
        del gbuffer
        return None

    def exponents(self, gbuffer: GBuffer) -> Float[Array, "*pixels"] | None:
        """Factor of a texture on each pixel's exponent; `None` without one."""
        del gbuffer
        return None


def trace_rays(
    intersect: Callable[[Ray], tuple[Vec3, Vec3, Bool[Array, ""]]],
    camera: AbstractCamera,
) -> GBuffer:
    """The geometry buffer of a surface, from its intersection with one ray.

    **Arguments:** `intersect`: returns the position, the unit normal there, and whether
    the ray meets the surface; finite placeholders where it does not.
    """
    position, normal, mask = jax.vmap(jax.vmap(intersect))(camera.rays())
    to_viewer = jax.vmap(jax.vmap(camera.to_viewer))(position)
    return GBuffer(position, normal, to_viewer, mask)


class Sphere(AbstractSurface):
    """A ball with exact normals, seen from outside."""

    center: Float[Array, "3"]
    radius: Float[Array, ""]

    def __init__(self, center: Any = (0.0, 0.0, 0.0), radius: Any = 1.0):
        """**Arguments:** `center` of shape (3,) and `radius` > 0, in world units.

        **Raises:** `ValueError` that names the argument.
        """
        self.center = as_vector("center", center)
        self.radius = as_positive("radius", radius)

    def intersect(self, ray: Ray) -> tuple[Vec3, Vec3, Bool[Array, ""]]:
        """The first intersection of one ray with the sphere, from outside.

        **Returns:** position, unit normal, and whether there is one; if not, the first
        two are finite placeholders.
        """
        offset = ray.origin - self.center
        # Distance from the centre to the ray, squared, as a vector rejection: the
        # textbook's b² − 4ac cancels badly for a far camera in float32.
        along = dot(offset, ray.direction)
        nearest = offset - along * ray.direction
        discriminant = self.radius**2 - dot(nearest, nearest)
        hit = discriminant > 0
        half_chord = jnp.sqrt(jnp.where(hit, discriminant, 1))
        distance = -along - half_chord
        hit = hit & (distance > 0)
        normal = (nearest - half_chord * ray.direction) / self.radius
        normal = jnp.where(hit, normalize(normal), -ray.direction)
        position = jnp.where(hit, self.center + self.radius * normal, self.center)
        return position, normal, hit

    @checked
    @program()
    def trace(self, camera: AbstractCamera) -> GBuffer:
        return trace_rays(self.intersect, camera)

    def reached(
        self,
        position: Float[Array, "*batch 3"],
        normal: Float[Array, "*batch 3"],
        to_light: Float[Array, "*batch 3"],
        distance: Float[Array, "*batch"],
    ) -> Bool[Array, "*batch"]:
        del position
        # From a point whose normal faces away from the light, the ray to the light
        # first crosses the sphere: its chord is -2 r (normal · to_light) long. A light
        # before the chord's end is inside the sphere, where nothing blocks it.
        chord = -2 * self.radius * jnp.sum(normal * to_light, axis=-1)
        return (chord <= 0) | (distance <= chord)


class NormalMap(AbstractSurface):
    """A normal for every pixel, as photometric stereo and scanners give it.

    With positions it casts shadows: two triangles join every four neighbouring pixels.
    """

    normals: Float[Array, "height width 3"]
    mask: Bool[Array, "height width"]
    positions: Float[Array, "height width 3"] | None
    material_index: Int[Array, "height width"] | None
    _materials: int = eqx.field(static=True)

    @checked
    def __init__(
        self,
        normals: Any,
        mask: Any = None,
        positions: Any = None,
        material_index: Any = None,
    ):
        """**Arguments:**

        - `normals`: (H, W, 3), in the world's axes; any length. A zero normal is
            outside the surface.
        - `mask`: (H, W), true where there is surface; default everywhere. Outside of
            it normals and positions may be NaN.
        - `positions`: (H, W, 3), world units. Without them only directional and
            harmonic lights and an orthographic camera can be used, for which positions
            do not matter; and neither fog nor shadows.
        - `material_index`: (H, W) whole numbers ≥ 0: which of several materials;
            default one material.

        **Raises:** `ValueError` that names the argument.
        """
        normals = as_floats("normals", normals)
        if normals.ndim != 3 or normals.shape[-1] != 3:
            raise ValueError(
                f"normals: expected shape (height, width, 3), got {normals.shape}"
            )
        size = normals.shape[:2]
        mask = jnp.ones(size, bool) if mask is None else as_floats("mask", mask) != 0
        if mask.shape != size:
            raise ValueError(f"mask: expected shape {size}, got {mask.shape}")
        if positions is not None:
            positions = as_floats("positions", positions)
            if positions.shape != normals.shape:
                raise ValueError(
                    f"positions: expected shape {normals.shape}, got {positions.shape}"
                )

        def finite_inside(name: str, array: Array) -> Array:
            array = jnp.where(mask[..., None], array, 0)
            wanted = "finite numbers inside the mask"
            return require(name, array, finite, wanted)

        normals = normalize_all(finite_inside("normals", normals))
        self.mask = mask & jnp.any(normals != 0, axis=-1)
        inside = self.mask[..., None]
        placeholder = jnp.broadcast_to(jnp.array([0, 0, 1], normals.dtype), (*size, 3))
        self.normals = jnp.where(inside, normals, placeholder)
        if positions is not None:
            positions = jnp.where(inside, finite_inside("positions", positions), 0)
        self.positions = positions
        self.material_index, self._materials = as_indices(
            "material_index", material_index, size
        )

    @checked
    @program()
    def trace(self, camera: AbstractCamera) -> GBuffer:
        if self.mask.shape != (camera.height, camera.width):
            raise ValueError(
                f"surface: expected a normal map of ({camera.height}, {camera.width}) "
                f"pixels, as the camera has, got {self.mask.shape}"
            )
        if self.positions is not None:
            positions = self.positions
        elif camera.parallel:
            positions = jnp.zeros_like(self.normals)
        else:
            raise ValueError(
                "surface: a normal map without positions needs an orthographic camera"
            )
        to_viewer = jax.vmap(jax.vmap(camera.to_viewer))(positions)
        return GBuffer(
            positions, self.normals, to_viewer, self.mask, self.material_index
        )

    def reached(
        self,
        position: Float[Array, "*batch 3"],
        normal: Float[Array, "*batch 3"],
        to_light: Float[Array, "*batch 3"],
        distance: Float[Array, "*batch"],
    ) -> Bool[Array, "*batch"]:
        del normal
        if self.positions is None:
            raise ValueError(
                "shadows: expected a normal map with positions, since cast shadows "
                "depend on them"
            )
        surface = triangles(self.positions, self.mask)
        return ~surface.shadowed(position, to_light, distance)

    @property
    def materials(self) -> int:
        return self._materials
