"""Scene files: `scene.json`, with or without the images of a data set."""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from phongfit.edge import checked
from phongfit.files.arguments import describe
from phongfit.files.arrays import write_array
from phongfit.files.budget import afford
from phongfit.files.dataset import Photograph, Photographs
from phongfit.files.encodings import describe_encoding
from phongfit.files.images import read_light, read_mask, with_jpeg, write_image
from phongfit.files.inputs import check_spared, inside, naming, naming_field
from phongfit.files.outputs import write_json
from phongfit.files.records import read_record
from phongfit.files.schema import (
    SCENE_FORMAT,
    TRUTH_FORMAT,
    ImageRecord,
    SceneRecord,
    TruthRecord,
    describe_material,
)
from phongfit.files.strict_json import unexpected
from phongfit.geometry.cameras import AbstractCamera
from phongfit.geometry.surfaces import NormalMap
from phongfit.material import Material
from phongfit.rendering.film import Film
from phongfit.scene import Scene

SCENE_FILE = "scene.json"
TRUTH_FILE = "truth.json"

PIXEL, LIGHT = 16, 48
"""Bytes that a render takes for each pixel, and in addition for each light."""


@checked
def load_scene(path: str | os.PathLike[str]) -> Scene:
    """A scene from its file, or from the folder of a data set, with all lights on.

    **Raises:** `ValueError` that names the file, the field, what was expected and
    what was got.
    """
    path = _scene_file(path)
    return build_scene(path, read_record(path, SceneRecord))


def load_views(path: str | os.PathLike[str]) -> tuple[tuple[Scene, ...], Film]:
    """A scene for each image that a scene file lists; a single one if it lists none.

    Image files are not read.

    **Returns:** the scenes, and the film of the images.

    **Raises:** `ValueError` as [`load_scene`][] does.
    """
    path = _scene_file(path)
    record = read_record(path, SceneRecord)
    scene = build_scene(path, record)
    views = _views(path, record, scene)
    return tuple(views) or (with_lights(scene, None),), record.film()


@checked
def save_scene(
    path: str | os.PathLike[str],
    scene: Scene,
    *,
    film: Film | None = None,
    images: Sequence[ImageRecord] = (),
    cameras: Sequence[AbstractCamera] = (),
    white: int | None = None,
) -> None:
    """Write a scene to a file that [`load_scene`][] reads.

    **Arguments:**

    - `path`: a file name, or a folder that gets a `scene.json`. The arrays of a normal
        map or a mesh go into files beside it.
    - `scene`: with all lights that are on in any of `images`.
    - `film`: clamp, encoding and rounding of `images`; needed with them.
    - `images`: records of the photographs of a data set.
    - `cameras`: one for each image, if they differ from the scene's.
    - `white`: the number that is white in the images' files: see [`read_image`][].

    **Raises:** `ValueError` for a part that scene files cannot hold, `OSError` if a
    file cannot be written.
    """
    path = _scene_file(path)
    arrays: dict[str, np.ndarray] = {}
    data: dict[str, Any] = {"format": SCENE_FORMAT, "version": 1}
    data |= describe(scene, path.stem, arrays)
    if film is not None:
        data["encoding"] = describe_encoding(film.encoding)
        data["clamped"] = film.clamp
        data |= {} if film.bits is None else {"bits": film.bits}
        data |= {} if white is None else {"white": white}
    if images:
        data["images"] = [image.model_dump(exclude_none=True) for image in images]
        own = cameras or [None] * len(images)
        for entry, camera in zip(data["images"], own, strict=True):
            entry |= {} if camera is None else {"camera": describe(camera)}
    for name, array in arrays.items():
        _write_beside(path.with_name(name), array)
    write_json(path, data)


def load_truth(path: str | os.PathLike[str]) -> Material:
    """The material in a `truth.json`.

    **Raises:** `ValueError` as [`load_scene`][] does.
    """
    path = Path(path)
    record = read_record(path, TruthRecord)
    with naming(str(path)), naming_field("material"):
        return record.material.build()


def save_truth(
    path: str | os.PathLike[str],
    material: Material,
    *,
    noise: float | None = None,
    seed: int | None = None,
) -> None:
    """Write the true material of the images of a data set.

    **Arguments:**

    - `material`: with parameters of shape () or (3,).
    - `noise`: standard deviation in linear light, where white is 1.
    - `seed`: of the noise.
    """
    settings = {"noise": noise, "seed": seed}
    known = {name: value for name, value in settings.items() if value is not None}
    head = {"format": TRUTH_FORMAT, "version": 1}
    write_json(path, head | {"material": describe_material(material)} | known)


def open_scene_dataset(folder: str | os.PathLike[str]) -> Photographs:
    """A data set whose `scene.json` lists its images.

    **Raises:** `ValueError` that names the file, the field, what was expected and
    what was got.
    """
    folder = Path(folder)
    with naming(str(folder)):
        path, truth = inside(folder, SCENE_FILE), inside(folder, TRUTH_FILE)
    record = read_record(path, SceneRecord)
    scene = build_scene(path, record)
    with naming(str(path)):
        _check_images(record)
    scenes = _views(path, record, scene)
    return Photographs(
        folder.resolve().name,
        tuple(scenes),
        tuple(entry.file for entry in record.images),
        record.film(),
        lambda number: _read_entry(path, record, scenes[number].camera, number),
        load_truth(truth) if truth.exists() else None,
        lambda number: with_jpeg(
            record.film(), inside(folder, record.images[number].file)
        ),
    )


def _views(path: Path, record: SceneRecord, scene: Scene) -> list[Scene]:
    """A scene for each image that a record lists."""
    views = []
    for at, entry in enumerate(record.images):
        with naming_field(f"{path}: images[{at}]"):
            views.append(view_of(scene, entry))
    return views


def view_of(scene: Scene, entry: ImageRecord) -> Scene:
    """The scene of one image, with the image's lights, and its camera if it has one.

    **Raises:** `ValueError` that begins with the field of the image.
    """
    if entry.camera is not None:
        with naming_field("camera"):
            camera = entry.camera.build()
        scene = dataclasses.replace(scene, camera=camera)
        check_size(scene)
    return with_lights(scene, entry.lights)


def _scene_file(path: str | os.PathLike[str]) -> Path:
    path = Path(path)
    return path / SCENE_FILE if path.is_dir() else path


def build_scene(path: Path, record: SceneRecord) -> Scene:
    """The scene of a record, with all lights on.

    **Arguments:** `path`: of its file, for messages.

    **Raises:** `ValueError` as [`load_scene`][] does.
    """
    with naming(str(path)):
        scene = record.build()
        check_size(scene)
    for entry in record.images:
        for name in (entry.file, entry.mask):
            if name is not None:
                check_spared(path.parent / name)
    return scene


def check_size(scene: Scene) -> None:
    """Check that a scene's image fits in memory, and that its normal map is as large.

    **Raises:** `ValueError` that names the field.
    """
    width, height = scene.camera.width, scene.camera.height
    with naming("camera.width"):
        afford(width * height * (PIXEL + LIGHT), f"{width} × {height} pixels")
    surface = scene.surface
    if isinstance(surface, NormalMap) and surface.mask.shape != (height, width):
        raise ValueError(
            f"surface: expected a normal map of {(height, width)} pixels, as the "
            f"camera has, got {surface.mask.shape}"
        )


def _check_images(record: SceneRecord) -> None:
    if not record.images:
        raise ValueError("images: is missing, expected at least one in a data set")
    if record.encoding is None:
        raise ValueError("encoding: is missing, expected 'linear' or 'srgb'")


def _read_entry(
    path: Path, record: SceneRecord, camera: AbstractCamera, at: int
) -> Photograph:
    """Image and mask of one photograph of a data set."""
    entry, size = record.images[at], (camera.height, camera.width)
    with naming(f"{path}: images[{at}]"):
        file = inside(path.parent, entry.file)
        mask_file = None if entry.mask is None else inside(path.parent, entry.mask)
    encoding = record.encoding or "linear"
    photo = read_light(file, encoding, white=record.white)
    mask = photo.usable if mask_file is None else read_mask(mask_file)
    for source, shape in ((file, photo.usable.shape), (mask_file, mask.shape)):
        if shape != size:
            raise ValueError(
                f"{source}: expected {size[1]} × {size[0]} pixels, as the camera in "
                f"{path.name} has, got {shape[1]} × {shape[0]}"
            )
    return Photograph(photo.coded, mask & photo.usable)


def with_lights(scene: Scene, on: Sequence[int] | None) -> Scene:
    """The scene with some of its lights, in this order; `None` keeps all.

    **Raises:** `ValueError` for repeated or unknown numbers of lights, and for more
    lights than fit in memory.
    """
    count = len(scene.lights)
    if on is not None and (len(set(on)) != len(on) or not set(on) <= set(range(count))):
        raise unexpected("lights", f"different numbers from 0 to {count - 1}", list(on))
    width, height = scene.camera.width, scene.camera.height
    shining = count if on is None else len(on)
    with naming("lights"):
        afford(
            width * height * (PIXEL + LIGHT * shining),
            f"{width} × {height} pixels under {shining} lights at once",
        )
    if on is None:
        return scene
    return dataclasses.replace(scene, lights=[scene.lights[index] for index in on])


def _write_beside(path: Path, array: np.ndarray) -> None:
    if path.suffix == ".npy":
        write_array(path, array)
    else:
        write_image(path, array.astype(float), "linear")
