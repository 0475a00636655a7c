"""A ball whose numbers at vertices are known, and its photographs."""

from typing import Any

import numpy as np
import trimesh

import phongfit as pf
from tests.fitting.texels.scenes import camera_at, photographs, shiny

BALL = trimesh.creation.icosphere(2)
TRUE = np.random.default_rng(0).uniform(0.1, 0.8, (len(BALL.vertices), 3))
VIEWS = ((0, 0, 4), (3.5, 0, -2), (-3, 1, -2.5))
LAMPS = ((1, 1, 0), (-1, 0.5, 0.5), (0.3, -1.5, 1))
NOISE = 0.01


def bare() -> pf.Mesh:
    return pf.Mesh(BALL.vertices, BALL.faces)


def scenes(mesh: pf.Mesh | None = None) -> list[pf.Scene]:
    """A ball from three sides, under three lamps each."""
    mesh = bare() if mesh is None else mesh
    return [
        pf.Scene(
            mesh,
            camera_at(*view),
            pf.DirectionalLight(np.array(view) + lamp),
            ambient=0.1,
        )
        for view in VIEWS
        for lamp in LAMPS
    ]


def painted(**rows) -> list[pf.Scene]:
    named: Any = {name: pf.VertexColours(values) for name, values in rows.items()}
    return scenes(bare().with_textures(pf.Textures(**named)))


def images() -> list[np.ndarray]:
    """Photographs of the painted ball."""
    return photographs(painted(diffuse=TRUE), shiny(), NOISE)
