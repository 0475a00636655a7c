"""Triangle meshes: their tracing, textures, normal maps and shadows."""

import functools
from collections.abc import Iterable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from phongfit.checks import (
    as_array,
    as_finite,
    as_floats,
    as_indices,
    as_integers,
    as_scalar,
    finite,
    require,
)
from phongfit.codes import warn
from phongfit.edge import checked
from phongfit.geometry.cameras import AbstractCamera, Ray
from phongfit.geometry.normals import (
    Weighting,
    face_normal,
    face_normals,
    split_creases,
    vertex_normals,
)
from phongfit.geometry.raytracing import blocked, first_faces
from phongfit.geometry.surfaces import AbstractSurface, GBuffer
from phongfit.programs import program
from phongfit.textures import (
    Factors,
    Place,
    Texture,
    Textures,
    factors,
    looked_up,
)
from phongfit.vectors import Vec3, dot, norm, normalize, normalize_all

# A shadow ray starts this far off its face, as a fraction of the mesh's size: more
# than the rounding of Embree's float32, and less than anything that casts a shadow.
LIFT = 2e-6
# Further offset, in units of the rounding error of the mesh's coordinates.
ROUNDINGS = 4


class Corners(eqx.Module):
    """All pairs of a vertex and a material that occur, and the pairs of each face.

    Light at a vertex depends on its material, so a vertex between two materials is lit
    twice. `vertex` and `material` have an entry for each pair; `pair` has the numbers
    of the pairs at the corners of each face.
    """

    vertex: Int[Array, " pairs"]
    material: Int[Array, " pairs"]
    pair: Int[Array, "faces 3"]

    def __init__(
        self,
        faces: Int[np.ndarray, "faces 3"],
        material_index: Int[np.ndarray, " faces"] | None,
    ):
        """**Arguments:** as in [`Mesh`][]."""
        material = (
            np.zeros(len(faces), int) if material_index is None else material_index
        )
        # A pair is coded as one number, so that `unique` numbers the pairs that occur.
        count = int(material.max()) + 1
        code = faces.astype(np.int64) * count + material[:, None]
        codes, pair = np.unique(code, return_inverse=True)
        self.vertex = jnp.asarray((codes // count).astype(np.int32))
        self.material = jnp.asarray((codes % count).astype(np.int32))
        self.pair = jnp.asarray(pair.reshape(faces.shape).astype(np.int32))


class Mesh(AbstractSurface):
    """Triangles, seen from the side on which their corners run counter-clockwise."""

    on_host: ClassVar[bool] = True

    vertices: Float[Array, "vertices 3"]
    faces: Int[Array, "faces 3"]
    normals: Float[Array, "vertices 3"] | None
    material_index: Int[Array, " faces"] | None
    uv: Float[Array, "faces 3 2"] | None
    textures: tuple[Textures, ...] | None
    corners: "Corners"
    weighting: Weighting = eqx.field(static=True)
    two_sided: bool = eqx.field(static=True)
    _materials: int = eqx.field(static=True)

    @checked
    def __init__(
        self,
        vertices: Any,
        faces: Any,
        normals: Any = None,
        material_index: Any = None,
        *,
        uv: Any = None,
        textures: Iterable[Textures] | Textures | None = None,
        weighting: Weighting = "area",
        crease_angle: float | None = None,
        two_sided: bool = False,
    ):
        """**Arguments:**

        - `vertices`: (V, 3), world units.
        - `faces`: (F, 3) indices of vertices from 0 on, counter-clockwise seen from
            outside.
        - `normals`: (V, 3), of any length; default computed from the faces around each
            vertex.
        - `material_index`: (F,) whole numbers ≥ 0: which of several materials a face is
            made of. For M materials, each parameter of the `Material` has shape (M, 3),
            (M, 1) or ().
        - `uv`: (F, 3, 2): where in a texture each corner of a face lies; (0, 0) is the
            texture's upper left corner, (1, 1) its lower right one.
        - `textures`: factors on the parameters of the `Material`: one [`Textures`][]
            for all materials, or one for each. [`VertexColours`][] have a row for each
            of `vertices`, and need no uv.
        - `weighting`: weights of the faces around a vertex in its normal: their
            `"area"`, or their `"angle"` at the vertex.
        - `crease_angle`: degrees; an edge between faces whose normals differ by more is
            sharp, and its vertices are doubled. Default: every edge is smooth.
        - `two_sided`: a face is seen from behind too, its normal turned to the viewer.
            By default it cannot be seen from there, as with GL_CULL_FACE; it throws a
            shadow either way.

        **Raises:** `ValueError` that names the argument.
        """
        vertices = as_floats("vertices", vertices)
        if vertices.ndim != 2 or vertices.shape[1] != 3:
            raise ValueError(f"vertices: expected shape (V, 3), got {vertices.shape}")
        if not isinstance(faces, Tracer) and as_array("faces", faces).size == 0:
            raise ValueError("faces: expected at least one face, got none")
        faces = as_integers("faces", faces, 0, len(vertices))
        if faces.ndim != 2 or faces.shape[1] != 3:
            raise ValueError(f"faces: expected shape (F, 3), got {faces.shape}")
        require("vertices", vertices, finite, "finite numbers")
        if normals is not None:
            normals = normalize_all(as_finite("normals", normals, vertices.shape))
        given_count, source_vertex = len(vertices), None
        if crease_angle is not None:
            if normals is not None:
                raise ValueError(
                    "crease_angle: expected None where normals are given, since it is "
                    "about computing them"
                )
            angle = float(as_scalar("crease_angle", crease_angle))
            # The search for creases is not differentiated.
            fixed = np.asarray(jax.lax.stop_gradient(vertices))
            source_vertex, faces = split_creases(fixed, faces, angle)
            vertices = vertices[source_vertex]
        self.vertices = vertices
        self.faces = jnp.asarray(faces)
        self.normals = normals
        self.material_index, self._materials = as_indices(
            "material_index", material_index, (len(faces),)
        )
        index = self.material_index
        self.corners = Corners(faces, None if index is None else np.asarray(index))
        if uv is not None:
            uv = as_finite("uv", uv, (len(faces), 3, 2))
        self.uv = uv
        textures = _as_textures(textures, self.uv, self._materials, given_count)
        if textures is not None and source_vertex is not None:
            textures = tuple(
                texture.rearranged(lambda rows: rows[source_vertex])
                for texture in textures
            )
        self.textures = textures
        self.weighting = weighting
        self.two_sided = bool(two_sided)

    @property
    def materials(self) -> int:
        return self._materials

    def with_textures(self, textures: Iterable[Textures] | Textures | None) -> "Mesh":
        """This mesh with other textures; `None` for none.

        **Raises:** `ValueError` if textures are images and the mesh has no uv, or if
        its numbers of materials or vertices do not match the textures.
        """
        count = len(self.vertices)
        chosen = _as_textures(textures, self.uv, self._materials, count)
        return eqx.tree_at(
            lambda mesh: mesh.textures, self, chosen, is_leaf=lambda leaf: leaf is None
        )

    def place(self, gbuffer: GBuffer) -> Place:
        """The point of the surface that each pixel sees, for looking up textures."""
        face, weights = gbuffer.face, gbuffer.barycentrics
        assert face is not None and weights is not None
        return Place(self.faces[face], weights, gbuffer.uv, gbuffer.material_index)

    def factors(self, gbuffer: GBuffer) -> Factors | None:
        if self.textures is None:
            # `None` stands for factors of 1.
            return None
        return factors(self.textures, self.place(gbuffer))

    def exponents(self, gbuffer: GBuffer) -> Float[Array, "*pixels"] | None:
        if self.textures is None:
            # `None` stands for factors of 1.
            return None
        factor = looked_up("shininess", self.textures, self.place(gbuffer))
        # Textures of the exponent have one channel.
        return None if factor is None else factor[..., 0]

    def vertex_normals(self) -> Float[Array, "vertices 3"]:
        """Unit normals of the vertices, as given or from the faces around them."""
        if self.normals is not None:
            return self.normals
        return vertex_normals(self.vertices, self.faces, self.weighting)

    def face_normals(self) -> Float[Array, "faces 3"]:
        """Unit normals of the faces; zero for degenerate ones."""
        return face_normals(self.vertices, self.faces)

    @checked
    def trace(self, camera: AbstractCamera) -> GBuffer:
        """The point of this mesh that each pixel of `camera` sees.

        It warns if no pixel sees the mesh.

        **Raises:** `ValueError` if the camera lies in a face.
        """
        triangles = self.vertices, self.faces
        rays, seen, inside = _camera_rays(*triangles, camera, self.two_sided)
        inside = jax.lax.stop_gradient(inside)
        if isinstance(inside, Tracer):
            seen = eqx.error_if(seen, inside, "camera: its position lies in a face")
        elif inside:
            raise ValueError(f"camera: its position {camera.position} lies in a face")
        face = first_faces(*triangles, seen, rays)
        if not isinstance(face, Tracer) and not np.any(np.asarray(face) >= 0):
            warn(
                "nothing-seen",
                "surface: no pixel sees the mesh. It lies outside the view, or the "
                "fronts of its faces point away from the camera",
                stacklevel=3,
            )
        return _interpolate(self, camera, rays, face)

    def reached(
        self,
        position: Float[Array, "*batch 3"],
        normal: Float[Array, "*batch 3"],
        to_light: Float[Array, "*batch 3"],
        distance: Float[Array, "*batch"],
    ) -> Bool[Array, "*batch"]:
        triangles = self.vertices, self.faces
        ray = Ray(position, to_light)
        rays, distance = _lift_rays(*triangles, normal, ray, distance)
        return ~blocked(*triangles, rays, distance)


def _as_textures(
    value: Any, uv: Array | None, materials: int, vertices: int
) -> tuple[Textures, ...] | None:
    """`value` as textures of a mesh; `None` stays `None`.

    **Arguments:** `materials`, `vertices`: their numbers; the textures must match them.

    **Raises:** `ValueError` that names the fault.
    """
    if value is None:
        return None
    textures = (value,) if isinstance(value, Textures) else tuple(value)
    for one in textures:
        if not isinstance(one, Textures):
            raise ValueError(f"textures: expected Textures, got {one!r}")
        if uv is None and any(isinstance(k, Texture) for k in vars(one).values()):
            raise ValueError("textures: expected a mesh with uv for images, got none")
        for name, colours in one.at_vertices.items():
            if len(colours.values) != vertices:
                raise ValueError(
                    f"textures: {name}: expected a row for each of {vertices} "
                    f"vertices, got {len(colours.values)}"
                )
    if len(textures) not in (1, materials):
        raise ValueError(
            f"textures: expected one for all of the surface's {materials} materials, "
            f"or one for each, got {len(textures)}"
        )
    return textures


@program()
def _lift_rays(
    vertices: Float[Array, "vertices 3"],
    faces: Int[Array, "faces 3"],
    normal: Float[Array, "*batch 3"],
    ray: Ray,
    distance: Float[Array, "*batch"],
) -> tuple[Ray, Float[Array, "*batch"]]:
    """Shadow rays and distances, with starts moved off the face on the light's side.

    They are moved along the surface's unit `normal`, so that rounding does not put them
    behind their own face.
    """
    precision = float(jnp.finfo(normal.dtype).eps)
    furthest = jnp.max(jnp.abs(vertices[faces.ravel()]))
    lift = LIFT * _size(vertices, faces) + ROUNDINGS * precision * furthest
    side = jnp.sum(normal * ray.direction, axis=-1, keepdims=True)
    origin = ray.origin + jnp.where(side < 0, -lift, lift) * normal
    return Ray(origin, ray.direction), distance - lift


def _size(
    vertices: Float[Array, "vertices 3"], faces: Int[Array, "faces 3"]
) -> Float[Array, ""]:
    """Longest side of the box around a mesh, world units."""
    used = vertices[faces.ravel()]
    return jnp.max(jnp.max(used, axis=0) - jnp.min(used, axis=0))


def _in_face(point: Vec3, a: Vec3, b: Vec3, c: Vec3, slack: Array) -> Bool[Array, ""]:
    """Whether a point lies in a triangle, to within `slack` world units."""
    normal = normalize(face_normal(a, b, c))
    # A degenerate triangle has the normal 0, and contains no point.
    in_plane = jnp.abs(dot(point - a, normal)) <= slack
    inward = [
        dot(jnp.cross(end - start, point - start), normal) >= -slack * norm(end - start)
        for start, end in ((a, b), (b, c), (c, a))
    ]
    return in_plane & jnp.all(jnp.stack(inward)) & jnp.any(normal != 0)


@program("two_sided")
def _camera_rays(
    vertices: Float[Array, "vertices 3"],
    faces: Int[Array, "faces 3"],
    camera: AbstractCamera,
    two_sided: bool,
) -> tuple[Ray, Bool[Array, " faces"], Bool[Array, ""]]:
    """The camera's rays, the faces that it can see, and whether it lies in a face.

    Faces turned away can be seen if the mesh is two-sided; degenerate ones never.
    """
    a, b, c = jnp.moveaxis(vertices[faces], 1, 0)
    to_viewer = jax.vmap(camera.to_viewer)(a)
    toward = jnp.sum(jax.vmap(face_normal)(a, b, c) * to_viewer, axis=-1)
    seen = (toward != 0) if two_sided else (toward > 0)
    slack = 1e-6 * _size(vertices, faces)
    inside = jax.vmap(_in_face, in_axes=(None, 0, 0, 0, None))
    return camera.rays(), seen, jnp.any(inside(camera.position, a, b, c, slack))


def barycentrics(ray: Ray, a: Vec3, b: Vec3, c: Vec3) -> Vec3:
    """Weights of a triangle's corners where one ray meets its plane.

    Since they come from the ray and not from the image plane, what is interpolated with
    them is perspective-correct.

    **Returns:** three numbers that sum to 1; (1, 0, 0) where ray and plane are
    parallel.

    ??? cite "Source"
        Möller and Trumbore, *Fast, minimum storage ray/triangle intersection*, Journal
        of Graphics Tools 2(1), 1997.
    """
    offset, one, other = ray.origin - a, b - a, c - a
    across = jnp.cross(ray.direction, other)
    determinant = dot(across, one)
    parallel = determinant == 0
    scale = 1 / jnp.where(parallel, 1, determinant)
    u = dot(across, offset) * scale
    v = dot(jnp.cross(offset, one), ray.direction) * scale
    weights = jnp.stack([1 - u - v, u, v])
    return jnp.where(parallel, jnp.eye(3, dtype=weights.dtype)[0], weights)


@program()
def _interpolate(
    mesh: Mesh, camera: AbstractCamera, rays: Ray, face: Int[Array, "height width"]
) -> GBuffer:
    """The geometry buffer, from the face that each ray hits first (−1: none)."""
    mask = face >= 0
    face = jnp.where(mask, face, 0)
    corners = mesh.faces[face]
    a, b, c = jnp.moveaxis(mesh.vertices[corners], -2, 0)
    weights = jax.vmap(jax.vmap(barycentrics))(rays, a, b, c)
    # (1, 0, 0), where the ray meets no face.
    at_first_corner = jnp.eye(3, dtype=weights.dtype)[0]
    weights = jnp.where(mask[..., None], weights, at_first_corner)

    def mean(values: Array) -> Array:
        return jnp.sum(weights[..., None] * values[corners], axis=-2)

    position = mean(mesh.vertices)
    to_viewer = jax.vmap(jax.vmap(camera.to_viewer))(position)
    # Renormalised, since interpolation shortens it.
    normal = jax.vmap(jax.vmap(normalize))(mean(mesh.vertex_normals()))
    surface_normal = mesh.face_normals()[face]
    index = None if mesh.material_index is None else mesh.material_index[face]
    uv = None
    if mesh.uv is not None:
        uv = jnp.sum(weights[..., None] * mesh.uv[face], axis=-2)
        place = Place(corners, weights, uv, index)
        normal = _apply_normal_maps(mesh, normal, face, place)
    if mesh.two_sided:
        # Where the back of a face is seen, its normals are turned to the viewer.
        behind = jnp.sum(surface_normal * to_viewer, axis=-1, keepdims=True) < 0
        normal = jnp.where(behind, -normal, normal)
        surface_normal = jnp.where(behind, -surface_normal, surface_normal)
    return GBuffer(
        position=position,
        normal=normal,
        to_viewer=to_viewer,
        mask=mask,
        material_index=index,
        surface_normal=surface_normal,
        face=face,
        barycentrics=weights,
        uv=uv,
    )


def _apply_normal_maps(
    mesh: Mesh,
    normal: Float[Array, "height width 3"],
    face: Int[Array, "height width"],
    place: Place,
) -> Float[Array, "height width 3"]:
    """The interpolated unit normals, turned by the mesh's normal maps if it has any."""
    textures = () if mesh.textures is None else mesh.textures
    local = looked_up("normal", textures, place)
    if local is None or mesh.uv is None:
        return normal
    along_u, along_v = jax.vmap(tangents)(mesh.vertices[mesh.faces], mesh.uv)
    turn = jax.vmap(jax.vmap(turned))
    return turn(local, normal, along_u[face], along_v[face])


def tangents(
    corners: Float[Array, "3 3"], uv: Float[Array, "3 2"]
) -> tuple[Vec3, Vec3]:
    r"""$\partial p / \partial u$ and $\partial p / \partial v$ on a triangle.

    **Arguments:** `corners`, `uv`: points and texture coordinates of its corners.

    **Returns:** two vectors, world units per unit of u and v; zero where the triangle's
    uv have no area.
    """
    one, other = corners[1] - corners[0], corners[2] - corners[0]
    (a, b), (c, d) = uv[1] - uv[0], uv[2] - uv[0]
    determinant = a * d - b * c
    flat = determinant == 0
    scale = jnp.where(flat, 0, 1 / jnp.where(flat, 1, determinant))
    return scale * (d * one - b * other), scale * (a * other - c * one)


def turned(local: Vec3, normal: Vec3, along_u: Vec3, along_v: Vec3) -> Vec3:
    """The unit normal that a normal map gives at one point.

    **Arguments:** `local`: the map's vector: components along u, −v and outwards;
    `normal`: the unit normal without the map; `along_u`, `along_v`: [`tangents`][].

    **Returns:** a unit vector; `normal` itself where the tangents or `local` are zero.

    ??? cite "Source"
        Khronos, *glTF 2.0*, 2021, section 3.9.3: the tangent is made perpendicular to
        the normal, and the bitangent is their cross product.
    """
    tangent = normalize(along_u - dot(along_u, normal) * normal)
    bitangent = jnp.cross(normal, tangent)
    # The map's y axis points against v. In a mirrored texture that is the other side.
    bitangent = jnp.where(dot(bitangent, along_v) > 0, -bitangent, bitangent)
    bent = local[0] * tangent + local[1] * bitangent + local[2] * normal
    bent = normalize(bent)
    known = jnp.any(tangent != 0) & jnp.any(bent != 0)
    return jnp.where(known, bent, normal)


@checked
def join(meshes: Iterable[Mesh]) -> Mesh:
    """Several objects as one mesh, in which each keeps its own materials.

    Materials are numbered in the order of the meshes; a mesh without `material_index`
    has one material. The joined `Material` is made with [`stack_materials`][].

    **Raises:** `ValueError` if there are none, or they differ in `two_sided`.
    """
    meshes = list(meshes)
    if not meshes:
        raise ValueError("meshes: expected at least one, got none")
    if len({mesh.two_sided for mesh in meshes}) > 1:
        raise ValueError("meshes: expected all or none to be two-sided, got both kinds")
    faces, indices, vertices, materials = [], [], 0, 0
    total = sum(len(mesh.vertices) for mesh in meshes)
    with_uv = any(mesh.uv is not None for mesh in meshes)
    textures: list[Textures] = []
    for mesh in meshes:
        index = mesh.material_index
        index = np.zeros(len(mesh.faces), int) if index is None else np.asarray(index)
        textures_of_mesh = mesh.textures or (Textures(),)
        # One texture for all materials of a mesh is repeated for each of them.
        textures_of_mesh *= mesh.materials // len(textures_of_mesh)
        # At vertices of other meshes, which have other materials, the factor is 1.
        ends = (vertices, total - vertices - len(mesh.vertices)), (0, 0)
        padded = functools.partial(jnp.pad, pad_width=ends, constant_values=1)
        textures += [texture.rearranged(padded) for texture in textures_of_mesh]
        faces.append(np.asarray(mesh.faces) + vertices)
        indices.append(index + materials)
        vertices += len(mesh.vertices)
        materials += mesh.materials
    # Meshes may compute normals in different ways, so computed normals are joined.
    normals = None
    differ = len({(mesh.weighting, mesh.normals is None) for mesh in meshes}) > 1
    if differ or meshes[0].normals is not None:
        normals = jnp.concatenate([mesh.vertex_normals() for mesh in meshes])
    return Mesh(
        jnp.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate(faces),
        normals,
        np.concatenate(indices),
        uv=jnp.concatenate([_uv_of(mesh) for mesh in meshes]) if with_uv else None,
        textures=textures if any(mesh.textures for mesh in meshes) else None,
        weighting=meshes[0].weighting,
        two_sided=meshes[0].two_sided,
    )


def _uv_of(mesh: Mesh) -> Float[Array, "faces 3 2"]:
    """A mesh's uv; zeros if it has none, since then it has no texture image."""
    none = jnp.zeros((len(mesh.faces), 3, 2), mesh.vertices.dtype)
    return none if mesh.uv is None else mesh.uv
