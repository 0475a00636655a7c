"""Photographs as cameras write them: light, film and exposure, one at a time."""

import abc
import dataclasses
import functools
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import overload

import numpy as np
from jaxtyping import Bool, Float

from phongfit.files.coded import Coded
from phongfit.files.images import SUFFIXES, Head, read_film, read_head, read_light
from phongfit.files.metadata import Exposure
from phongfit.rendering.film import Encoding, Film, as_encoding

# Photographs whose exposures a sentence lists.
LISTED = 6
# Shares by which exposures, and white balances, may differ and still be alike.
ALIKE = 1e-3


@dataclass(frozen=True)
class Photo:
    """A photograph: upright linear light with the primaries of sRGB.

    - `path`: its file.
    - `encoding`: of its numbers.
    - `white`: as of [`read_image`][].
    - `coded`: its light as the file has it; 1 is white, and what is saturated is 1.
    - `usable`: false where the file's alpha is less than 1, and where a saturated
        channel was mixed into others, when colours became those of sRGB.
    - `clamped`: whether it ends at white; floating-point images do not.
    - `exposure`: as the camera says.
    - `relative_exposure`: how much light the camera let in, next to the first of its
        series; 1 for one alone.
    """

    path: Path
    encoding: Encoding
    coded: Coded
    usable: Bool[np.ndarray, "height width"]
    clamped: bool
    exposure: Exposure
    relative_exposure: float = 1.0
    white: int | None = None

    @property
    def name(self) -> str:
        """Of its file."""
        return self.path.name

    @functools.cached_property
    def image(self) -> Float[np.ndarray, "height width 3"]:
        """Its light."""
        return self.coded.light

    @property
    def film(self) -> Film:
        """How light became the file's numbers: see [`read_film`][]."""
        return read_film(self.path, self.encoding, white=self.white)

    @property
    def unsaturated(self) -> Bool[np.ndarray, "height width 3"]:
        """Samples that are known: not cut off at white, nor mixed with what is."""
        usable = np.broadcast_to(self.usable[..., None], self.image.shape)
        return usable & (self.image < 1) if self.clamped else usable.copy()

    @property
    def common_light(self) -> Float[np.ndarray, "height width 3"]:
        """The image as the exposure of the series' first would have made it.

        White is 1 / `relative_exposure` there: look for `unsaturated` samples. To keep
        images as they are, multiply the lights of their scenes instead, and the ambient
        light, by `relative_exposure`.
        """
        return self.image / np.asarray(self.relative_exposure, self.image.dtype)


def read_photograph(
    path: str | os.PathLike[str], encoding: Encoding, *, white: int | None = None
) -> Photo:
    """A photograph with its film, its exposure, and a mask.

    **Arguments:** as of [`read_image`][], which says what becomes of orientation and
    colour profiles. Pixels that are transparent, if only partly, are left out by the
    mask.

    **Raises:** `ValueError` that names the file.
    """
    path = Path(path)
    return _read(path, encoding, read_head(path).exposure, 1.0, white)


def _read(
    path: Path,
    encoding: Encoding,
    exposure: Exposure,
    relative: float,
    white: int | None,
) -> Photo:
    light = read_light(path, encoding, white=white)
    return Photo(path, encoding, *light, exposure, relative, white)


@dataclass(frozen=True)
class PhotoSeries:
    """Photographs of one size and one camera, read when they are asked for.

    - `paths`: their files.
    - `encoding`: of all of them.
    - `size`: (height, width) of each.
    - `exposures`: as the camera says.
    - `relative_exposures`: t · ISO / N² of each, next to that of the first. Cameras
        state rounded numbers, 1/125 s for 1/128: they are right to some 5 %.
    - `notes`: what was assumed, in sentences.
    - `white`: as of [`read_image`][], of all of them.
    - `fov`: angle of view from the lower to the upper edge, degrees, if EXIF data of
        all of them state it.
    """

    paths: tuple[Path, ...]
    encoding: Encoding
    size: tuple[int, int]
    exposures: tuple[Exposure, ...]
    relative_exposures: Float[np.ndarray, " photographs"]
    notes: tuple[str, ...]
    white: int | None = None
    fov: float | None = None

    def __len__(self) -> int:
        return len(self.paths)

    def only(self, numbers: Sequence[int]) -> "PhotoSeries":
        """Some of them; the notes stay those of all."""
        some = list(numbers)
        return dataclasses.replace(
            self,
            paths=tuple(self.paths[k] for k in some),
            exposures=tuple(self.exposures[k] for k in some),
            relative_exposures=self.relative_exposures[some],
        )

    def read(self, number: int) -> Photo:
        """The photograph of a number, from 0 on.

        **Raises:** `ValueError` that names the file.
        """
        path, relative = self.paths[number], float(self.relative_exposures[number])
        exposure = self.exposures[number]
        photo = _read(path, self.encoding, exposure, relative, self.white)
        if photo.usable.shape != self.size:
            raise ValueError(f"{path}: has changed since it was read before")
        return photo


def open_photographs(
    paths: Sequence[str | os.PathLike[str]],
    encoding: Encoding,
    *,
    white: int | None = None,
) -> PhotoSeries:
    """Photographs of one camera that stands still, in one encoding.

    Where exposures differ, t · ISO / N² of time t and f-number N tells how much.

    **Arguments:**

    - `paths`: the files, in the order they are wanted; of a folder:
        [`list_photographs`][].
    - `white`: as of [`read_image`][].

    **Raises:** `ValueError` that names the files: one cannot be read, they differ in
    size, or in the white balance of RAW files, or some alone state an exposure.
    """
    files = tuple(Path(path) for path in paths)
    if not files:
        raise ValueError("paths: expected at least one photograph, got none")
    encoding = as_encoding(encoding)
    heads = [read_head(path) for path in files]
    first = heads[0]
    for path, head in zip(files, heads, strict=True):
        if head.size != first.size:
            raise ValueError(
                f"{path}: expected {_pixels(first)}, as {files[0].name} has, got "
                f"{_pixels(head)}"
            )
        if not _balanced(head, first):
            raise ValueError(
                f"{path}: expected the white balance of {files[0].name}, "
                f"{_balance(first)}, got {_balance(head)}: develop all with one"
            )
    exposures = tuple(head.exposure for head in heads)
    relative, notes = relative_exposures([path.name for path in files], exposures)
    size = first.size[1], first.size[0]
    fov = _common_fov([head.fov for head in heads])
    return PhotoSeries(files, encoding, size, exposures, relative, notes, white, fov)


def _common_fov(angles: Sequence[float | None]) -> float | None:
    """The angle of view of one camera that did not zoom; `None` where they differ."""
    stated = [angle for angle in angles if angle is not None]
    if len(stated) < len(angles) or max(stated) > (1 + ALIKE) * min(stated):
        return None
    return stated[0]


class AbstractImages(Sequence[np.ndarray]):
    """Images that are read when they are asked for, one in memory at a time."""

    @abc.abstractmethod
    def image(self, number: int) -> np.ndarray:
        """That of a number, from 0 on."""

    @overload
    def __getitem__(self, index: int) -> np.ndarray: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[np.ndarray]: ...
    def __getitem__(self, index: int | slice) -> np.ndarray | Sequence[np.ndarray]:
        numbers = range(len(self))[index]
        if isinstance(numbers, range):
            return [self.image(number) for number in numbers]
        return self.image(numbers)


def list_photographs(
    folder: str | os.PathLike[str], at_least: int = 2
) -> tuple[Path, ...]:
    """The photographs in a folder, by name; hidden files and masks are none.

    **Raises:** `ValueError` that names the folder: there is none, or fewer photographs
    than `at_least` in it.
    """
    folder = Path(folder)
    found = sorted(path for path in images_in(folder) if not is_mask(path))
    if len(found) < at_least:
        names = ", ".join(path.name for path in found) or "none"
        raise ValueError(
            f"{folder}: expected at least {at_least} photographs, got {names}"
        )
    return tuple(found)


def is_mask(path: Path) -> bool:
    """Whether an image is a mask by its name, such as mask.png or ball.mask.png."""
    return path.stem.lower().rpartition(".")[2] == "mask"


def images_in(folder: Path) -> list[Path]:
    """The images in a folder that are not hidden, in no order.

    **Raises:** `ValueError` that names the folder, if there is none.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder}: there is no such folder")
    return [
        path
        for path in folder.iterdir()
        if path.suffix.lower() in SUFFIXES
        and path.is_file()
        and not path.name.startswith(".")
    ]


def relative_exposures(
    names: Sequence[str], exposures: Sequence[Exposure]
) -> tuple[Float[np.ndarray, " photographs"], tuple[str, ...]]:
    """How much light each photograph got, t · ISO / N² next to the first's.

    **Returns:** numbers, 1 for the first, and what was assumed, in sentences.

    **Raises:** `ValueError` that names two photographs, of which one states what it was
    exposed by, the other does not, and others differ in that.
    """
    relative, notes = np.ones(len(names)), []
    differing = []
    for field, what, power in _FIELDS:
        values = [getattr(exposure, field) for exposure in exposures]
        stated = [k for k, value in enumerate(values) if value is not None]
        if not stated:
            continue
        numbers = np.array([values[k] for k in stated], float)
        alike = np.ptp(numbers) <= ALIKE * numbers.min()
        missing = [k for k in range(len(names)) if k not in stated]
        if missing and not alike:
            raise ValueError(
                f"{names[missing[0]]}: expected {what}, since those of other "
                f"photographs differ, got none; {names[stated[0]]} states one"
            )
        if missing:
            notes.append(
                f"{names[missing[0]]}{_and_more(len(missing))} does not state {what}: "
                "taken as that of the others"
            )
        if not alike:
            relative *= (numbers / numbers[0]) ** power
            differing.append(field)
    if differing:
        shown = [
            f"{name} {exposure.only(differing)}"
            for name, exposure in zip(names[:LISTED], exposures, strict=False)
        ]
        rest = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
        notes.append(
            f"{', '.join(shown)}{rest}: brought to common light, to some 5 %, as "
            "cameras state rounded numbers"
        )
    elif all(exposure.time is None for exposure in exposures) and len(names) > 1:
        notes.append(
            "no exposure times are stated: taken to be the same in all photographs; "
            "where they differ, lamps' strengths contain them"
        )
    return relative, tuple(notes)


_FIELDS = (
    ("time", "an exposure time", 1),
    ("f_number", "an f-number", -2),
    ("iso", "an ISO sensitivity", 1),
)


def _and_more(count: int) -> str:
    return "" if count == 1 else f" (and {count - 1} more)"


def _pixels(head: Head) -> str:
    return f"{head.size[0]} × {head.size[1]} pixels"


def _balanced(one: Head, other: Head) -> bool:
    if one.white_balance is None or other.white_balance is None:
        return one.white_balance == other.white_balance
    return bool(np.allclose(one.white_balance, other.white_balance, rtol=ALIKE))


def _balance(head: Head) -> str:
    if head.white_balance is None:
        return "none"
    red, blue = head.white_balance
    return f"red × {red:.4g} and blue × {blue:.4g}"
