"""A data set of views: photographs from several places, each with its camera."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from phongfit.files.cameras import load_cameras
from phongfit.files.captures import encoding_of
from phongfit.files.images import read_film, read_head
from phongfit.files.inputs import listed
from phongfit.files.photographs import images_in, relative_exposures
from phongfit.files.schema import ImageRecord
from phongfit.files.transforms import image_of
from phongfit.geometry.cameras import PinholeCamera
from phongfit.rendering.film import Encoding, Film

LISTED = 4

UNKNOWNS = "--unknowns ambient diffuse specular shininess"
"""The usual unknowns of a fit, to which notes add others."""

EXPOSURES = "exposure --fixed exposure[0]=1"


class Views(NamedTuple):
    """Images, cameras, film and notes of a data set from several places."""

    images: list[ImageRecord]
    cameras: list[PinholeCamera]
    film: Film
    notes: list[str]


def find_views(
    folder: Path, cameras: Path, encoding: Encoding | None, white: int | None = None
) -> Views:
    """The photographs in a folder whose cameras other tools have determined.

    **Arguments:**

    - `cameras`: as in [`load_cameras`][]. Photographs are found by the names there,
        below the folder, or by the end of these names.
    - `white`: as in [`read_image`][].

    **Raises:** `ValueError` that names the file or the option.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder}: expected a folder of photographs with --cameras")
    found: dict[str, PinholeCamera] = {}
    absent = []
    for name, camera in load_cameras(cameras).items():
        file = _photograph(folder, name)
        if file is None:
            absent.append(name)
        elif file in found:
            raise ValueError(f"{cameras}: expected one camera of {file}, got two")
        else:
            found[file] = camera
    if not found:
        raise ValueError(
            f"{cameras}: expected cameras of photographs in {folder}, got "
            f"{_few(absent)}"
        )
    names = list(found)
    heads = [read_head(folder / name) for name in names]
    for name, head in zip(names, heads, strict=True):
        if head.turned:
            raise ValueError(
                f"{folder / name}: expected an upright image, got one that its EXIF "
                "orientation turns: remove the orientation (exiftool -Orientation=) if "
                "the cameras are of the image as it lies in the file, as COLMAP's are; "
                "else turn its pixels (mogrify -auto-orient)"
            )
        wanted = found[name].width, found[name].height
        if head.size != wanted:
            raise ValueError(
                f"{folder / name}: expected {wanted[0]} × {wanted[1]} pixels, as its "
                f"camera has, got {head.size[0]} × {head.size[1]}: give the "
                "photographs that the cameras were found from"
            )
    relative, notes = relative_exposures(names, [head.exposure for head in heads])
    told = _exposed(relative.tolist())
    told += [note for note in notes if "brought to" not in note]
    if absent:
        told.append(f"no photograph of {_few(absent)}: left out")
    others = {path.name for path in images_in(folder)} - set(names)
    if others:
        told.append(f"no camera of {_few(sorted(others))}: left out")
    known = encoding_of(folder, names, encoding)
    film = read_film(folder / names[0], known, white=white)
    return Views(
        [ImageRecord(file=name) for name in names],
        list(found.values()),
        unrounded(film),
        told,
    )


def unrounded(film: Film) -> Film:
    """A film of photographs without JPEG, which each file states for itself."""
    return Film(film.clamp, film.encoding, film.bits)


def _exposed(relative: Sequence[float]) -> list[str]:
    low, high = min(relative), max(relative)
    if low == high:
        return []
    return [
        f"exposures differ, from {low:.3g} to {high:.3g} of the first's: a fit finds "
        f"them with {UNKNOWNS} {EXPOSURES}"
    ]


def _photograph(folder: Path, name: str) -> str | None:
    """The path of a photograph relative to the folder, or `None` if it is missing."""
    try:
        path = image_of(folder, name)
        return path.relative_to(folder).as_posix() if path.is_file() else None
    except (OSError, ValueError):
        # The name is not valid in this folder.
        return None


def _few(names: Sequence[str]) -> str:
    return listed(names, LISTED, "more")
