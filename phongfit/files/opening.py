"""Photographs and their scenes, from whatever states both: the data of a command."""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from phongfit.edge import checked
from phongfit.files.capture_data import open_captured
from phongfit.files.coded import Coded
from phongfit.files.dataset import Photograph, Photographs
from phongfit.files.datasets import open_dataset
from phongfit.files.diligent import is_diligent
from phongfit.files.encodings import parse_encoding
from phongfit.files.images import read_film, read_light, read_mask, with_jpeg
from phongfit.files.records import read_record
from phongfit.files.scenes import SCENE_FILE, build_scene, view_of
from phongfit.files.schema import SceneRecord
from phongfit.files.seen import SOUGHT
from phongfit.fitting.problem.noise import find_film
from phongfit.rendering.film import Encoding, Film
from phongfit.rendering.response import ResponseCurve
from phongfit.scene import Scene


@checked
def open_data(
    dataset: str | os.PathLike[str],
    *,
    scene: str | os.PathLike[str] | None = None,
    sphere: Sequence[float] | None = None,
    normals: str | os.PathLike[str] | None = None,
    lights: str | os.PathLike[str] | None = None,
    fov: float | None = None,
    mask: str | os.PathLike[str] | None = None,
    encoding: str | Encoding | None = None,
    white: int | None = None,
    min_cosine: float = 0.05,
    min_facing: float = 0.15,
    room_light: float = 1.0,
) -> Photographs:
    """The photographs that `phongfit fit` reads with the options of the same names.

        data = pf.open_data("photos", sphere=(179, 155, 81), encoding="srgb").load()
        fit = pf.fit(data.scenes, data.images, mask=data.masks, film=data.film)

    **Arguments:**

    - `dataset`: the folder of a data set: see [`open_dataset`][]; one image, with
        `scene`; or photographs, one or a folder of them, with `sphere` or `normals`:
        see [`open_captured`][].
    - `scene`: with one image, its scene file.
    - `encoding`: of an image or of photographs: a name, a response curve or its file.
        Default: that of the scene file, and sRGB for JPEG files.
    - `mask`, `white`: of an image or of photographs.
    - `room_light`: ambient light of photographs, and of a data set of DiLiGenT's.
    - `sphere`, `normals`, `lights`, `fov`, `min_cosine`, `min_facing`: as in
        [`open_captured`][].

    **Raises:** `ValueError` that names the file or the argument.
    """
    path, sought = Path(dataset), normals is not None and str(normals) == SOUGHT
    itself = {"fov": fov, "mask": mask, "encoding": encoding, "white": white}
    if not path.exists():
        raise ValueError(f"{path}: there is no such file or folder")
    if sought and _is_dataset(path):
        _refuse({"scene": scene, "sphere": sphere, "lights": lights, **itself}, path)
        return open_dataset(path, normals="fit")
    known = parse_encoding(encoding) if isinstance(encoding, str) else encoding
    if sphere is not None or normals is not None:
        if scene is not None:
            given = "normals" if sphere is None else "sphere"
            raise ValueError(f"scene: expected it or {given}, got both")
        return open_captured(
            path,
            known,
            sphere=sphere,
            normals=normals,
            lights=lights,
            fov=fov,
            mask=mask,
            min_cosine=min_cosine,
            min_facing=min_facing,
            room_light=room_light,
            white=white,
        )
    if not path.is_dir():
        if scene is not None and fov is not None:
            raise ValueError(f"fov: {scene} has the camera, expected no other")
        return _one_image(path, scene, known, white, mask)
    if lights is not None or not _is_dataset(path):
        raise ValueError(
            f"{path}: expected --sphere or --normals, the shape that its photographs "
            "show, since it is no data set with a scene.json or a filenames.txt"
        )
    _refuse({"scene": scene, **itself}, path)
    data = open_dataset(path, min_cosine=min_cosine, min_facing=min_facing)
    return data if (path / SCENE_FILE).exists() else _in_a_room(data, room_light)


def _is_dataset(folder: Path) -> bool:
    return (folder / SCENE_FILE).exists() or is_diligent(folder)


def _refuse(given: dict[str, object], folder: Path) -> None:
    """Raise `ValueError` for an argument that a data set's files state."""
    for name, value in given.items():
        if value is not None:
            raise ValueError(f"{name}: {folder} is a data set, which says this itself")


def _in_a_room(data: Photographs, light: float) -> Photographs:
    """Photographs of DiLiGenT with ambient light, which their layout does not state."""

    def read(number: int) -> Photograph:
        coded, mask = data.read(number)
        # Leave out all channels of a pixel with a saturated one, which affects others.
        return Photograph(coded, np.asarray(mask.all(axis=-1)))

    room = (dataclasses.replace(scene, ambient=light) for scene in data.scenes)
    return dataclasses.replace(data, scenes=tuple(room), read=read)


def _one_image(
    path: Path,
    file: str | os.PathLike[str] | None,
    encoding: Encoding | None,
    white: int | None,
    mask: str | os.PathLike[str] | None,
) -> Photographs:
    """One image with its scene file."""
    if file is None:
        raise ValueError(
            f"scene: is missing, {path} is one image and needs --scene, or --sphere or "
            "--normals for its shape"
        )
    record = read_record(Path(file), SceneRecord)
    scene = _scene_of(path, Path(file), record)
    encoding = encoding or record.encoding
    if encoding is None:
        raise ValueError(
            f"encoding: expected --encoding linear or srgb, since {file} does not say "
            "it"
        )
    white = record.white if white is None else white
    light = read_light(path, encoding, white=white)
    used = np.ones(light.image.shape[:2], bool)
    if mask is not None:
        used = read_mask(mask)
    wanted = (scene.camera.height, scene.camera.width)
    for source, array in ((path, light.image), (mask, used)):
        if array.shape[:2] != wanted:
            raise ValueError(
                f"{source}: expected {wanted} pixels, as the camera in {file} has, got "
                f"{array.shape[:2]}"
            )
    film = record.film()
    if film.clamp:
        film = with_jpeg(Film(encoding=encoding), path)
        if film.jpeg is None:
            # Levels of a response curve or of another white are not detectable.
            stated = isinstance(encoding, ResponseCurve) or white is not None
            film = find_film([light.image])
            if stated:
                film = read_film(path, encoding, white=white)
    photograph = Photograph(Coded(light.image), used & light.usable)
    return Photographs(path.stem, (scene,), (path.name,), film, lambda _: photograph)


def _scene_of(path: Path, file: Path, record: SceneRecord) -> Scene:
    """The scene of an image, with the image's lights if the scene file lists it."""
    scene = build_scene(file, record)
    for entry in record.images:
        if (file.parent / entry.file).resolve() == path.resolve():
            return view_of(scene, entry)
    return scene
