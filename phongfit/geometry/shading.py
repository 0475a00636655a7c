"""Shading methods: where a surface is lit, and how that light spreads to the pixels.

Light at the chosen points is linear in the reflectances, and interpolation keeps it so:
with each method the image is linear in them, unless light is clamped at the points.
"""

import abc
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from equinox import AbstractVar
from jaxtyping import Array, Float, Int

from phongfit.edge import check_fields, checked
from phongfit.geometry.cameras import AbstractCamera
from phongfit.geometry.meshes import Mesh
from phongfit.geometry.surfaces import AbstractSurface, GBuffer
from phongfit.textures import weighted_sum

FacePoint = Literal["centroid", "last_vertex"]


class LightingPoints(eqx.Module):
    """Points at which lighting is evaluated: pixels, faces or vertices.

    **Fields:**

    - `position`: world units.
    - `normal`: the unit normal that lighting uses.
    - `surface_normal`: unit normal of the surface itself, along which the start of
        shadow rays is moved off the surface.
    - `to_viewer`: unit vectors from the surface.
    - `material_index`: which of several materials; `None` where there is one.
    """

    position: Float[Array, "*points 3"]
    normal: Float[Array, "*points 3"]
    surface_normal: Float[Array, "*points 3"]
    to_viewer: Float[Array, "*points 3"]
    material_index: Int[Array, "*points"] | None


class Interpolation(eqx.Module):
    """Each pixel's value as a weighted sum of values at a few points.

    **Fields:**

    - `index`: for each pixel, the indices of its points.
    - `weight`: their weights, which sum to 1.
    """

    index: Int[Array, "*batch corners"]
    weight: Float[Array, "*batch corners"]

    def __call__(
        self, values: Float[Array, "points channels"]
    ) -> Float[Array, "*batch channels"]:
        """Values at the pixels, from values at all points."""
        return weighted_sum(values, self.index, self.weight)


class AbstractShading(eqx.Module):
    """Base class of shading methods: choose the points that are lit, and interpolate.

    `clamp`: whether light is cut off at 1 at these points, before interpolation.
    """

    clamp: AbstractVar[bool]

    @abc.abstractmethod
    def check(self, surface: AbstractSurface) -> None:
        """Check that this method can shade a surface; `ValueError` if not."""

    @abc.abstractmethod
    def points(
        self, surface: AbstractSurface, camera: AbstractCamera, gbuffer: GBuffer
    ) -> LightingPoints:
        """Points of a traced surface at which lighting is evaluated."""

    @abc.abstractmethod
    def interpolation(
        self, surface: AbstractSurface, gbuffer: GBuffer
    ) -> Interpolation | None:
        """Interpolation from lit points to pixels; `None` if they are the pixels."""


class PhongShading(AbstractShading):
    """Normals are interpolated and every pixel is lit.

    ??? cite "Source"
        Phong, *Illumination for computer generated pictures*, CACM 18(6), 1975.
    """

    clamp: bool = eqx.field(static=True, default=False, init=False)

    def check(self, surface: AbstractSurface) -> None:
        # Surfaces of all kinds can be shaded.
        del surface

    def points(
        self, surface: AbstractSurface, camera: AbstractCamera, gbuffer: GBuffer
    ) -> LightingPoints:
        del surface, camera
        surface_normal = gbuffer.surface_normal
        return LightingPoints(
            position=gbuffer.position,
            normal=gbuffer.normal,
            surface_normal=gbuffer.normal if surface_normal is None else surface_normal,
            to_viewer=gbuffer.to_viewer,
            material_index=gbuffer.material_index,
        )

    def interpolation(
        self, surface: AbstractSurface, gbuffer: GBuffer
    ) -> Interpolation | None:
        # The points that are lit are the pixels.
        del surface, gbuffer
        return None


class GouraudShading(AbstractShading):
    """Vertices are lit, and their colours interpolated: small highlights can be missed.

    **Fields:**

    - `clamp`: cut the vertices' colours off at 1 before they are interpolated, as
        OpenGL does.

    ??? cite "Source"
        Gouraud, *Continuous shading of curved surfaces*, IEEE Transactions on Computers
        20(6), 1971.
    """

    clamp: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        check_fields(self)

    def check(self, surface: AbstractSurface) -> None:
        _as_mesh(surface)

    def points(
        self, surface: AbstractSurface, camera: AbstractCamera, gbuffer: GBuffer
    ) -> LightingPoints:
        del gbuffer
        mesh = _as_mesh(surface)
        # A vertex between two materials occurs twice: see `Corners`.
        vertex = mesh.corners.vertex
        position = mesh.vertices[vertex]
        normal = mesh.vertex_normals()[vertex]
        to_viewer = jax.vmap(camera.to_viewer)(position)
        index = None if mesh.material_index is None else mesh.corners.material
        front = LightingPoints(position, normal, normal, to_viewer, index)
        return _both_sides(front) if mesh.two_sided else front

    def interpolation(
        self, surface: AbstractSurface, gbuffer: GBuffer
    ) -> Interpolation | None:
        mesh = _as_mesh(surface)
        face, weights = _faces_and_weights(gbuffer)
        index = mesh.corners.pair[face]
        if mesh.two_sided:
            # Points with reversed normals follow the others: see `_both_sides`.
            behind = _seen_from_behind(mesh, gbuffer)[..., None]
            index = jnp.where(behind, index + len(mesh.corners.vertex), index)
        return Interpolation(index, weights)


class FlatShading(AbstractShading):
    """One colour a face, lit at one point of it."""

    at: FacePoint = eqx.field(static=True)
    clamp: bool = eqx.field(static=True)

    @checked
    def __init__(self, at: FacePoint = "centroid", clamp: bool = False):
        """**Arguments:**

        - `at`: `"centroid"` with the face's own normal, as in the textbook, or
            `"last_vertex"` with that vertex's normal, as in OpenGL's GL_FLAT.
        - `clamp`: cut the faces' colours off at 1 before fog is added, as OpenGL does;
            without fog the film's clamp does the same.

        **Raises:** `ValueError` for another `at`.
        """
        self.at = at
        self.clamp = bool(clamp)

    def check(self, surface: AbstractSurface) -> None:
        _as_mesh(surface)

    def points(
        self, surface: AbstractSurface, camera: AbstractCamera, gbuffer: GBuffer
    ) -> LightingPoints:
        del gbuffer
        mesh = _as_mesh(surface)
        surface_normal = mesh.face_normals()
        if self.at == "centroid":
            normal = surface_normal
            position = jnp.mean(mesh.vertices[mesh.faces], axis=1)
        else:
            last = mesh.faces[:, 2]
            position, normal = mesh.vertices[last], mesh.vertex_normals()[last]
        to_viewer = jax.vmap(camera.to_viewer)(position)
        front = LightingPoints(
            position, normal, surface_normal, to_viewer, mesh.material_index
        )
        return _both_sides(front) if mesh.two_sided else front

    def interpolation(
        self, surface: AbstractSurface, gbuffer: GBuffer
    ) -> Interpolation | None:
        mesh = _as_mesh(surface)
        index, weights = _faces_and_weights(gbuffer)
        if mesh.two_sided:
            # Points with reversed normals follow the others: see `_both_sides`.
            behind = _seen_from_behind(mesh, gbuffer)
            index = jnp.where(behind, index + len(mesh.faces), index)
        # One point, of weight 1.
        return Interpolation(index[..., None], jnp.ones_like(weights[..., :1]))


def _as_mesh(surface: AbstractSurface) -> Mesh:
    """`surface` if it is a mesh, else a `ValueError`."""
    if not isinstance(surface, Mesh):
        raise ValueError(
            "shading: expected a Mesh for flat or Gouraud shading, got "
            f"{type(surface).__name__}"
        )
    return surface


def _faces_and_weights(gbuffer: GBuffer) -> tuple[Array, Array]:
    """Face of each pixel and weights of its corners; `ValueError` without a mesh."""
    if gbuffer.face is None or gbuffer.barycentrics is None:
        raise ValueError("gbuffer: expected one traced from a mesh, with its faces")
    return gbuffer.face, gbuffer.barycentrics


def _both_sides(front: LightingPoints) -> LightingPoints:
    """The points, then the same points with reversed normals."""
    back = LightingPoints(
        front.position,
        -front.normal,
        -front.surface_normal,
        front.to_viewer,
        front.material_index,
    )
    return jax.tree.map(lambda one, other: jnp.concatenate([one, other]), front, back)


def _seen_from_behind(mesh: Mesh, gbuffer: GBuffer) -> Array:
    """Mask of the pixels that see the back of a face."""
    normal = mesh.face_normals()[gbuffer.face]
    return jnp.sum(normal * gbuffer.to_viewer, axis=-1) < 0
