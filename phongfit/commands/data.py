"""Photographs from a data set's folder, or one image with its scene file."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import numpy as np
from tyro.conf import Positional, arg

from phongfit.commands.options import EncodingName, WhiteLevel, optional
from phongfit.files.capture_data import open_captured
from phongfit.files.coded import Coded
from phongfit.files.dataset import Dataset, Photograph, Photographs
from phongfit.files.datasets import open_dataset
from phongfit.files.diligent import is_diligent
from phongfit.files.encodings import parse_encoding
from phongfit.files.fits import DataRecord, DataSettings
from phongfit.files.images import read_film, read_light, read_mask, with_jpeg
from phongfit.files.inputs import recording
from phongfit.files.records import read_record
from phongfit.files.scenes import SCENE_FILE, TRUTH_FILE, build_scene, view_of
from phongfit.files.schema import SceneRecord
from phongfit.files.seen import SOUGHT
from phongfit.fitting.problem.noise import find_film
from phongfit.maps.stacks import DatasetStack
from phongfit.plain import readable
from phongfit.rendering.film import Film
from phongfit.rendering.response import ResponseCurve
from phongfit.scene import Scene

T = TypeVar("T")


@dataclass(frozen=True)
class DataOptions:
    """The photographs to fit, and how they are read.

    Args:
        dataset: A data set's folder, as `phongfit synth` makes it or in DiLiGenT's
            layout; one image, with --scene; or photographs, one or a folder of them,
            with --sphere or --normals.
        scene: With one image: its scene.json.
        sphere: The photographs show a ball: x and y of its centre and its radius in
            pixels, from the upper left corner.
        normals: The photographs show a surface with these normals: an .npz with
            normals, and optionally positions and mask, or an .npy. fit: fit the
            normals too, with `phongfit maps`, under known lights.
        lights: With photographs: their lights, from `phongfit calibrate`, or an .lp
            list, in which a photograph's lamp is found by its name. Default: those in
            the folder; else the lights are fitted.
        fov: With photographs: the camera's angle of view, from the lower to the upper
            edge; 0 for parallel rays, as of a long lens from far away. fit: find it,
            with --normals fit and distant lamps. Default: that of the calibration, else
            by the photographs' EXIF data, else 0.
        mask: With an image or photographs: white where a pixel may be used. Default,
            with a folder of photographs: the mask in it, mask.png or NAME.mask.png, if
            there is one.
        encoding: With an image or photographs: encoding of their numbers, or the file
            of a response curve from `phongfit response`. Default: that of the scene
            file, and srgb for JPEG.
        white: With an image or photographs: the number in the files that is white, such
            as 4095 for 12 bits in PNGs of 16. Default: that of the scene file, and the
            largest of the format.
        min_cosine: With photographs: samples with n·l up to this are left out, since
            there interreflections dominate.
        min_facing: With photographs: pixels with n·v up to this are left out, since
            pixels at the rim average over many normals.
        room_light: With photographs: ambient light, which stands for light reflected
            by the room; 0 for none.
    """

    dataset: Annotated[Positional[Path], arg(metavar="DATASET")]

    scene: Annotated[Path | None, optional("FILE")] = None

    sphere: Annotated[tuple[float, float, float] | None, optional("X Y R")] = None

    normals: Annotated[Path | None, optional("FILE|fit")] = None

    lights: Annotated[Path | None, optional("FILE")] = None

    fov: Annotated[float | Literal["fit"] | None, optional("DEGREES|fit")] = None

    mask: Annotated[Path | None, optional("FILE")] = None

    encoding: EncodingName = None

    white: WhiteLevel = None

    min_cosine: Annotated[float, arg(metavar="X")] = 0.05

    min_facing: Annotated[float, arg(metavar="X")] = 0.15

    room_light: Annotated[float, arg(metavar="X")] = 1.0

    def settings(self) -> DataSettings:
        """Settings of reading, for records."""
        return DataSettings(
            encoding=self.encoding,
            min_cosine=self.min_cosine,
            min_facing=self.min_facing,
            room_light=self.room_light,
            sphere=self.sphere,
            normals=None if self.normals is None else str(self.normals),
            lights=None if self.lights is None else str(self.lights),
            fov=self.known_fov,
            white=self.white,
        )

    def like(self, reading: DataSettings) -> "DataOptions":
        """Options with the same photographs and the settings of reading of a record."""
        given = reading.model_dump()
        for name in ("normals", "lights"):
            given[name] = None if given[name] is None else Path(given[name])
        return dataclasses.replace(self, **given)

    @property
    def sought(self) -> bool:
        """True if normals are to be fitted."""
        return self.normals is not None and str(self.normals) == SOUGHT

    @property
    def known_fov(self) -> float | None:
        """The given angle of view; 0 if it is to be fitted."""
        return 0.0 if self.fov == "fit" else self.fov


def read_data(options: DataOptions) -> tuple[Dataset, DataRecord]:
    """The photographs in memory, and a record of the files and settings.

    **Raises:** `ValueError` that names the file or the option.
    """
    if options.sought:
        raise ValueError(
            "normals: expected a file, got fit: only `phongfit maps` seeks normals"
        )
    if options.fov == "fit":
        raise ValueError(
            "fov: expected degrees, got fit: only `phongfit maps --normals fit` fits it"
        )
    return _recorded(options, Photographs.load)


def stack_data(options: DataOptions) -> tuple[DatasetStack, DataRecord]:
    """The photographs as a stack that holds one in memory at a time, and a record."""
    return _recorded(options, DatasetStack)


def _recorded(
    options: DataOptions, make: Callable[[Photographs], T]
) -> tuple[T, DataRecord]:
    """The result of `make`, which must read all photographs, and a record of files."""
    with recording() as checksums:
        if options.sought and _is_dataset(options.dataset):
            photographs = _open_sought(options)
        elif options.sphere is not None or options.normals is not None:
            photographs = _open_captured(options)
        elif options.dataset.is_dir():
            photographs = _open_folder(options)
        else:
            photographs = _read_single(options)
        made = make(photographs)
    files = {path.resolve(): digest for path, digest in checksums.items()}
    home = options.dataset.resolve()
    home = home if home.is_dir() else home.parent
    inputs = {
        readable(str(p.relative_to(home)) if p.is_relative_to(home) else p.name): digest
        for p, digest in sorted(files.items())
        # The true material is not an input of a fit.
        if p.name != TRUTH_FILE
    }
    name = readable(photographs.name)
    return made, DataRecord(name=name, reading=options.settings(), inputs=inputs)


def tell(notes: Sequence[str]) -> None:
    """Print assumptions about photographs."""
    for note in notes:
        print(f"assumed: {note}", flush=True)


def _open_captured(options: DataOptions) -> Photographs:
    if options.scene is not None:
        given = "sphere" if options.sphere is not None else "normals"
        raise ValueError(f"scene: expected it or {given}, got both")
    if not options.dataset.exists():
        raise ValueError(f"{options.dataset}: there is no such file or folder")
    return open_captured(
        options.dataset,
        parse_encoding(options.encoding),
        sphere=options.sphere,
        normals=SOUGHT if options.sought else options.normals,
        lights=options.lights,
        fov=options.known_fov,
        mask=options.mask,
        min_cosine=options.min_cosine,
        min_facing=options.min_facing,
        room_light=options.room_light,
        white=options.white,
    )


def _open_sought(options: DataOptions) -> Photographs:
    """A data set whose normals are ignored, also for its masks."""
    for name in ("scene", "sphere", "lights", "fov", "mask", "encoding", "white"):
        if getattr(options, name) is not None:
            raise ValueError(
                f"{name}: {options.dataset} is a data set, which says this itself"
            )
    return open_dataset(options.dataset, normals="fit")


def _open_folder(options: DataOptions) -> Photographs:
    folder = options.dataset
    if options.lights is not None or not _is_dataset(folder):
        raise ValueError(
            f"{folder}: expected --sphere or --normals, the shape that its photographs "
            "show, since it is no data set with a scene.json or a filenames.txt"
        )
    for name in ("scene", "fov", "mask", "encoding", "white"):
        if getattr(options, name) is not None:
            raise ValueError(f"{name}: {folder} is a folder, which says this itself")
    photographs = open_dataset(
        folder, min_cosine=options.min_cosine, min_facing=options.min_facing
    )
    if (folder / SCENE_FILE).exists():
        return photographs
    return in_a_room(photographs, options.room_light)


def _is_dataset(folder: Path) -> bool:
    return (folder / SCENE_FILE).exists() or is_diligent(folder)


def in_a_room(data: Photographs, light: float) -> Photographs:
    """Photographs of DiLiGenT with ambient light, which their layout does not state."""

    def read(number: int) -> Photograph:
        coded, mask = data.read(number)
        # Leave out all channels of a pixel with a saturated one, which affects others.
        return Photograph(coded, np.asarray(mask.all(axis=-1)))

    room = (dataclasses.replace(scene, ambient=light) for scene in data.scenes)
    return dataclasses.replace(data, scenes=tuple(room), read=read)


def _read_single(options: DataOptions) -> Photographs:
    path = options.dataset
    if not path.exists():
        raise ValueError(f"{path}: there is no such file or folder")
    if options.scene is None:
        raise ValueError(
            f"scene: is missing, {path} is one image and needs --scene, or --sphere or "
            "--normals for its shape"
        )
    if options.fov is not None:
        raise ValueError(f"fov: {options.scene} has the camera, expected no other")
    record = read_record(options.scene, SceneRecord)
    scene = _scene_of(path, options.scene, record)
    encoding = parse_encoding(options.encoding) or record.encoding
    if encoding is None:
        raise ValueError(
            f"encoding: expected --encoding linear or srgb, since {options.scene} does "
            "not say it"
        )
    white = record.white if options.white is None else options.white
    light = read_light(path, encoding, white=white)
    image = light.image
    mask = np.ones(image.shape[:2], bool)
    if options.mask is not None:
        mask = read_mask(options.mask)
    wanted = (scene.camera.height, scene.camera.width)
    for source, array in ((path, image), (options.mask, mask)):
        if array.shape[:2] != wanted:
            raise ValueError(
                f"{source}: expected {wanted} pixels, as the camera in {options.scene} "
                f"has, got {array.shape[:2]}"
            )
    film = record.film()
    if film.clamp:
        film = with_jpeg(Film(encoding=encoding), path)
        if film.jpeg is None:
            # Levels of a response curve or of another white are not detectable.
            curved = isinstance(encoding, ResponseCurve)
            stated = curved or white is not None
            film = find_film([image])
            if stated:
                film = read_film(path, encoding, white=white)
    photograph = Photograph(Coded(image), mask & light.usable)
    return Photographs(path.stem, (scene,), (path.name,), film, lambda _: photograph)


def _scene_of(path: Path, file: Path, record: SceneRecord) -> Scene:
    """The scene of an image, with the image's lights if the scene file lists it."""
    scene = build_scene(file, record)
    for entry in record.images:
        if (file.parent / entry.file).resolve() == path.resolve():
            return view_of(scene, entry)
    return scene
