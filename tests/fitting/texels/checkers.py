"""A plate of two exponents, checkered, under lamps that tell them."""

import numpy as np

import phongfit as pf
from tests.fitting.texels.scenes import SIZE, camera_at, plate, textured

CHECKS = (np.indices(SIZE) // 3).sum(axis=0)[..., None] % 2
EXPONENT = np.where(CHECKS, 80.0, 20.0)
RNG = np.random.default_rng(0)
DIFFUSE = RNG.uniform(0.1, 0.6, (*SIZE, 3))
SPECULAR = np.repeat(RNG.uniform(0.3, 0.5, (*SIZE, 1)), 3, axis=-1)
# Matte, where only texels beside it have a highlight.
SPECULAR[3:9, 3:9] = 0
INSIDE = np.zeros(SIZE, bool)
INSIDE[4:8, 4:8] = True
PLACES = ((0.5, -0.3, 4), (-0.8, 0.6, 3.8))


def unit() -> pf.Material:
    """What multiplies textures of reflectances and exponents."""
    return pf.Material(1.0, 1.0, 1.0, 0.0)


def scenes(count: int = 12, mesh: pf.Mesh | None = None) -> list[pf.Scene]:
    """Lamps from near the mirror direction to far from it, seen from two places."""
    aside = 0.05 + 0.75 * (np.arange(count) + 0.5) / count
    angle = 2.4 * np.arange(count)
    lamps = np.stack([aside * np.cos(angle), aside * np.sin(angle), np.ones(count)], 1)
    mesh = plate() if mesh is None else mesh
    return [
        pf.Scene(mesh, camera_at(*PLACES[k % 2]), pf.DirectionalLight(lamp))
        for k, lamp in enumerate(lamps)
    ]


def painted(count: int = 12, **textures) -> list[pf.Scene]:
    return scenes(count, textured(**textures))
