"""Photographs that the command was given, as targets: a capture or a data set."""

from pathlib import Path
from typing import Any

import numpy as np

from phongfit.files.capture_data import open_captured
from phongfit.files.dataset import Photographs
from phongfit.files.datasets import open_dataset
from phongfit.files.encodings import parse_encoding
from phongfit.files.inputs import naming
from phongfit.files.scenes import SCENE_FILE
from phongfit.geometry.cameras import (
    AbstractCamera,
    OrthographicCamera,
    PerspectiveCamera,
    PinholeCamera,
    look_at,
)
from phongfit.geometry.surfaces import Sphere
from phongfit.lab.scene import angles
from phongfit.lab.settings import FURTHEST, NEAREST, Settings
from phongfit.lights import AbstractLight, PointLight
from phongfit.scene import Scene


def open_given(
    photographs: Path,
    sphere: tuple[float, float, float] | None,
    lights: Path | None,
    encoding: str | None,
) -> Photographs:
    """A ball's photographs, one or a folder of them, or a data set of a ball.

    **Raises:** `ValueError` that names the file or the option.
    """
    is_dataset = photographs.is_dir() and (photographs / SCENE_FILE).exists()
    if sphere is not None:
        found = open_captured(
            photographs, parse_encoding(encoding), sphere=sphere, lights=lights
        )
    elif is_dataset and lights is None and encoding is None:
        found = open_dataset(photographs)
    else:
        raise ValueError(
            f"sphere: expected the circle of the ball in {photographs}, x, y and "
            "radius in pixels, since it is no data set with a scene.json"
        )
    for scene, name in zip(found.scenes, found.names, strict=True):
        with naming(name):
            settings_of(scene)
    return found


def settings_of(scene: Scene) -> dict[str, Any]:
    """Where the sliders stand for a scene: its ball, its lamp, its ambient light.

    Rays are taken as parallel, and the light is the one that the ball's centre sees: a
    lamp that has a place is near, unless it is further away than the slider goes.

    **Raises:** `ValueError` that says what the sliders cannot show.
    """
    surface, camera = scene.surface, scene.camera
    if not isinstance(surface, Sphere):
        raise ValueError(
            "surface: expected a ball, which the lab can lay over a photograph, got "
            f"{type(surface).__name__}; `phongfit fit` takes it"
        )
    if len(scene.lights) != 1:
        raise ValueError(f"lights: expected one lamp, got {len(scene.lights)}")
    if not scene.lights[0].directed:
        raise ValueError("lights: expected a lamp, got light from all around")
    x, y, radius = _outline(surface, camera)
    light = scene.lights[0].illuminate(surface.center)
    axes = camera.rotation
    if isinstance(camera, PerspectiveCamera | PinholeCamera):
        # A ball beside the axis is seen from the side, by nearly parallel rays.
        axes = look_at(camera.position, surface.center, camera.rotation[:, 1])
    azimuth, elevation, _ = angles(np.asarray(axes).T @ np.asarray(light.to_light))
    near = _near(scene.lights[0], surface)
    found = {
        "surface": "sphere",
        "shading": "phong",
        "light": "point" if near else "directional",
        "azimuth": azimuth,
        "elevation": elevation,
        "intensity": np.clip(np.asarray(light.intensity, float), 0, 10).tolist(),
        "ambient_light": float(np.clip(np.mean(np.asarray(scene.ambient)), 0, 1)),
        "centre_x": 100 * x / camera.width,
        "centre_y": 100 * y / camera.height,
        "radius": 100 * radius / camera.height,
        **near,
    }
    # The page gives back what it was given: let it fail here.
    Settings.model_validate(found)
    return found


def _near(light: AbstractLight, ball: Sphere) -> dict[str, float]:
    """Of a lamp that has a place, how far away it is; nothing if it is far.

    The fall-off is the one that changes as fast with the distance, at the ball.
    """
    if not isinstance(light, PointLight):
        return {}
    away = np.asarray(light.position, float) - np.asarray(ball.center, float)
    distance = float(np.linalg.norm(away))
    in_radii = distance / float(np.asarray(ball.radius))
    if in_radii > FURTHEST:
        return {}
    if in_radii < NEAREST:
        raise ValueError(
            f"lights: expected a lamp at least {NEAREST} radii from the ball's centre, "
            f"got one at {in_radii:.3g}"
        )
    constant, linear, square = np.asarray(light.attenuation, float) * (
        distance ** np.arange(3)
    )
    share = (linear / 2 + square) / (constant + linear + square)
    return {"distance": in_radii, "falloff": float(share)}


def _outline(ball: Sphere, camera: AbstractCamera) -> tuple[float, float, float]:
    """Centre and radius in pixels, from the upper left corner."""
    depth, radius = float(camera.depth(ball.center)), float(np.asarray(ball.radius))
    if isinstance(camera, OrthographicCamera):
        size = radius * camera.height / float(np.asarray(camera.view_height))
    elif isinstance(camera, PerspectiveCamera | PinholeCamera) and depth > radius:
        size = _focal(camera) * radius / np.sqrt(depth**2 - radius**2)
    else:
        raise ValueError("camera: expected one in front of the ball")
    x, y = np.asarray(camera.project(ball.center), float)
    return float(x), float(y), float(size)


def _focal(camera: PerspectiveCamera | PinholeCamera) -> float:
    """Pixels from the pinhole to the image."""
    if isinstance(camera, PinholeCamera):
        return float(np.asarray(camera.fy))
    half = np.radians(float(np.asarray(camera.fov_y))) / 2
    return camera.height / 2 / np.tan(half)
