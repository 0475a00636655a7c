"""Photographs from cameras' files: light, film and exposure, read one at a time."""

import abc
import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import overload

import numpy as np
from jaxtyping import Float

from phongfit.files.images import SUFFIXES, Head, Photo, read_head, read_light
from phongfit.files.inputs import listed
from phongfit.files.metadata import Exposure
from phongfit.rendering.film import Encoding, as_encoding

# Maximum number of photographs whose exposures a note lists.
LISTED = 6
# Relative tolerance for equal exposures, white balances and angles of view.
ALIKE = 1e-3


def read_photograph(
    path: str | os.PathLike[str], encoding: Encoding, *, white: int | None = None
) -> Photo:
    """A photograph with its film, its exposure, and a mask.

    **Arguments:** as in [`read_image`][], which also describes the treatment of
    orientation and colour profiles. The mask excludes transparent pixels, also partly
    transparent ones.

    **Raises:** `ValueError` that names the file.
    """
    return read_light(path, encoding, white=white)


@dataclass(frozen=True)
class PhotoSeries:
    """Photographs of one size and one camera, each read from its file on access.

    - `paths`: their files.
    - `encoding`: of all of them.
    - `size`: (height, width) of each.
    - `exposures`: as the camera recorded them.
    - `relative_exposures`: t · ISO / N² of each, relative to the first. Accurate to
        some 5 %, since cameras record rounded numbers, 1/125 s for 1/128.
    - `notes`: assumptions, in sentences.
    - `white`: as in [`read_image`][], for all of them.
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
        """The series of some of the photographs; notes are those of all."""
        some = list(numbers)
        return dataclasses.replace(
            self,
            paths=tuple(self.paths[k] for k in some),
            exposures=tuple(self.exposures[k] for k in some),
            relative_exposures=self.relative_exposures[some],
        )

    def read(self, number: int) -> Photo:
        """The photograph with this index, from 0.

        **Raises:** `ValueError` that names the file.
        """
        photo = read_light(self.paths[number], self.encoding, white=self.white)
        if photo.usable.shape != self.size:
            raise ValueError(f"{photo.path}: has changed since it was read before")
        relative = float(self.relative_exposures[number])
        return dataclasses.replace(photo, relative_exposure=relative)


def open_photographs(
    paths: Sequence[str | os.PathLike[str]],
    encoding: Encoding,
    *,
    white: int | None = None,
) -> PhotoSeries:
    """Photographs of one standing camera, in one encoding.

    Relative exposures are t · ISO / N², of exposure time t and f-number N.

    **Arguments:**

    - `paths`: the files, in the order of the series; for a folder use
        [`list_photographs`][].
    - `white`: as in [`read_image`][].

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
    """The common angle of view; `None` if angles differ or one is missing."""
    stated = [angle for angle in angles if angle is not None]
    if len(stated) < len(angles) or max(stated) > (1 + ALIKE) * min(stated):
        return None
    return stated[0]


class AbstractImages(Sequence[np.ndarray]):
    """A sequence of images, each read on access, with one in memory at a time."""

    @abc.abstractmethod
    def image(self, number: int) -> np.ndarray:
        """The image with this index, from 0."""

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
    """The photographs in a folder, sorted by name, without hidden files and masks.

    **Raises:** `ValueError` that names the folder: it is missing, or holds fewer than
    `at_least` photographs.
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
    """True if an image's name is that of a mask, such as mask.png or ball.mask.png."""
    return path.stem.lower().rpartition(".")[2] == "mask"


def images_in(folder: Path) -> list[Path]:
    """The images in a folder that are not hidden, in arbitrary order.

    **Raises:** `ValueError` that names the folder, if it is missing.
    """
    if not folder.is_dir():
        what = "folder" if folder.exists() else "file or folder"
        raise ValueError(f"{folder}: there is no such {what}")
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
    """Exposures t · ISO / N² of photographs, relative to the first.

    **Returns:** numbers, 1 for the first, and assumptions, in sentences.

    **Raises:** `ValueError` that names a photograph with and one without a setting
    (time, f-number or ISO), if photographs differ in that setting.
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
            for name, exposure in zip(names, exposures, strict=True)
        ]
        notes.append(
            f"{listed(shown, LISTED, 'more')}: brought to common light, to some 5 %, "
            "as cameras state rounded numbers"
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
