"""Polygons of mesh files, cut into triangles."""

from typing import NamedTuple

import mapbox_earcut
import numpy as np
from jaxtyping import Bool, Float, Int

from phongfit.files.budget import afford
from phongfit.files.inputs import Note

SLACK = 1e-9
"""Tolerance for rounding, relative to a polygon's area."""
DOUBTFUL = 1e-6
"""Largest relative error of the triangles' area; beyond it the result is a guess."""
MOST_CORNERS = 20_000
"""Maximum root of the sum of squared numbers of corners, over polygons that are not
convex: the time grows with these squares, to some seconds."""
TRIANGLE = 400
"""Bytes of memory for each triangle while polygons are cut (measured)."""


class Triangles(NamedTuple):
    """Triangles of polygons: indices of three corners, and of the polygon of each."""

    corner: Int[np.ndarray, "triangles 3"]
    polygon: Int[np.ndarray, " triangles"]


def triangulate(
    vertices: Float[np.ndarray, "vertices 3"],
    corners: Int[np.ndarray, " corners"],
    counts: Int[np.ndarray, " polygons"],
    note: Note,
) -> Triangles:
    """Cut polygons, convex or not, into triangles of the same orientation.

    **Arguments:**

    - `corners`: vertices of all polygons, one polygon after the other.
    - `counts`: number of corners of each polygon.
    - `note`: called with a sentence on polygons that are left out or cross themselves.

    **Raises:** `ValueError` for a vertex that does not exist, for more triangles than
    the limit of memory, and for polygons that are not convex if they exceed
    `MOST_CORNERS`.
    """
    afford(TRIANGLE * int(np.maximum(counts - 2, 0).sum()), "triangles")
    for index in corners[(corners < 0) | (corners >= len(vertices))][:1]:
        wanted = f"whole numbers from 0 to {len(vertices) - 1}"
        raise ValueError(f"its faces: expected {wanted}, got {index}")
    if small := np.count_nonzero(counts < 3):
        note(f"{small} of its faces have fewer than 3 corners, and are not used")
    starts = np.cumsum(counts) - counts
    cut = [Triangles(np.zeros((0, 3), int), np.zeros(0, int))]
    crossing, squares = 0, 0
    for count in np.unique(counts[counts > 2]):
        polygons = np.flatnonzero(counts == count)
        corner = starts[polygons, None] + np.arange(count)
        for first in range(2):
            corner = np.roll(corner, -first, axis=1)
            fits = _is_fan(vertices[corners[corner]]) | (count == 3)
            fan = np.arange(count - 2)[:, None] + [0, 1, 2]
            fan[:, 0] = 0
            each = np.repeat(polygons[fits], count - 2)
            cut.append(Triangles(corner[fits][:, fan].reshape(-1, 3), each))
            polygons, corner = polygons[~fits], corner[~fits]
        squares += len(polygons) * int(count) ** 2
        if squares > MOST_CORNERS**2:
            wanted = f"at most {MOST_CORNERS} corners where a face is not convex"
            got = f"{len(polygons)} faces of {count}"
            raise ValueError(f"its faces: expected {wanted}, got {got}")
        for polygon, ring in zip(polygons, corner, strict=True):
            ears, covers = _ears(vertices[corners[ring]])
            cut.append(Triangles(ring[ears], np.full(len(ears), polygon)))
            crossing += not covers
    if crossing:
        what = f"{crossing} of its faces cross themselves or have no area"
        note(f"{what}: how they are cut is a guess")
    corner, polygon = (np.concatenate(column) for column in zip(*cut, strict=True))
    order = np.argsort(polygon, kind="stable")
    return Triangles(corner[order], polygon[order])


@np.errstate(over="ignore", invalid="ignore")
def _is_fan(rings: Float[np.ndarray, "polygons n 3"]) -> Bool[np.ndarray, " polygons"]:
    """True for polygons that contain all triangles of the fan from the first corner."""
    to_corner = rings[:, 1:] - rings[:, :1]
    areas = np.cross(to_corner[:, :-1], to_corner[:, 1:])
    whole = areas.sum(axis=1, keepdims=True)
    along = (areas * whole).sum(axis=-1)
    return (along > -SLACK * (whole**2).sum(axis=-1)).all(axis=1)


@np.errstate(over="ignore", invalid="ignore")
def _ears(ring: Float[np.ndarray, "n 3"]) -> tuple[Int[np.ndarray, "t 3"], bool]:
    """Triangles of one polygon, and true if they cover it exactly."""
    axes = _plane(ring)
    flat = ring[:, axes] - ring[0, axes]
    ears = mapbox_earcut.triangulate_float64(flat, np.array([len(flat)], np.uint32))
    ears = ears.astype(int).reshape(-1, 3)
    whole = _doubled_areas(flat[None]).item()
    areas = _doubled_areas(flat[ears])
    turned = areas * whole < 0
    ears[turned] = ears[turned][:, ::-1]
    covers = abs(abs(areas).sum() - abs(whole)) <= DOUBTFUL * abs(whole)
    return ears, len(ears) > 0 and bool(covers)


def _plane(ring: Float[np.ndarray, "n 3"]) -> list[int]:
    """The two axes, in cyclic order, onto which a polygon's projection is largest."""
    to_corner = ring - ring[0]
    normal = np.cross(to_corner[:-1], to_corner[1:]).sum(axis=0)
    across = int(np.argmax(abs(normal)))
    return [(across + 1) % 3, (across + 2) % 3]


def _doubled_areas(rings: Float[np.ndarray, "k n 2"]) -> Float[np.ndarray, " k"]:
    """Twice the signed area of polygons in a plane, by the shoelace formula."""
    x, y = rings[..., 0], rings[..., 1]
    return (x * np.roll(y, -1, axis=-1) - y * np.roll(x, -1, axis=-1)).sum(axis=-1)
