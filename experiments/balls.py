"""A ball of triangles, made once for all experiments."""

import functools
from collections.abc import Sequence

import numpy as np

import phongfit as pf


@functools.cache
def unit_ball(rows: int) -> pf.Mesh:
    """Radius 1 around the origin, `rows` of faces from pole to pole, twice around."""
    return pf.shapes.Ball().mesh(2 * rows, rows)


def ball(rows: int, radius: float, center: Sequence[float]) -> pf.Mesh:
    """The ball of [`unit_ball`][], scaled and moved; world units."""
    unit = unit_ball(rows)
    vertices = radius * np.asarray(unit.vertices) + np.asarray(center)
    return pf.Mesh(vertices, unit.faces, unit.normals)
