"""A capture: a folder of photographs from one standing camera, one lamp each."""

import dataclasses
import os
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from phongfit.edge import checked
from phongfit.files.coded import Coded
from phongfit.files.dataset import Photograph
from phongfit.files.images import read_film
from phongfit.files.inputs import naming
from phongfit.files.lp import LightList, read_camera_lp
from phongfit.files.matching import match_names
from phongfit.files.photographs import (
    AbstractImages,
    PhotoSeries,
    images_in,
    is_mask,
    open_photographs,
    read_photograph,
)
from phongfit.rendering.film import Encoding, Film

NO_LAMP = {"mask", "ambient", "dark", "flat", "ref", "reference", "normals", "normal"}
"""Words in names of images that do not show the object under a lamp."""

LEAST_OF_FLAT = 0.9
"""Smallest fraction of a flat's samples that must not be saturated."""


@dataclass(frozen=True)
class Capture(AbstractImages):
    """Photographs of one object, each read from its file on access.

    A sequence of images, linear light (height, width, 3), as [`calibrate`][] takes it.
    All are scaled to the shortest exposure, so that only samples that were cut off at
    white reach 1.

    - `series`: the photographs as their files have them.
    - `ambient`: light without a lamp, subtracted from each photograph; or None.
    - `flat`: divisor of each photograph, which removes vignetting and the lamp's
        fall-off over the field: a photograph of a white card, over its median; or None.
    - `lights`: the list that names the photographs, if there is one.
    - `others`: other images in the folder.
    """

    series: PhotoSeries
    ambient: Photograph | None = None
    flat: Photograph | None = None
    lights: LightList | None = None
    others: tuple[str, ...] = ()

    @property
    def folder(self) -> Path:
        """The folder of the photographs."""
        return self.series.paths[0].parent

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the photographs' files."""
        return tuple(path.name for path in self.series.paths)

    @property
    def mask(self) -> Path | None:
        """Path of the mask in the folder, such as mask.png, if there is exactly one."""
        masks = [name for name in self.others if is_mask(Path(name))]
        return self.folder / masks[0] if len(masks) == 1 else None

    @property
    def encoding(self) -> Encoding:
        """Encoding of the photographs' numbers."""
        return self.series.encoding

    @property
    def film(self) -> Film:
        """Film of the first photograph."""
        series = self.series
        return read_film(series.paths[0], series.encoding, white=series.white)

    @property
    def notes(self) -> tuple[str, ...]:
        """Assumptions about exposures, in sentences."""
        return self.series.notes

    def __len__(self) -> int:
        return len(self.series)

    def without(self, names: Collection[str]) -> "Capture":
        """The capture without some photographs, and a note that lists them."""
        kept = [k for k, name in enumerate(self.names) if name not in names]
        if len(kept) in (0, len(self.names)):
            return self
        out = ", ".join(name for name in self.names if name in names)
        series, listed = self.series.only(kept), self.lights
        notes = (*series.notes, f"{out}: left out, as the calibration does")
        if listed is not None:
            listed = LightList(
                tuple(listed.names[k] for k in kept), listed.vectors[kept]
            )
        series = dataclasses.replace(series, notes=notes)
        return dataclasses.replace(self, series=series, lights=listed)

    def image(self, number: int) -> Float[np.ndarray, "height width 3"]:
        """The image with this index; samples that were cut off at white are 1."""
        photograph = self.read(number)
        image = photograph.image
        return np.where(photograph.mask, image, np.maximum(image, 1))

    def read(self, number: int) -> Photograph:
        """The photograph with this index, from 0, and a mask of its known samples.

        False where it, `ambient` or `flat` was cut off at white.

        **Raises:** `ValueError` that names the file.
        """
        photograph = _in_light_of(self.series, number, self.series)
        image, known = photograph.image, photograph.mask
        if self.ambient is not None:
            image = np.maximum(image - self.ambient.image, 0)
            known &= self.ambient.mask
        if self.flat is not None:
            image = image / self.flat.image
            known &= self.flat.mask
        return Photograph(Coded(image), known)


def _in_light_of(series: PhotoSeries, number: int, capture: PhotoSeries) -> Photograph:
    """A photograph scaled to the shortest exposure of a capture."""
    photo = series.read(number)
    known, least = photo.unsaturated, capture.relative_exposures.min()
    light = photo.common_light
    return Photograph(Coded(light * light.dtype.type(least)), known)


@checked
def open_capture(
    folder: str | os.PathLike[str],
    encoding: Encoding | None = None,
    *,
    lights: str | os.PathLike[str] | None = None,
    ambient: str | os.PathLike[str] | None = None,
    flat: str | os.PathLike[str] | None = None,
    white: int | None = None,
) -> Capture:
    """A capture from a folder of photographs, or of a single photograph.

    The photographs of a folder are those that an `.lp` file in it lists, in its order;
    else all images in order of the numbers in their names, except those named mask,
    ambient, dark, flat, ref or normals. If exposures differ, the photographs and
    `ambient` are scaled to a common exposure: see [`open_photographs`][]; `notes` then
    mentions it.

    **Arguments:**

    - `folder`: of photographs; or the file of a single one.
    - `encoding`: of the files' numbers. Default: sRGB for JPEG files, as cameras write
        them, and linear for floating-point formats; it is needed for all others.
    - `lights`: the `.lp` file; default the one in the folder. For one photograph it
        lists the lamp by the photograph's name, perhaps among others.
    - `ambient`: a photograph without a lamp, subtracted from each.
    - `flat`: a photograph of a white card in the object's place; divides each.
    - `white`: the number that is white in all of them: see [`read_image`][].

    **Raises:** `ValueError` that names the folder, the file or the argument.
    """
    folder, note = Path(folder), ""
    beside = {Path(p).resolve() for p in (ambient, flat) if p is not None}
    if folder.is_file():
        if folder.resolve() in beside:
            raise ValueError(f"ambient and flat: expected other files than {folder}")
        images = names = [folder.name]
        listed, folder = None, folder.parent
        if lights is not None:
            listed = read_camera_lp(lights)
            with naming(str(lights)):
                listed = listed.only(names)
    else:
        images = [p.name for p in images_in(folder) if p.resolve() not in beside]
        images.sort(key=_by_number)
        listed = _list_in(folder, lights)
        if listed is None:
            names = [name for name in images if not _is_no_photograph(name)]
        else:
            names, note = _matched(folder, images, listed)
        if len(names) < 2:
            raise ValueError(
                f"{folder}: expected several photographs, each under its own lamp, got "
                + (f"one, {names[0]}" if names else "none")
            )
    encoding = encoding_of(folder, names, encoding)
    paths = [folder / name for name in names]
    # Opened together, so that relative exposures include the ambient photograph's.
    every = open_photographs(
        [*paths, *([] if ambient is None else [ambient])], encoding, white=white
    )
    series = every.only(range(len(paths)))
    if note:
        series = dataclasses.replace(series, notes=(*series.notes, note))
    return Capture(
        series,
        None if ambient is None else _in_light_of(every, len(paths), series),
        None if flat is None else _flat(Path(flat), series),
        listed,
        tuple(name for name in images if name not in names),
    )


def _by_number(name: str) -> list[tuple[int, int, str]]:
    """Sort key that orders names by the numbers in them: 2 before 10."""
    parts = re.split(r"(\d+)", name.lower())
    return [(1, int(p), "") if p.isdecimal() else (0, 0, p) for p in parts]


def _is_no_photograph(name: str) -> bool:
    words = re.split(r"[^a-z]+", Path(name).stem.lower())
    return bool(NO_LAMP & set(words))


def _list_in(folder: Path, lights: str | os.PathLike[str] | None) -> LightList | None:
    if lights is not None:
        return read_camera_lp(lights)
    lists = sorted(folder.glob("*.lp"))
    if len(lists) > 1:
        found = ", ".join(path.name for path in lists)
        raise ValueError(f"{folder}: expected one list of lights, got {found}")
    return read_camera_lp(lists[0]) if lists else None


def _matched(
    folder: Path, images: Sequence[str], listed: LightList
) -> tuple[list[str], str]:
    """The photographs of a list's lamps, and a note on how they were matched."""
    candidates = list(images)
    if not {name.lower() for name in listed.base_names} & {x.lower() for x in images}:
        candidates = [name for name in images if not _is_no_photograph(name)]
    match = match_names(listed.names, candidates)
    found = [candidates[place] for place in match.places if place is not None]
    missing = [
        name
        for name, place in zip(listed.base_names, match.places, strict=True)
        if place is None
    ]
    if missing:
        there = ", ".join(images[:3]) + (" …" if len(images) > 3 else "")
        raise ValueError(
            f"{folder}: {len(missing)} of the {len(listed.names)} photographs in the "
            f"list of lights are missing, {missing[0]} first; there are {there}"
        )
    return found, match.note


def encoding_of(
    folder: Path, names: Sequence[str], encoding: Encoding | None
) -> Encoding:
    """The given encoding, or the usual one of the files' formats.

    **Raises:** `ValueError` that names `encoding`, if the formats do not determine it.
    """
    if encoding is not None:
        return encoding
    suffixes = {Path(name).suffix.lower() for name in names}
    if suffixes <= {".jpg", ".jpeg"}:
        return "srgb"
    if suffixes <= {".exr", ".hdr"}:
        return "linear"
    raise ValueError(
        f"encoding: expected linear or srgb, since {folder / names[0]} does not say "
        "what its numbers are"
    )


def _flat(path: Path, series: PhotoSeries) -> Photograph:
    photo = read_photograph(path, series.encoding, white=series.white)
    image, known = photo.image, photo.unsaturated
    if image.shape[:2] != series.size:
        raise ValueError(
            f"{path}: expected {series.size[1]} × {series.size[0]} pixels, as "
            f"{series.paths[0].name} has, got {image.shape[1]} × {image.shape[0]}"
        )
    if known.mean() < LEAST_OF_FLAT:
        raise ValueError(
            f"{path}: expected a flat below white, got {1 - known.mean():.0%} of its "
            "samples saturated: expose it for less time"
        )
    middle = np.median(image, axis=(0, 1))
    if not (image > 0.02 * middle).all() or not (middle > 0).all():
        raise ValueError(
            f"{path}: expected light everywhere on a flat, got black pixels"
        )
    return Photograph(Coded(image / middle), known)
