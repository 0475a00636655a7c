"""A made-up stack whose normals nobody is told: a surface that is flat by name only."""

import dataclasses
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

import phongfit as pf
from data_synth.lights import spread_directions
from tests.maps.synthetic import noisy, shown

NOISE = 0.01


class Hidden(NamedTuple):
    """Scenes of a plane, images of something else, and what that is.

    - `normals`: (H, W, 3), in the camera's axes.
    """

    scenes: list[pf.Scene]
    images: np.ndarray
    truth: pf.Material
    normals: np.ndarray

    def angles(self, maps: pf.Maps) -> np.ndarray:
        """Degrees from found normals to true ones."""
        cosine = np.sum(maps.normals * self.normals, axis=-1)
        return np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))

    def pulls(self, maps: pf.Maps) -> np.ndarray:
        """Those angles in standard errors, where these are finite."""
        finite = np.isfinite(maps.normals_stderr)
        return self.angles(maps)[finite] / maps.normals_stderr[finite]


def hide(
    size: tuple[int, int] = (16, 24),
    lights: int = 24,
    *,
    near: bool = False,
    perspective: bool = False,
    model: pf.AbstractSpecular | None = None,
    exponents: tuple[float, float] = (8, 30),
    directions: np.ndarray | None = None,
    seed: int = 0,
    surface: Literal["random", "dome"] = "random",
    shared: Sequence[tuple[float, float]] = (),
) -> Hidden:
    """Random materials, or ρ_s and f of a few.

    Near lamps stand 3 from the middle of a surface 2 high.
    """
    rng = np.random.default_rng(seed)
    height, width = size
    x = np.linspace(-1, 1, width) * width / height
    grid = np.stack(np.meshgrid(x, np.linspace(1, -1, height)), axis=-1)
    normals = np.ones((*size, 3))
    normals[..., :2] = (
        rng.uniform(-0.4, 0.4, (*size, 2))
        if surface == "random"
        else grid @ [[0.4, 0.25], [0.25, 0.4]]
    )
    low, high = np.log(exponents)
    truth = pf.Material(
        diffuse=rng.uniform(0.15, 0.4, (*size, 3)),
        specular=rng.uniform(0.2, 0.4, (*size, 3)),
        shininess=np.exp(rng.uniform(low, high, (*size, 1))),
        ambient=0.0,
    )
    if shared:
        strengths, sharp = np.array(shared)[rng.integers(len(shared), size=size)].T
        truth = dataclasses.replace(
            truth,
            specular=np.broadcast_to(strengths.T[..., None], (*size, 3)),
            shininess=sharp.T[..., None],
        )
    camera: pf.geometry.AbstractCamera = pf.OrthographicCamera(
        width, height, view_height=2.0
    )
    if perspective:
        fov = 2 * np.rad2deg(np.arctan(1 / 4))
        camera = pf.PerspectiveCamera(width, height, fov_y=fov, position=(0, 0, 4))
    places = np.concatenate([grid, np.zeros((*size, 1))], axis=-1)
    directions = spread_directions(lights) if directions is None else directions
    white = (1.0, 0.9, 0.8)
    lamps = [
        pf.PointLight(3 * d, white, attenuation=(0, 0, 1 / 9))
        if near
        else pf.DirectionalLight(d, white)
        for d in directions
    ]
    true = pf.NormalMap(normals, positions=places)
    flat = pf.NormalMap(np.broadcast_to([0.0, 0, 1], normals.shape), positions=places)
    scenes = [pf.Scene(true, camera, lamp, specular_model=model) for lamp in lamps]
    seen = pf.geometry.trace(true, camera)
    return Hidden(
        [dataclasses.replace(scene, surface=flat) for scene in scenes],
        noisy(shown(scenes, truth, gbuffer=seen), NOISE, rng),
        truth,
        np.asarray(seen.normal, float),
    )
