"""A plate whose texels are known, and its photographs."""

from typing import Any

import jax
import numpy as np

import phongfit as pf

SIZE = 12, 12
TRUE = np.random.default_rng(0).uniform(0.1, 0.8, (*SIZE, 3))
NOISE = 0.005
LAMPS = ((0.3, 0.2, 1), (-0.5, 0.4, 1), (0.1, -0.6, 1))
PLACES = ((0.5, -0.3, 4), (-1.5, 0.6, 3.5), (0.5, -0.3, 4))


def plate(textures=None, **changes) -> pf.Mesh:
    """A square from −1 to 1 that faces +z, covered by one texture, upright."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], float)[faces]
    return pf.Mesh(corners, faces, uv=uv, textures=textures, **changes)


def camera_at(*place: float) -> pf.PerspectiveCamera:
    """A camera of 32 × 32 pixels that looks at the origin."""
    return pf.PerspectiveCamera.look_at(place, width=32, height=32, fov_y=32)


def matte() -> pf.Material:
    """What multiplies the texture of the diffuse reflectance."""
    return pf.Material(1.0, 0.0, 20.0, 0.0)


def shiny() -> pf.Material:
    """The same with a highlight."""
    return pf.Material(1.0, 0.3, 20.0, 0.0)


def scenes(mesh: pf.Mesh | None = None) -> list[pf.Scene]:
    """A plate from two places, under three lamps."""
    mesh = plate() if mesh is None else mesh
    return [
        pf.Scene(mesh, camera_at(*place), pf.DirectionalLight(lamp), ambient=0.2)
        for place, lamp in zip(PLACES, LAMPS, strict=True)
    ]


def painted(**textures) -> list[pf.Scene]:
    """The plate with textures."""
    return scenes(textured(**textures))


def textured(**textures) -> pf.Mesh:
    named: Any = {name: pf.Texture(values) for name, values in textures.items()}
    return plate(pf.Textures(**named))


def photographs(
    painted: list[pf.Scene], material: pf.Material, noise: float = NOISE, seed: int = 0
) -> list[np.ndarray]:
    """Light with noise, whose draws are of the precision that is set."""
    light = [pf.render(scene, material, film=pf.Film(False)) for scene in painted]
    keys = jax.random.split(jax.random.key(seed), len(light))
    return [
        np.asarray(one + noise * jax.random.normal(key, one.shape))
        for one, key in zip(light, keys, strict=True)
    ]
