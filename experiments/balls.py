"""A ball of triangles, made once for all experiments."""

import functools
from collections.abc import Sequence

import numpy as np

import phongfit as pf


@functools.cache
def unit_ball(rows: int) -> pf.Mesh:
    """A ball of radius 1: `rows` faces from pole to pole, 2 × `rows` around."""
    return pf.shapes.Ball().mesh(2 * rows, rows)


def ball(rows: int, radius: float, center: Sequence[float]) -> pf.Mesh:
    """The ball of [`unit_ball`][], scaled and moved; world units."""
    unit = unit_ball(rows)
    vertices = radius * np.asarray(unit.vertices) + np.asarray(center)
    return pf.Mesh(vertices, unit.faces, unit.normals)
