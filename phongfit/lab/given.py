"""Photographs given to the command, as targets: a capture or a data set."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from phongfit.calibration.spheres import find_ball
from phongfit.files.capture_data import (
    DIRECTION,
    list_of,
    masked,
    open_captured,
)
from phongfit.files.captures import Capture, open_capture
from phongfit.files.dataset import Photograph, Photographs
from phongfit.files.datasets import open_dataset
from phongfit.files.encodings import parse_encoding
from phongfit.files.images import read_film
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
from phongfit.rendering.film import Encoding
from phongfit.scene import Scene

PLAIN = (".png", ".bmp", ".tif", ".tiff")
"""Formats whose files may hold 8 bits without a statement of their encoding."""

SEARCHED = 8
"""Maximum number of photographs of a folder in which the circle is searched for."""


def open_given(
    photographs: Path,
    sphere: tuple[float, float, float] | None = None,
    lights: Path | None = None,
    encoding: str | None = None,
    white: int | None = None,
) -> Photographs:
    """Photographs of a ball, one or a folder of them, or a data set of a ball.

    The circle of the ball is searched for unless `sphere` states it. The `notes` list
    assumptions.

    **Raises:** `ValueError` that names the file or the option.
    """
    if not photographs.exists():
        raise ValueError(f"{photographs}: there is no such file or folder")
    is_dataset = photographs.is_dir() and (photographs / SCENE_FILE).exists()
    if is_dataset and sphere is None:
        given = {"lights": lights, "encoding": encoding, "white": white}
        for name, value in given.items():
            if value is not None:
                raise ValueError(f"{name}: {photographs} is a data set with its own")
        found = open_dataset(photographs)
    else:
        found = _open_ball(photographs, sphere, lights, encoding, white)
    for scene, name in zip(found.scenes, found.names, strict=True):
        with naming(name):
            settings_of(scene)
    return found


def _open_ball(
    path: Path,
    sphere: tuple[float, float, float] | None,
    lights: Path | None,
    encoding: str | None,
    white: int | None,
) -> Photographs:
    """Photographs of a ball, with known or unknown circle and lamps."""
    known, notes = _encoding_of(path, encoding)
    capture = None
    if sphere is None:
        capture = open_capture(path, known, lights=list_of(lights), white=white)
        sphere = x, y, radius = _find_circle(path, capture)
        notes += (
            f"the ball's circle was found in the photograph: centre {x:.1f}, {y:.1f}, "
            f"radius {radius:.1f} pixels. Compare it with the yellow outline",
        )
    given = open_captured(path, known, sphere=sphere, lights=lights, white=white)
    if capture is not None:
        given = dataclasses.replace(given, read=_reader(capture))
    if DIRECTION in given.unknown:
        notes += (
            "the lamp's direction is unknown: a fit looks for it, from where the "
            "sliders have it",
        )
    return dataclasses.replace(given, notes=(*given.notes, *notes))


def _find_circle(path: Path, capture: Capture) -> tuple[float, float, float]:
    """Centre and radius of the ball, in pixels.

    **Raises:** `ValueError` that names the photographs if no circle is clear enough.
    """
    count = len(capture.names)
    chosen = np.linspace(0, count - 1, min(count, SEARCHED)).astype(int)
    images = [capture.image(int(k)) for k in chosen]
    circle = find_ball(images, [capture.names[k] for k in chosen])
    if circle is None:
        raise ValueError(
            f"sphere: no circle of a ball was found in {path}: state it, --sphere X Y "
            "R, its centre and radius in pixels from the upper left corner"
        )
    x, y, radius = map(float, circle)
    return x, y, radius


def _reader(capture: Capture) -> Callable[[int], Photograph]:
    """A reader of photographs with masks that do not depend on the ball's circle.

    The circle is an estimate that the page's sliders correct, so a mask made from it
    could exclude pixels of the ball.
    """
    used = np.ones(capture.series.size, bool)
    if capture.mask is not None:
        used = masked(capture.mask, used.shape)

    def read(number: int) -> Photograph:
        photo = capture.series.read(number)
        return Photograph(photo.coded, used & photo.usable)

    return read


def _encoding_of(
    path: Path, encoding: str | None
) -> tuple[Encoding | None, tuple[str, ...]]:
    """The encoding of a photograph, and a note where it is assumed."""
    known = parse_encoding(encoding)
    if known is not None or path.suffix.lower() not in PLAIN:
        return known, ()
    if read_film(path, "srgb").bits != 8:
        return None, ()
    return "srgb", (
        f"the encoding of {path.name} is not known: it is read as sRGB, as cameras and "
        "the web write 8 bits. If its numbers are linear, start with --encoding linear",
    )


def settings_of(scene: Scene) -> dict[str, Any]:
    """Settings of the sliders for a scene: its ball, its lamp, its ambient light.

    Rays are treated as parallel, and direction and intensity of the light are those at
    the ball's centre. A lamp with a position is near, unless it is beyond the slider's
    range.

    **Raises:** `ValueError` that names a part that the sliders cannot show.
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
        # Axes of the nearly parallel rays to a ball off the optical axis.
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
    # The page sends these settings back, so validate them now.
    Settings.model_validate(found)
    return found


def _near(light: AbstractLight, ball: Sphere) -> dict[str, float]:
    """Distance and fall-off of a near lamp; empty for a far one.

    The fall-off has the same derivative by distance at the ball as the attenuation.
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
    """Focal length in pixels."""
    if isinstance(camera, PinholeCamera):
        return float(np.asarray(camera.fy))
    half = np.radians(float(np.asarray(camera.fov_y))) / 2
    return camera.height / 2 / np.tan(half)
