r"""Normals: of a face, of a vertex, of a parametric and of an implicit surface.

Faces are wound counter-clockwise seen from outside, so that normals point outwards.
"""

from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from phongfit.programs import program
from phongfit.vectors import Scalar, Vec3, dot, norm, normalize

Weighting = Literal["area", "angle"]


def face_normal(a: Vec3, b: Vec3, c: Vec3) -> Vec3:
    r"""$(b - a) \times (c - a)$ of one triangle: its length is twice the area.

    **Arguments:** the corners, world units. **Returns:** not a unit vector; zero for a
    degenerate triangle.
    """
    return jnp.cross(b - a, c - a)


@program()
def face_normals(
    vertices: Float[Array, "vertices 3"], faces: Int[Array, "faces 3"]
) -> Float[Array, "faces 3"]:
    """Unit normal of every face; zero, with zero gradient, for a degenerate one."""
    a, b, c = jnp.moveaxis(vertices[faces], 1, 0)
    return jax.vmap(normalize)(jax.vmap(face_normal)(a, b, c))


def _angle(corner: Vec3, following: Vec3, preceding: Vec3) -> Scalar:
    """Angle at a triangle's corner, radians; 0 where it coincides with another one."""
    edge_1, edge_2 = following - corner, preceding - corner
    sine, cosine = norm(jnp.cross(edge_1, edge_2)), dot(edge_1, edge_2)
    degenerate = (sine == 0) & (cosine == 0)
    return jnp.arctan2(sine, jnp.where(degenerate, 1, cosine))


@program("weighting")
def vertex_normals(
    vertices: Float[Array, "vertices 3"],
    faces: Int[Array, "faces 3"],
    weighting: Weighting = "area",
) -> Float[Array, "vertices 3"]:
    r"""Unit normal of every vertex: the mean over the faces around it.

    $$m \propto \sum_{\text{faces}} w \, m_{\text{face}}$$

    **Arguments:**

    - `vertices`: world units.
    - `faces`: indices of the corners.
    - `weighting`: $w$ is the face's `"area"`, or its `"angle"` at the vertex, which
        does not depend on how a polygon was cut into triangles.

    **Returns:** unit vectors; zero, with zero gradient, for a vertex of no face and for
    one of degenerate faces only.

    ??? cite "Source"
        Thürmer and Wüthrich, *Computing vertex normals from polygonal facets*, Journal
        of Graphics Tools 3(1), 1998, for the angle.
    """
    corners = jnp.moveaxis(vertices[faces], 1, 0)
    normals = jax.vmap(face_normal)(*corners)
    total = jnp.zeros_like(vertices)
    for k in range(3):
        # Twice the area of a face is the length of its `face_normal`.
        contribution = normals
        if weighting == "angle":
            here, following, preceding = (corners[(k + i) % 3] for i in range(3))
            angle = jax.vmap(_angle)(here, following, preceding)
            contribution = angle[:, None] * jax.vmap(normalize)(normals)
        total = total.at[faces[:, k]].add(contribution)
    return jax.vmap(normalize)(total)


def triangle_normals(
    triangles: Float[np.ndarray, "faces 3 3"],
) -> Float[np.ndarray, "faces 3"]:
    """Unit normal of every triangle; zero for a degenerate one.

    It is in NumPy, since JAX would compile [`face_normals`][] for each number of faces.
    """
    a, b, c = np.moveaxis(triangles, 1, 0)
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(length > 0, length, 1)


def split_creases(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    angle: float,
) -> tuple[Int[np.ndarray, " corners"], Int[np.ndarray, "faces 3"]]:
    """Cut a mesh open along its sharp edges, so that normals are not averaged across.

    **Arguments:**

    - `vertices`, `faces`: the mesh.
    - `angle`: degrees between the normals of two faces above which their edge is sharp.

    **Returns:**

    - for every vertex of the mesh cut open, its index in `vertices`;
    - the faces, as indices of the vertices of the mesh cut open.
    """
    # Imported here, since the import takes a third of a second.
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    normals = triangle_normals(vertices[faces].astype(float))

    # Corners are counted through all faces, each with the edge from it to the corner
    # `after` it in its face; `low` and `high` are the face's corners at the edge's
    # vertex of lower and higher index. Faces at the same edge follow each other in
    # `order`.
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    corner = np.arange(faces.size)
    after = np.roll(corner.reshape(-1, 3), -1, axis=1).ravel()
    edge = np.stack([np.minimum(start, end), np.maximum(start, end)], axis=1)
    low = np.where(start < end, corner, after)
    high = np.where(start < end, after, corner)
    order = np.lexsort(edge.T)
    first, second = order[:-1], order[1:]
    smooth = (edge[first] == edge[second]).all(axis=1)
    # Corner k belongs to face k // 3.
    cosine = (normals[first // 3] * normals[second // 3]).sum(axis=1)
    smooth &= cosine >= np.cos(np.deg2rad(angle)) - 1e-9
    first, second = first[smooth], second[smooth]

    # Corners that meet at a smooth edge are one vertex.
    rows = np.concatenate([low[first], high[first]])
    columns = np.concatenate([low[second], high[second]])
    links = coo_array((np.ones(len(rows)), (rows, columns)), (faces.size, faces.size))
    count, group = connected_components(links, directed=False)
    vertex = np.zeros(count, faces.dtype)
    vertex[group] = faces.ravel()
    return vertex, group.reshape(-1, 3).astype(faces.dtype)


def parametric_normal(
    function: Callable[[Scalar, Scalar], Vec3], u: Scalar, v: Scalar
) -> Vec3:
    r"""Unit normal, along $\partial p / \partial u \times \partial p / \partial v$.

    **Arguments:** `function`: (u, v) → p, in world units; `u`, `v`: parameters of the
    point.

    **Returns:** a unit vector; zero where the derivatives are parallel, as at the pole
    of a sphere.
    """
    along_u, along_v = jax.jacfwd(function, argnums=(0, 1))(u, v)
    return normalize(jnp.cross(along_u, along_v))


def implicit_normal(function: Callable[[Vec3], Scalar], position: Vec3) -> Vec3:
    r"""Unit normal $\nabla F / |\nabla F|$ of a surface $F = 0$ with $F > 0$ outside.

    **Arguments:** `function`: p → F(p); `position`: the point p, world units.

    **Returns:** a unit vector; zero where the gradient is zero.
    """
    return normalize(jax.grad(function)(position))
