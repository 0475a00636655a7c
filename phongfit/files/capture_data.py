"""A capture as a data set: photographs with a surface, a camera and lights."""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from phongfit.calibration.result import Calibration, Lamp
from phongfit.edge import checked
from phongfit.files.calibrations import LIGHTS_FILE, load_calibration
from phongfit.files.captures import Capture, open_capture
from phongfit.files.dataset import Photograph, Photographs
from phongfit.files.images import read_film, read_mask
from phongfit.files.lp import LightList
from phongfit.files.matching import base_name, match_names
from phongfit.files.seen import SOUGHT, seen_in
from phongfit.lights import AbstractLight, DirectionalLight, PointLight, brighter
from phongfit.rendering.film import Encoding, Film
from phongfit.scene import Scene

Circle = tuple[float, float, float]

DIRECTION = "scene.lights[0].direction"
"""The unknown of lamps without a calibration or list, besides their strength."""

START = (0.2, 0.3, 1.0)
"""Initial direction of an unknown lamp: above the camera."""


@checked
def open_captured(
    photographs: str | os.PathLike[str],
    encoding: Encoding | None = None,
    *,
    sphere: Sequence[float] | None = None,
    normals: str | os.PathLike[str] | None = None,
    lights: str | os.PathLike[str] | None = None,
    fov: float | None = None,
    mask: str | os.PathLike[str] | None = None,
    min_cosine: float = 0.05,
    min_facing: float = 0.15,
    room_light: float = 1.0,
    white: int | None = None,
) -> Photographs:
    """Photographs of an object of known shape, under known or unknown lights.

    **Arguments:**

    - `photographs`: one photograph, or a folder of photographs from one standing
        camera, each under one lamp: see [`open_capture`][].
    - `encoding`: of the files' numbers; default sRGB for JPEG files.
    - `sphere`: outline of an object that is a ball: x, y and radius in pixels from the
        upper left corner.
    - `normals`: normals of any other object: an .npz with `normals` (height, width, 3),
        and perhaps `positions` and `mask`, in the camera's axes: x right, y up, z back.
        `"fit"`: [`fit_maps`][] will fit the normals; the surface is then a plane, the
        lights must be known, and no pixel is left out for its normal.
    - `lights`: a calibration's lights.json, or its folder, or an .lp. Default: the .lp
        or lights.json in the folder, else the lights are unknown.
    - `fov`: the camera's angle from the lower to the upper edge, degrees; 0 for
        parallel rays. Default: that of the calibration, else, with a ball or where
        normals are fitted, that of the EXIF data, else 0.
    - `mask`: an image, white where pixels may be used. Default: the mask in the folder,
        mask.png or NAME.mask.png, if there is one; `notes` then mentions it.
    - `min_cosine`: samples with n·l up to this are left out, where a light is known.
    - `min_facing`: pixels with n·v up to this are left out: a rim's pixel averages over
        many normals.
    - `room_light`: ambient light, for all light that the room reflects.
    - `white`: the number that is white in the files: see [`read_image`][].

    If exposures differ, photographs stay as they are, and the lights of their scenes
    are multiplied by the relative exposures. Photographs that the calibration left out
    are left out.

    **Raises:** `ValueError` that names the file or the argument.
    """
    path = Path(photographs)
    capture = open_capture(path, encoding, lights=list_of(lights), white=white)
    source = calibration_of(path, lights)
    told: tuple[str, ...] = ()
    if source is not None:
        source, told = renamed(source, capture.names)
        capture = capture.without(source.left_out.keys())
    if (sphere is None) == (normals is None):
        raise ValueError(
            "sphere: expected the shape of what is photographed, by its circle "
            "(sphere) or by its normals, "
            + ("got neither" if sphere is None else "got both")
        )
    series = capture.series
    height, width = series.size
    if source is None and fov is None and series.fov is not None:
        # EXIF data do not apply to normals from a file, which have their own camera.
        if sphere is not None or normals == SOUGHT:
            fov = series.fov
            told += (f"the camera sees {fov:.3g}° from bottom to top (EXIF; or fov)",)
    camera, surface = seen_in(height, width, source, sphere, normals, fov)
    lamps, unknown = find_lamps(capture, source)
    scenes = tuple(
        Scene(surface, camera, light, ambient=room_light * float(exposure))
        for light, exposure in zip(lamps, series.relative_exposures, strict=True)
    )
    sought, known = normals == SOUGHT, DIRECTION not in unknown
    if sought and not known:
        raise ValueError(
            f"lights: expected them where normals are sought: an .lp or {LIGHTS_FILE} "
            f"in {path}, or given"
        )
    used = np.ones((height, width), bool)
    if not sought:
        used = facing(scenes[0], min_facing)
    if mask is None and capture.mask is not None:
        mask = capture.mask
        told += (f"pixels that are black in {capture.mask.name} are left out",)
    if mask is not None:
        used &= masked(Path(mask), used.shape)

    def read(number: int) -> Photograph:
        photo = series.read(number)
        lit = _lit(scenes[number], min_cosine) if known and not sought else True
        return Photograph(photo.coded, used & photo.usable & lit)

    def film_of(number: int) -> Film:
        return read_film(series.paths[number], series.encoding, white=white)

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
        notes=(*series.notes, *told),
        uncertain=_uncertain(capture, source),
    )


def list_of(lights: str | os.PathLike[str] | None) -> Path | None:
    """The path of an .lp file, or `None` if `lights` is none."""
    is_list = lights is not None and Path(lights).suffix.lower() == ".lp"
    return Path(lights) if is_list and lights is not None else None


def calibration_of(
    path: Path, lights: str | os.PathLike[str] | None
) -> Calibration | None:
    """The calibration at `lights`, or else in the photographs' folder, if any.

    **Raises:** `ValueError` that names the file.
    """
    if lights is not None:
        return None if list_of(lights) else load_calibration(lights)
    inside = path / LIGHTS_FILE
    return load_calibration(inside) if inside.exists() else None


def find_lamps(
    capture: Capture, calibration: Calibration | None
) -> tuple[list[AbstractLight], tuple[str, ...]]:
    """A light for each photograph, and the unknown parameters of the lights.

    Differing exposures multiply the lights, not the photographs: these keep the clipped
    and rounded values of their files.

    **Raises:** `ValueError` for a photograph that the calibration does not name.
    """
    lights, unknown = lamps_of(capture.names, capture.lights, calibration)
    exposures = capture.series.relative_exposures
    found = [brighter(light, e) for light, e in zip(lights, exposures, strict=True)]
    return found, unknown


def _uncertain(
    capture: Capture, calibration: Calibration | None
) -> dict[tuple[str, ...], np.ndarray]:
    """Covariance of a calibration's lamps, in the order of the photographs."""
    if calibration is None:
        return {}
    order = _order(capture.names, calibration)
    lamps, count = [calibration.lamps[k] for k in order], len(calibration.lamps)
    rows = (3 * np.array(order)[:, None] + np.arange(3)).ravel()
    size, eye = len(rows), np.eye(6 * count + 1)
    # Rows that select places, strengths and the common fall-off from its unknowns.
    where, strength, falloff = eye[rows], eye[3 * count + rows], eye[-1:]
    parts = {"scene.lights[0].direction": where}
    if lamps[0].position is not None:
        attenuation = _attenuation(lamps, calibration)
        parts = {
            "scene.lights[0].position": where,
            "scene.lights[0].attenuation": attenuation[:, :size] @ where
            + attenuation[:, size:] @ falloff,
        }
    if np.isfinite([lamp.intensity_error for lamp in lamps]).all():
        exposures = np.repeat(capture.series.relative_exposures, 3)
        parts["scene.lights[0].intensity"] = exposures[:, None] * strength
    slopes = np.concatenate(list(parts.values()))
    known = np.nan_to_num(calibration.joint)
    return {tuple(parts): slopes @ known @ slopes.T}


def _attenuation(
    lamps: Sequence[Lamp], calibration: Calibration
) -> Float[np.ndarray, "rows columns"]:
    """Derivatives of near lamps' attenuations by their positions and by the fall-off.

    An attenuation is (1 − κ, 0, κ / d²), with one κ for all lamps and the distance d
    from the lamp to the reference point, where its strength is known.
    """
    slopes = np.zeros((3 * len(lamps), 3 * len(lamps) + 1))
    for k, lamp in enumerate(lamps):
        offset = lamp.position - calibration.reference
        squared = offset @ offset
        mine = slice(3 * k, 3 * k + 3)
        slopes[3 * k + 2, mine] = -2 * min(calibration.falloff, 1) * offset / squared**2
        slopes[mine, -1] = -1, 0, 1 / squared
    return slopes


def lamps_of(
    names: Sequence[str], listed: LightList | None, calibration: Calibration | None
) -> tuple[Sequence[AbstractLight], tuple[str, ...]]:
    """A light for each photograph's name, and the unknown parameters of the lights.

    **Raises:** `ValueError` for a photograph that the calibration does not name.
    """
    several = len(names) > 1
    strength = ("exposure",) if several else ()
    if calibration is not None:
        order = _order(names, calibration)
        known = np.isfinite([calibration.lamps[k].intensity for k in order]).all()
        return [calibration.lights[k] for k in order], () if known else strength
    if listed is not None:
        # The list is already in the order of the photographs.
        vectors = listed.vectors
        return [
            DirectionalLight(vector / np.linalg.norm(vector)) for vector in vectors
        ], strength
    lamps: list[AbstractLight] = [DirectionalLight(START) for _ in names]
    return lamps, (DIRECTION, *strength)


def renamed(
    calibration: Calibration, names: Sequence[str]
) -> tuple[Calibration, tuple[str, ...]]:
    """A calibration with the names of other photographs under the same lamps.

    **Returns:** the calibration, and a note on the matching unless all names agree.
    """
    lamps, left_out = calibration.lamps, calibration.left_out
    listed = [*(lamp.photograph for lamp in lamps), *left_out]
    match = match_names(names, listed)
    if not match.note:
        return calibration, ()
    pairs = zip(names, match.places, strict=True)
    partner = {listed[place]: name for name, place in pairs if place is not None}
    return dataclasses.replace(
        calibration,
        lamps=tuple(
            dataclasses.replace(
                lamp, photograph=partner.get(lamp.photograph, lamp.photograph)
            )
            for lamp in lamps
        ),
        left_out={partner.get(name, name): why for name, why in left_out.items()},
    ), (match.note,)


def _order(names: Sequence[str], calibration: Calibration) -> list[int]:
    """Index of the calibrated lamp of each photograph."""
    lamps = {base_name(x.photograph): k for k, x in enumerate(calibration.lamps)}
    missing = [name for name in names if name not in lamps]
    if missing:
        raise ValueError(
            f"lights: expected one for each photograph, got none for {missing[0]}"
            + (f" and {len(missing) - 1} others" if len(missing) > 1 else "")
        )
    return [lamps[name] for name in names]


def facing(scene: Scene, least: float) -> Bool[np.ndarray, "height width"]:
    """Pixels that see the surface with n·v above `least`."""
    seen = scene.trace()
    cosine = np.sum(np.asarray(seen.normal) * np.asarray(seen.to_viewer), axis=-1)
    return np.asarray(seen.mask) & (cosine > least)


def _lit(scene: Scene, least: float) -> Bool[np.ndarray, "height width"]:
    """Pixels whose n·l for the scene's light is above `least`."""
    seen, light = scene.trace(), scene.lights[0]
    normals = np.asarray(seen.normal)
    if isinstance(light, PointLight):
        to_light = np.asarray(light.position) - np.asarray(seen.position)
    else:
        assert isinstance(light, DirectionalLight)
        to_light = np.broadcast_to(np.asarray(light.direction), normals.shape)
    length = np.linalg.norm(to_light, axis=-1)
    return np.sum(normals * to_light, axis=-1) > least * length


def masked(path: Path, shape: tuple[int, ...]) -> Bool[np.ndarray, "height width"]:
    """A mask from its file, which must have the photographs' size.

    **Raises:** `ValueError` that names the file.
    """
    mask = read_mask(path)
    if mask.shape != shape:
        raise ValueError(
            f"{path}: expected {shape[1]} × {shape[0]} pixels, as the photographs "
            f"have, got {mask.shape[1]} × {mask.shape[0]}"
        )
    return mask
