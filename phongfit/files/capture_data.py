"""A capture as a data set: photographs with a surface, a camera and lights."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from phongfit.calibration.outlines import View, sphere_behind
from phongfit.calibration.result import Calibration
from phongfit.files.arrays import read_array, unpack
from phongfit.files.calibrations import LIGHTS_FILE, load_calibration
from phongfit.files.captures import Capture, encoding_of, open_capture
from phongfit.files.dataset import Photograph, Photographs
from phongfit.files.images import read_film, read_head, read_mask
from phongfit.files.inputs import naming, read_bytes
from phongfit.files.lp import base_name
from phongfit.geometry.cameras import AbstractCamera, OrthographicCamera
from phongfit.geometry.surfaces import AbstractSurface, NormalMap, Sphere
from phongfit.lights import AbstractLight, DirectionalLight, PointLight
from phongfit.rendering.film import Encoding, Film
from phongfit.scene import Scene

Circle = tuple[float, float, float]

START = (0.2, 0.3, 1.0)
"""Where a lamp is looked for first, of which nothing is known: above the camera."""


def open_captured(
    photographs: str | os.PathLike[str],
    encoding: Encoding | None = None,
    *,
    sphere: Sequence[float] | None = None,
    normals: str | os.PathLike[str] | None = None,
    lights: str | os.PathLike[str] | None = None,
    mask: str | os.PathLike[str] | None = None,
    min_cosine: float = 0.05,
    min_facing: float = 0.15,
    room_light: float = 1.0,
) -> Photographs:
    """Photographs of an object of known shape, whose lights need not be known.

    **Arguments:**

    - `photographs`: one photograph, or a folder of a standing camera's, one lamp each:
        see [`open_capture`][].
    - `encoding`: what their numbers are; JPEG is sRGB unless it says otherwise.
    - `sphere`: the object is a ball, with this outline: x, y and radius in pixels from
        the upper left corner.
    - `normals`: or it has these: an .npz with `normals` (height, width, 3), and perhaps
        `positions` and `mask`, in the camera's axes: x right, y up, z back.
    - `lights`: a calibration's lights.json, or its folder, or an .lp. Default: the .lp
        or lights.json in the folder, else the lights are unknown.
    - `mask`: an image, white where pixels may be used.
    - `min_cosine`: samples with n·l up to this are left out, where a light is known.
    - `min_facing`: pixels with n·v up to this are left out: a rim's pixel averages over
        many normals.
    - `room_light`: ambient light that stands for all that came by way of the room.

    **Raises:** `ValueError` that names the file or the argument.
    """
    path = Path(photographs)
    if path.is_dir():
        capture = open_capture(path, encoding, lights=_list_of(lights))
    else:
        capture = _one(path, encoding)
    source = _calibration(path, lights)
    if (sphere is None) == (normals is None):
        raise ValueError(
            "sphere: expected the shape of what is photographed, by its circle "
            "(sphere) or by its normals, "
            + ("got neither" if sphere is None else "got both")
        )
    width, height = read_head(capture.folder / capture.names[0]).size
    camera, surface = _seen(height, width, source, sphere, normals)
    lamps, unknown = _lamps(capture, source)
    scenes = tuple(Scene(surface, camera, light, ambient=room_light) for light in lamps)
    used = _facing(scenes[0], min_facing)
    if mask is not None:
        used &= _masked(Path(mask), used.shape)
    known = "scene.lights[0].direction" not in unknown

    def read(number: int) -> Photograph:
        image = capture.read(number)
        lit = _lit(scenes[number], min_cosine) if known else True
        return Photograph(image, used & lit)

    def film_of(number: int) -> Film:
        return read_film(capture.folder / capture.names[number], capture.encoding)

    film = film_of(0)
    film = film if film.jpeg is None else Film(encoding=capture.encoding)
    return Photographs(
        path.resolve().stem,
        scenes,
        capture.names,
        film,
        read,
        film_of=film_of,
        unknown=unknown,
    )


def _one(path: Path, encoding: Encoding | None) -> Capture:
    """A single photograph as a capture of one."""
    encoding = encoding_of(path.parent, [path.name], encoding)
    return Capture(path.parent, (path.name,), encoding)


def _list_of(lights: str | os.PathLike[str] | None) -> Path | None:
    is_list = lights is not None and Path(lights).suffix.lower() == ".lp"
    return Path(lights) if is_list and lights is not None else None


def _calibration(
    path: Path, lights: str | os.PathLike[str] | None
) -> Calibration | None:
    if lights is not None:
        return None if _list_of(lights) else load_calibration(lights)
    inside = path / LIGHTS_FILE
    return load_calibration(inside) if inside.exists() else None


def _seen(
    height: int,
    width: int,
    calibration: Calibration | None,
    sphere: Sequence[float] | None,
    normals: str | os.PathLike[str] | None,
) -> tuple[AbstractCamera, AbstractSurface]:
    camera: AbstractCamera | None = None
    if calibration is not None:
        view = calibration.view
        if (view.height, view.width) != (height, width):
            raise ValueError(
                f"lights: expected a calibration of {width} × {height} pixels, as the "
                f"photographs have, got {view.width} × {view.height}"
            )
        camera = calibration.camera
    if normals is not None:
        surface = _read_normals(Path(normals))
        if tuple(surface.mask.shape) != (height, width):
            raise ValueError(
                f"{normals}: expected {width} × {height} normals, as the photographs "
                f"have pixels, got {surface.mask.shape[1]} × {surface.mask.shape[0]}"
            )
        if surface.positions is None or camera is None:
            # Of a long lens: without positions no other is known.
            camera = OrthographicCamera(width, height)
        return camera, surface
    assert sphere is not None
    circle = _circle(sphere, height, width)
    if calibration is None or camera is None:
        # The ball's radius is the unit.
        x, y, radius = circle
        centre = ((x - width / 2) / radius, (height / 2 - y) / radius, 0.0)
        camera = OrthographicCamera(width, height, view_height=height / radius)
        return camera, Sphere(centre, 1.0)
    return camera, _ball(calibration, circle)


def _circle(given: Sequence[float], height: int, width: int) -> np.ndarray:
    circle = np.array(given, float)
    if circle.shape != (3,) or not np.isfinite(circle).all() or not circle[2] > 0:
        raise ValueError(
            f"sphere: expected x, y and radius in pixels, got {list(given)}"
        )
    if not (-circle[2] < circle[0] < width + circle[2]) or not (
        -circle[2] < circle[1] < height + circle[2]
    ):
        raise ValueError(
            f"sphere: expected a circle in the {width} × {height} pixels of the "
            f"photograph, got {list(given)}"
        )
    return circle


def _ball(calibration: Calibration, circle: Float[np.ndarray, "3"]) -> Sphere:
    """The ball behind a circle, as deep as the calibration's spheres."""
    view: View = calibration.view
    if view.focal is None:
        assert calibration.view_height is not None
        radius = circle[2] * calibration.view_height / view.height
        return Sphere(sphere_behind(circle, view, radius), radius)
    centre = sphere_behind(circle, view, 1.0)
    radius = calibration.reference[2] / centre[2]
    return Sphere(centre * radius, radius)


def _read_normals(path: Path) -> NormalMap:
    normals = read_array(path, "normals")
    others = {} if path.suffix.lower() == ".npy" else unpack(read_bytes(path))
    with naming(str(path)):
        if normals.ndim != 3 or normals.shape[-1] != 3:
            raise ValueError(
                f"normals: expected (height, width, 3), got {normals.shape}"
            )
        there = np.any(normals != 0, axis=-1)
        return NormalMap(normals, others.get("mask", there), others.get("positions"))


def _lamps(
    capture: Capture, calibration: Calibration | None
) -> tuple[list[AbstractLight], tuple[str, ...]]:
    """A light for each photograph, and what of them is not known."""
    several = len(capture.names) > 1
    strength = ("exposure",) if several else ()
    if calibration is not None:
        by_name: dict[str, Any] = {
            base_name(lamp.photograph): (lamp, light)
            for lamp, light in zip(calibration.lamps, calibration.lights, strict=True)
        }
        missing = [name for name in capture.names if name not in by_name]
        if missing:
            raise ValueError(
                f"lights: expected one for each photograph, got none for {missing[0]}"
                + (f" and {len(missing) - 1} others" if len(missing) > 1 else "")
            )
        found = [by_name[name] for name in capture.names]
        known = all(np.isfinite(lamp.intensity).all() for lamp, _ in found)
        return [light for _, light in found], () if known else strength
    if capture.lights is not None:
        # In the photographs' own order, which is the list's.
        vectors = capture.lights.vectors
        return [
            DirectionalLight(vector / np.linalg.norm(vector)) for vector in vectors
        ], strength
    lamps: list[AbstractLight] = [DirectionalLight(START) for _ in capture.names]
    return lamps, ("scene.lights[0].direction", *strength)


def _facing(scene: Scene, least: float) -> Bool[np.ndarray, "height width"]:
    """Pixels that see the surface, and not aslant."""
    seen = scene.trace()
    cosine = np.sum(np.asarray(seen.normal) * np.asarray(seen.to_viewer), axis=-1)
    return np.asarray(seen.mask) & (cosine > least)


def _lit(scene: Scene, least: float) -> Bool[np.ndarray, "height width"]:
    """Pixels that the scene's light shines on, and not aslant."""
    seen, light = scene.trace(), scene.lights[0]
    normals = np.asarray(seen.normal)
    if isinstance(light, PointLight):
        to_light = np.asarray(light.position) - np.asarray(seen.position)
    else:
        assert isinstance(light, DirectionalLight)
        to_light = np.broadcast_to(np.asarray(light.direction), normals.shape)
    length = np.linalg.norm(to_light, axis=-1)
    return np.sum(normals * to_light, axis=-1) > least * length


def _masked(path: Path, shape: tuple[int, ...]) -> Bool[np.ndarray, "height width"]:
    mask = read_mask(path)
    if mask.shape != shape:
        raise ValueError(
            f"{path}: expected {shape[1]} × {shape[0]} pixels, as the photographs "
            f"have, got {mask.shape[1]} × {mask.shape[0]}"
        )
    return mask
