"""COLMAP's sparse models, as text or binary: the cameras of its images.

??? cite "Source"
    COLMAP's documentation, *Output format* and *Camera models*; the binary layout is
    that of its `scripts/python/read_write_model.py`.
"""

import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from phongfit.files.budget import afford
from phongfit.files.inputs import naming, read_bytes, read_text
from phongfit.geometry.cameras import PinholeCamera
from phongfit.geometry.conventions import camera_from_extrinsics
from phongfit.geometry.distortion import (
    AbstractDistortion,
    BrownDistortion,
    FisheyeDistortion,
)


class _Model(NamedTuple):
    """One of COLMAP's camera models: its number in binary files, and its parameters."""

    number: int
    parameters: tuple[str, ...]
    distortion: type[AbstractDistortion] | None = None


_TWO, _ONE = ("fx", "fy", "cx", "cy"), ("f", "cx", "cy")
_BROWN, _FISHEYE = BrownDistortion, FisheyeDistortion
_OPENCV = (*_TWO, "k1", "k2", "p1", "p2")
MODELS = {
    "SIMPLE_PINHOLE": _Model(0, _ONE),
    "PINHOLE": _Model(1, _TWO),
    "SIMPLE_RADIAL": _Model(2, (*_ONE, "k1"), _BROWN),
    "RADIAL": _Model(3, (*_ONE, "k1", "k2"), _BROWN),
    "OPENCV": _Model(4, _OPENCV, _BROWN),
    "OPENCV_FISHEYE": _Model(5, (*_TWO, "k1", "k2", "k3", "k4"), _FISHEYE),
    "FULL_OPENCV": _Model(6, (*_OPENCV, "k3", "k4", "k5", "k6"), _BROWN),
    "SIMPLE_RADIAL_FISHEYE": _Model(8, (*_ONE, "k1"), _FISHEYE),
    "RADIAL_FISHEYE": _Model(9, (*_ONE, "k1", "k2"), _FISHEYE),
}

PLACES = (".", "sparse/0", "sparse")
"""Folders of a project in which COLMAP writes a model."""

CAMERA = 20_000
"""Approximate number of bytes that a camera takes in memory."""

POINT = 24
"""Bytes of a point of an image in binary files."""

LONGEST = 4096
"""Maximum length of an image's name, bytes."""

Intrinsics = dict[int, dict[str, Any]]


class _Image(NamedTuple):
    """An image's name and pose, and the number of its camera."""

    name: str
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    camera: int


def is_colmap(folder: Path) -> bool:
    """True if a folder holds a COLMAP model."""
    return _find(folder) is not None


def load_colmap(folder: Path) -> dict[str, PinholeCamera]:
    """The camera of every image of a model, by image name, sorted by name.

    **Arguments:** `folder`: holds `cameras.bin` and `images.bin`, or `cameras.txt` and
    `images.txt`; or is a project's folder, with the model in its `sparse/0`. Points are
    not read.

    **Raises:** `ValueError` that names the file: missing, broken, or of a camera model
    that is none of [`MODELS`][].
    """
    found = _find(folder)
    if found is None:
        raise ValueError(
            f"{folder}: expected the folder of a COLMAP model, with cameras.bin and "
            "images.bin or cameras.txt and images.txt, got none of them"
        )
    cameras, images = (found.with_name(name + found.suffix) for name in _FILES)
    text = found.suffix == ".txt"
    known = _text_cameras(cameras) if text else _binary_cameras(cameras)
    taken = _text_images(images) if text else _binary_images(images)
    with naming(str(images)):
        afford(CAMERA * len(taken), f"{len(taken)} cameras")
        if not taken:
            raise ValueError("expected at least one image, got none")
        made: dict[str, PinholeCamera] = {}
        for image in sorted(taken):
            with naming(f"image {image.name!r}"):
                if image.name in made:
                    raise ValueError("comes twice")
                made[image.name] = _camera(image, known)
    return made


_FILES = ("cameras", "images")


def _find(folder: Path) -> Path | None:
    """The model's file of cameras; like COLMAP, binary before text."""
    for place in PLACES:
        for suffix in (".bin", ".txt"):
            path = folder / place / f"cameras{suffix}"
            if path.exists():
                return path
    return None


def _camera(image: _Image, known: Intrinsics) -> PinholeCamera:
    if image.camera not in known:
        raise ValueError(f"expected one of the model's cameras, got {image.camera}")
    length = np.linalg.norm(image.quaternion)
    if not np.isfinite(length) or length < 1e-6:
        raise ValueError(f"expected a quaternion, got {list(image.quaternion)}")
    # Imported here, since SciPy's transforms take long to import.
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_quat(image.quaternion, scalar_first=True).as_matrix()
    return camera_from_extrinsics(
        rotation, np.array(image.translation), **known[image.camera]
    )


def _intrinsics(name: str, width: int, height: int, values: Any) -> dict[str, Any]:
    """Arguments of [`PinholeCamera`][] from a model's parameters."""
    model = MODELS[name]
    if len(values) != len(model.parameters):
        wanted = ", ".join(model.parameters)
        raise ValueError(f"{name}: expected {wanted}, got {len(values)} numbers")
    given = {key: float(v) for key, v in zip(model.parameters, values, strict=True)}
    if "f" in given:
        given["fx"] = given.pop("f")
    lens = {key: given.pop(key) for key in list(given) if key[0] in "kp"}
    made: dict[str, Any] = {"width": width, "height": height, **given}
    # A fisheye differs from a pinhole even if all coefficients are 0.
    if model.distortion is FisheyeDistortion or any(lens.values()):
        made["distortion"] = model.distortion(**lens) if model.distortion else None
    # Validate now, so that errors name the camera and not its first image.
    PinholeCamera(**made)
    return made


def _unknown(model: Any) -> ValueError:
    return ValueError(
        f"expected a camera model of {', '.join(MODELS)}, got {model!r}; COLMAP's "
        "image_undistorter makes PINHOLE of all of them"
    )


# Text.


def _lines(path: Path) -> list[tuple[int, str]]:
    """Numbered lines without comments; empty ones are kept: an image without points."""
    text = read_text(path, None)
    with naming(str(path)):
        afford(len(text) + 200 * text.count("\n"), "lines")
    lines = enumerate(text.splitlines(), start=1)
    return [(at, line.strip()) for at, line in lines if not line.startswith("#")]


def _text_cameras(path: Path) -> Intrinsics:
    known: Intrinsics = {}
    for at, line in _lines(path):
        if not line:
            continue
        with naming(f"{path}: line {at}"):
            number, model, width, height, *values = _words(line, 4, "a camera")
            if model not in MODELS:
                raise _unknown(model[:60])
            if int(number) in known:
                raise ValueError(f"camera {number} comes twice")
            sizes = int(width), int(height)
            numbers = [float(value) for value in values]
            known[int(number)] = _intrinsics(model, *sizes, numbers)
    return known


def _text_images(path: Path) -> list[_Image]:
    """Images of two lines each, or of one where no image has points."""
    images, after_image = [], False
    for at, line in _lines(path):
        if not line or (after_image and _are_points(line)):
            after_image = False
            continue
        with naming(f"{path}: line {at}"):
            _, *numbers, camera = _words(line, 10, "an image")[:9]
            pose = tuple(float(number) for number in numbers)
            name = line.split(maxsplit=9)[9]
            images.append(_Image(name, pose[:4], pose[4:], int(camera)))
        after_image = True
    return images


_NUMBERS = frozenset("0123456789+-.eE \t")


def _are_points(line: str) -> bool:
    """True for a line of points: three numbers each, unlike an image's line."""
    return _NUMBERS.issuperset(line) and len(line.split()) % 3 == 0


def _words(line: str, at_least: int, what: str) -> list[str]:
    words = line.split()
    if len(words) < at_least:
        raise ValueError(f"expected {what}, got {line[:60]!r}")
    return words


# Binary.


class _Bytes:
    """Reader of a binary file from its start.

    **Raises:** `ValueError` if the file is too short.
    """

    def __init__(self, path: Path):
        self.data, self.at = read_bytes(path), 0

    def take(self, layout: str) -> tuple[Any, ...]:
        """The next numbers, in the notation of `struct`."""
        if struct.calcsize(layout) > len(self.data) - self.at:
            raise ValueError("is truncated: expected more bytes")
        values = struct.unpack_from(layout, self.data, self.at)
        self.at += struct.calcsize(layout)
        return values

    def text(self) -> str:
        """Text up to a zero byte."""
        word, zero, _ = self.data[self.at : self.at + LONGEST].partition(b"\0")
        if not zero:
            raise ValueError("is truncated: expected the end of a name")
        self.at += len(word) + 1
        try:
            return word.decode("utf-8")
        except UnicodeDecodeError:
            raise ValueError(f"expected a name in UTF-8, got {word[:60]!r}") from None

    def end(self) -> None:
        left = len(self.data) - self.at
        if left < 0:
            raise ValueError("is truncated: expected more bytes")
        if left:
            raise ValueError(f"expected nothing after what it counts, got {left} bytes")


def _binary_cameras(path: Path) -> Intrinsics:
    file, known = _Bytes(path), {}
    by_number = {model.number: name for name, model in MODELS.items()}
    with naming(str(path)):
        for _ in range(*file.take("<Q")):
            number, model, width, height = file.take("<iiQQ")
            with naming(f"camera {number}"):
                if model not in by_number:
                    raise _unknown(model)
                if number in known:
                    raise ValueError("comes twice")
                name = by_number[model]
                layout = f"<{len(MODELS[name].parameters)}d"
                known[number] = _intrinsics(name, width, height, file.take(layout))
        file.end()
    return known


def _binary_images(path: Path) -> list[_Image]:
    file, images = _Bytes(path), []
    with naming(str(path)):
        (count,) = file.take("<Q")
        # No more than the file has bytes, whatever it states.
        afford(CAMERA * min(count, len(file.data)), f"{count} cameras")
        for _ in range(count):
            _, *pose, camera = file.take("<i7di")
            name = file.text()
            (points,) = file.take("<Q")
            file.at += points * POINT
            images.append(_Image(name, tuple(pose[:4]), tuple(pose[4:]), camera))
        file.end()
    return images
