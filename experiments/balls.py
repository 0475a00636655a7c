"""Balls of triangles, as meshes with smooth normals."""

import functools
from collections.abc import Sequence

import numpy as np

import phongfit as pf


@functools.cache
def unit_ball(rows: int) -> pf.Mesh:
    """A ball of radius 1: `rows` cells from pole to pole, 2 × `rows` around.

    A cell is two triangles. Cached, since several experiments use the same ones.
    """
    return pf.shapes.Ball().mesh(2 * rows, rows)


def ball(rows: int, radius: float, center: Sequence[float]) -> pf.Mesh:
    """The ball of [`unit_ball`][] with this radius and centre, in world units."""
    unit = unit_ball(rows)
    vertices = radius * np.asarray(unit.vertices) + np.asarray(center)
    return pf.Mesh(vertices, unit.faces, unit.normals)
