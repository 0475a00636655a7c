"""Tangents of glTF files: which way a normal map's x and y run.

phongfit finds them from the uv, face by face, and needs none of a file; others expect
them at the vertices.
"""

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from phongfit.checks import as_floats
from phongfit.geometry.meshes import tangents

ASIDE = np.cos(np.radians(20))
"""Tangents that are further apart are not of the same uv, however they were meant."""


def vertex_tangents(
    positions: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    normals: Float[np.ndarray, "vertices 3"],
    uv: Float[np.ndarray, "vertices 2"],
) -> Float[np.ndarray, "vertices 4"]:
    r"""Unit tangents, and the sign of the bitangent: as glTF's TANGENT.

    The mean of $\partial p / \partial u$ over the faces around a vertex, perpendicular
    to its normal; $w (n \times t)$ runs up in the image.

    ??? cite "Source"
        Lengyel, *Foundations of game engine development 2: Rendering*, 2019, section
        7.5; Khronos, *glTF 2.0*, 2021, section 3.7.2.1.
    """
    along_u, along_v = (
        _sums(one, faces, len(positions)) for one in _along(positions[faces], uv[faces])
    )
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normal = normals / np.where(length > 0, length, 1)
    flat = along_u - (along_u * normal).sum(axis=1, keepdims=True) * normal
    # Where the uv have no area, any direction does.
    axis = np.eye(3)[np.abs(normal).argmin(axis=1)]
    size = np.linalg.norm(flat, axis=1, keepdims=True)
    flat = np.where(size > 1e-12, flat, np.cross(normal, axis))
    tangent = flat / np.linalg.norm(flat, axis=1, keepdims=True)
    down = (np.cross(normal, tangent) * along_v).sum(axis=1, keepdims=True)
    return np.hstack([tangent, np.where(down > 0, -1.0, 1.0)])


def mirrored(
    corners: Float[np.ndarray, "faces 3 3"], uv: Float[np.ndarray, "corners 2"]
) -> Bool[np.ndarray, " faces"]:
    """Faces on which the image is seen the wrong way round."""
    one, other = np.moveaxis(np.diff(uv.reshape(-1, 3, 2), axis=1), 1, 0)
    # v runs down: an image that is not mirrored turns the other way.
    return one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0] > 0


@np.errstate(all="ignore")
def differing(
    one: Float[np.ndarray, "vertices 4"], other: Float[np.ndarray, "vertices 4"]
) -> int:
    """How many tangents are more than 20° apart, or mirrored.

    Files may hold any numbers: what is not finite does not differ.
    """
    length = np.linalg.norm(one[:, :3], axis=1) * np.linalg.norm(other[:, :3], axis=1)
    along = (one[:, :3] * other[:, :3]).sum(axis=1)
    far = (along < ASIDE * length) | (one[:, 3] * other[:, 3] < 0)
    return int(np.count_nonzero(far))


def _along(corners: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors along u and v of each face, as large as the face; 0 without uv."""
    area = np.linalg.norm(
        np.cross(*np.moveaxis(np.diff(corners, axis=1), 1, 0)), axis=1
    )
    along = jax.vmap(tangents)(as_floats("vertices", corners), as_floats("uv", uv))
    scaled = []
    for one in along:
        vector = np.asarray(one, float)
        length = np.linalg.norm(vector, axis=1)
        scaled.append(vector * (area / np.where(length > 0, length, 1))[:, None])
    return scaled[0], scaled[1]


def _sums(of_faces: np.ndarray, faces: np.ndarray, vertices: int) -> np.ndarray:
    """Sums over the faces around each vertex."""
    total = np.zeros((vertices, 3))
    for corner in faces.T:
        np.add.at(total, corner, of_faces)
    return total
