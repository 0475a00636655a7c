"""Lists of lights for reflectance-transformation imaging: `.lp`.

The first line is a count; each other line has a photograph's name and a vector to its
lamp: x right, y up, z to the camera. RTIBuilder and the controllers of domes write it.

??? cite "Source"
    Cultural Heritage Imaging, *RTI glossary* and RTIBuilder's documentation.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from phongfit.checks import as_array
from phongfit.codes import warn
from phongfit.edge import checked, shown
from phongfit.files.inputs import floats, naming, read_text
from phongfit.files.matching import base_name, match_names
from phongfit.files.outputs import replacing


class LightList(NamedTuple):
    """Names of photographs, and a vector to the lamp of each.

    - `names`: as written in the file.
    - `vectors`: towards the lamps, of any length but 0.
    """

    names: tuple[str, ...]
    vectors: Float[np.ndarray, "lights 3"]

    @property
    def base_names(self) -> tuple[str, ...]:
        """Names without folders, since folders often belong to another machine."""
        return tuple(base_name(name) for name in self.names)

    def only(self, names: Sequence[str]) -> "LightList":
        """The lights of some photographs, by their base names, in the given order.

        **Raises:** `ValueError` for a photograph that the list lacks.
        """
        places, match = [], match_names(names, self.names)
        for name, place in zip(names, match.places, strict=True):
            # A match by number or order needs a note, for which there is no place here.
            if place is None or match.note:
                raise ValueError(
                    f"lights: expected one for each image, got none for {name}"
                )
            places.append(place)
        return LightList(tuple(names), self.vectors[places])


@checked
def read_lp(path: str | os.PathLike[str]) -> LightList:
    """Read a list of lights from an `.lp` file.

    Names may contain spaces; decimal commas are read as points.

    A count that differs from the number of lights is a warning.

    **Raises:** `ValueError` that names the file and the line: no count, a vector that
    is missing or zero, a repeated name.
    """
    path = Path(path)
    lines = [
        (number, line.strip())
        for number, line in enumerate(read_text(path).lstrip("\ufeff").splitlines(), 1)
        if line.strip()
    ]
    if not lines:
        raise ValueError(f"{path}: expected a count and as many lights, got nothing")
    with naming(f"{path}: line {lines[0][0]}"):
        count = _count(lines[0][1])
    names, vectors, there = [], [], set()
    for number, line in lines[1:]:
        with naming(f"{path}: line {number}"):
            name, vector = _light(line)
            if base_name(name) in there:
                raise ValueError(f"{name} comes twice")
        names.append(name)
        there.add(base_name(name))
        vectors.append(vector)
    if len(names) != count:
        words = f"{path}: its first line counts {count} lights, and {len(names)} follow"
        warn("list-count", words, stacklevel=2)
    return LightList(tuple(names), np.array(vectors).reshape(-1, 3))


def read_camera_lp(path: str | os.PathLike[str]) -> LightList:
    """A list of lights in the camera's axes: x right, y up, z towards the camera.

    **Raises:** `ValueError` as [`read_lp`][] does, and if all of several lamps have
    z < 0: other programs let z point away from the camera.
    """
    listed = read_lp(path)
    if len(listed.names) > 1 and (listed.vectors[:, 2] < 0).all():
        raise ValueError(
            f"{path}: expected lamps on the camera's side (z > 0), got all "
            f"{len(listed.names)} behind the surface (z < 0): turn the sign of z, and "
            "that of y too if y points down (OpenCV's axes)"
        )
    return listed


def _count(line: str) -> int:
    words = line.split()
    if len(words) != 1 or not words[0].isdecimal() or int(words[0]) < 1:
        raise ValueError(f"expected the number of lights, got {line[:60]!r}")
    return int(words[0])


def _light(line: str) -> tuple[str, Float[np.ndarray, "3"]]:
    words = line.rsplit(maxsplit=3)
    vector = np.array(floats([word.replace(",", ".") for word in words[1:]]))
    if len(words) != 4 or vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"expected a name and three numbers, got {line[:60]!r}")
    if not vector.any():
        raise ValueError(f"{words[0]}: expected a vector to the lamp, got zeros")
    return words[0], vector


@checked
def write_lp(
    path: str | os.PathLike[str],
    names: Sequence[str],
    vectors: Any,
) -> None:
    """Write a list of lights, whole or not at all.

    **Arguments:** `vectors`: to the lamps, (lights, 3), of any length except 0.

    **Raises:** `OSError` that names `path`; `ValueError` that names the argument: a
    name without a finite nonzero vector, or a name of several lines.
    """
    rows, wanted = as_array("vectors", vectors), (len(names), 3)
    numbers = rows.dtype.kind in "iuf" and np.isfinite(rows).all()
    if rows.shape != wanted or not numbers:
        raise ValueError(
            f"vectors: expected finite numbers of shape {wanted}, got {shown(vectors)}"
        )
    for name, vector in zip(names, rows, strict=True):
        if not name.strip() or name != " ".join(name.splitlines()):
            raise ValueError(f"names: expected one line each, got {name!r}")
        if not vector.any():
            raise ValueError(
                f"vectors: expected one to each lamp, got zeros for {name}"
            )
    lines = [f"{len(names)}"]
    for name, vector in zip(names, rows, strict=True):
        lines.append(f"{name} " + " ".join(f"{number:.7f}" for number in vector))
    with replacing(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
