"""Intersection of rays with triangles in NumPy, for machines without Embree."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

# Largest number of faces in a leaf, and of rays that are traced together.
MAX_LEAF_FACES, RAYS_PER_BATCH = 8, 2**15


class _Box(NamedTuple):
    """An axis-parallel box around faces, a node of the tree.

    - `low`, `high`: opposite corners, in the unit of the vertices.
    - `faces`: indices of its faces, if they are few; else `None`.
    - `parts`: else its two smaller boxes.
    """

    low: np.ndarray
    high: np.ndarray
    faces: Int[np.ndarray, " k"] | None
    parts: "tuple[_Box, _Box] | None"


class FaceTree:
    """A bounding volume hierarchy of a mesh, with the interface of an Embree scene.

    Many rays are traced together; at each box those that miss it are dropped.
    """

    def __init__(
        self,
        vertices: Float[np.ndarray, "vertices 3"],
        faces: Int[np.ndarray, "faces 3"],
    ):
        """**Arguments:** `vertices`: in any unit; `faces`: indices of their corners."""
        self._corners = vertices.astype(float)[faces]
        self._root = _box(self._corners, np.arange(len(faces)))

    def run(
        self,
        origin: Float[np.ndarray, "rays 3"],
        direction: Float[np.ndarray, "rays 3"],
        limit: Float[np.ndarray, " rays"] | None,
        query: str,
    ) -> Int[np.ndarray, " rays"]:
        """Index of the face that each ray meets before its limit, −1 for none.

        **Arguments:**

        - `origin`, `direction`: of the rays, in the unit of the vertices.
        - `limit`: largest distance, in lengths of `direction`; `None` for no limit.
        - `query`: `"INTERSECT"` for the first face on a ray, `"OCCLUDED"` for any face,
            which is faster.
        """
        hits = np.full(len(origin), -1)
        limits = np.full(len(origin), np.inf) if limit is None else limit.astype(float)
        for begin in range(0, len(origin), RAYS_PER_BATCH):
            part = slice(begin, begin + RAYS_PER_BATCH)
            rays = origin[part].astype(float), direction[part].astype(float)
            self._intersect(*rays, limits[part].copy(), hits[part], query == "OCCLUDED")
        return hits

    def _intersect(
        self,
        origin: np.ndarray,
        direction: np.ndarray,
        limits: np.ndarray,
        hits: np.ndarray,
        any_hit: bool,
    ) -> None:
        """Write the index of the face that each ray meets into `hits`.

        `limits` is overwritten by the distances of the faces found.
        """
        # A ray parallel to a side of a box would give 0 × ∞.
        inverse = 1 / np.where(direction == 0, 1e-300, direction)
        stack = [(self._root, np.arange(len(origin)))]
        while stack:
            box, rays = stack.pop()
            if any_hit:
                rays = rays[hits[rays] < 0]
            rays = rays[_intersects_box(box, origin[rays], inverse[rays], limits[rays])]
            if not rays.size:
                continue
            if box.parts is not None:
                stack += [(one, rays) for one in box.parts]
                continue
            assert box.faces is not None
            corners = self._corners[box.faces]
            distance = _distances(corners, origin[rays], direction[rays])
            first = distance.argmin(axis=1)
            nearest = distance[np.arange(len(rays)), first]
            nearer = nearest < limits[rays]
            limits[rays[nearer]] = nearest[nearer]
            hits[rays[nearer]] = box.faces[first[nearer]]


def _box(corners: Float[np.ndarray, "faces 3 3"], faces: Int[np.ndarray, " k"]) -> _Box:
    """The box around some faces, split at the median along the longest axis.

    **Arguments:** `corners`: of all faces; `faces`: indices of those in the box.
    """
    triangles = corners[faces]
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    # Rounding must not exclude faces that lie in a side of the box.
    slack = 1e-9 * (1 + np.abs(triangles).max())
    if len(faces) <= MAX_LEAF_FACES:
        return _Box(low - slack, high + slack, faces, None)
    middle = triangles.mean(axis=1)
    order = np.argsort(middle[:, np.argmax(np.ptp(middle, axis=0))], kind="stable")
    halves = np.array_split(faces[order], 2)
    parts = (_box(corners, halves[0]), _box(corners, halves[1]))
    return _Box(low - slack, high + slack, None, parts)


def _intersects_box(
    box: _Box, origin: np.ndarray, inverse: np.ndarray, limits: np.ndarray
) -> Bool[np.ndarray, " rays"]:
    """Whether rays intersect a box before they end.

    **Arguments:** `inverse`: 1 / direction, for each axis; `limits`: largest distances,
    in lengths of the direction.

    ??? cite "Source"
        Kay and Kajiya, *Ray tracing complex scenes*, SIGGRAPH 1986.
    """
    one, other = (box.low - origin) * inverse, (box.high - origin) * inverse
    near = np.minimum(one, other).max(axis=1)
    far = np.maximum(one, other).min(axis=1)
    return (near <= far) & (far >= 0) & (near <= limits)


def _distances(
    corners: Float[np.ndarray, "faces 3 3"],
    origin: Float[np.ndarray, "rays 3"],
    direction: Float[np.ndarray, "rays 3"],
) -> Float[np.ndarray, "rays faces"]:
    """Distance to each face along each ray, in lengths of `direction`; ∞ if missed.

    A ray hits a face if it passes all three edges on the same side. Two faces that
    share an edge compute the same number with opposite signs, so no ray slips between.
    """
    # Corners relative to the origins of the rays, each of shape (rays, faces, 3).
    a, b, c = np.moveaxis(corners[None] - origin[:, None, None], 2, 0)
    along = direction[:, None]
    # The sign is the side of the edge on which the ray passes.
    sides = [(along * np.cross(p, q)).sum(axis=-1) for p, q in ((a, b), (b, c), (c, a))]
    inside = np.min(sides, axis=0) >= 0
    inside |= np.max(sides, axis=0) <= 0
    normal = np.cross(b - a, c - a)
    slope = (along * normal).sum(axis=-1)
    distance = (a * normal).sum(axis=-1) / np.where(slope == 0, 1, slope)
    return np.where(inside & (slope != 0) & (distance > 0), distance, np.inf)
