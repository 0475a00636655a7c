"""Wavefront OBJ files: polygons with uv, normals, smoothing groups and materials.

??? cite "Source"
    Alias|Wavefront, *Object files (.obj)*, appendix B1 of the Advanced Visualizer
    manual, 1992. Colours of vertices, `v x y z r g b`, are not in any standard.
"""

import math
import re
from array import array
from pathlib import Path

import numpy as np

from phongfit.files.budget import afford
from phongfit.files.inputs import (
    LISTED,
    Note,
    beside,
    floats,
    joined_lines,
    naming,
    read_bytes,
    uncommented,
)
from phongfit.files.mesh_parts import (
    UNNAMED,
    MeshPart,
    linear_colours,
    uv_from_below,
    white,
)
from phongfit.files.mtl import FEW, MOST
from phongfit.files.mtl_textures import Shaded, read_textured
from phongfit.files.polygons import triangulate

MEMORY = 20
"""Memory that reading takes, as a multiple of the file's size (measured)."""


class _Content:
    """Numbers of an OBJ file, in the order of its lines.

    - `places`, `uv`, `normals`: 3, 2 and 3 numbers a row.
    - `colours`: 3 numbers for each place; 1 where it has none.
    - `corners`: 3 indices a corner, of `places`, `uv` and `normals`; −1 for none.
    - `faces`: for each face its number of corners, its line, its material (−1 for none)
        and its smoothing group (0 for none).
    - `materials`, `groups`: numbers by name.
    - `libraries`: the words after each `mtllib`, with its line.
    """

    def __init__(self) -> None:
        self.places, self.colours = array("d"), array("d")
        self.uv, self.normals = array("d"), array("d")
        self.corners, self.faces = array("q"), array("q")
        self.coloured = False
        self.materials: dict[str, int] = {}
        self.groups: dict[str, int] = {}
        self.libraries: dict[str, int] = {}
        self.unused: dict[str, None] = {}
        self._material, self._group = -1, 0

    def take(self, number: int, line: str) -> None:
        """Read one line of the file.

        **Raises:** `ValueError` that names the key.
        """
        key, *words = line.split() or ["#"]
        if "#" in line and key not in ("usemtl", "mtllib"):
            words = uncommented(words)
        if key in ("f", "fo"):
            self._face(number, words)
        elif key == "v":
            self._vertex(words)
        elif key == "vt":
            # One-dimensional textures have one number, volume textures three.
            self.uv.extend([*_floats(key, words, 1), 0.0][:2])
        elif key == "vn":
            self.normals.extend(_floats(key, words, 3)[:3])
        elif key == "usemtl":
            # A # belongs to the name, as in "Anodized Grey #1".
            name = " ".join(words)
            count = len(self.materials)
            self._material = self.materials.setdefault(name, count) if name else -1
        elif key == "s":
            name = " ".join(words) or "off"
            group = self.groups.setdefault(name, len(self.groups) + 1)
            self._group = 0 if name in ("off", "0") else group
        elif key == "mtllib":
            self.libraries.setdefault(line.strip()[len(key) :].strip(), number)
        elif key not in ("o", "g") and not key.startswith("#"):
            self.unused.setdefault(key)

    def _vertex(self, words: list[str]) -> None:
        numbers = _floats("v", words, 3)
        # A weight may precede the colour, and a transparency follow it.
        if len(numbers) not in (3, 4, 6, 7):
            raise ValueError(f"v: expected x y z or x y z r g b, got {_shown(words)}")
        self.places.extend(numbers[:3])
        self.colours.extend(numbers[3:6] if len(numbers) > 4 else (1.0, 1.0, 1.0))
        self.coloured |= len(numbers) > 4

    def _face(self, number: int, words: list[str]) -> None:
        counts = len(self.places) // 3, len(self.uv) // 2, len(self.normals) // 3
        for word in words:
            self.corners.extend(_corner(word, counts))
        self.faces.extend((len(words), number, self._material, self._group))


def _floats(key: str, words: list[str], least: int) -> list[float]:
    numbers = floats(words)
    if len(numbers) < least or not all(map(math.isfinite, numbers[:least])):
        wanted = f"{least} finite numbers" if least > 1 else "finite numbers"
        raise ValueError(f"{key}: expected {wanted}, got {_shown(words)}")
    return numbers


def _shown(words: list[str]) -> str:
    return repr(" ".join(words)[:60])


def _corner(word: str, counts: tuple[int, int, int]) -> list[int]:
    """Indices of a corner's place, uv and normal, counted from 0; −1 for none.

    **Arguments:** `counts`: of places, uv and normals read so far; negative indices
    count back from there.
    """
    row, parts = [-1, -1, -1], word.split("/")
    try:
        for k, (part, count) in enumerate(zip(parts, counts, strict=False)):
            if part or k == 0:
                index = int(part)
                row[k] = index - 1 if index > 0 else count + index
                if index == 0 or not 0 <= row[k] < 2**62:
                    raise ValueError
    except ValueError:
        row = []
    if not row or len(parts) > 3:
        wanted = "indices from 1, or negative ones of what comes before"
        raise ValueError(f"f: expected {wanted}, got {word[:60]!r}") from None
    return row


def read_obj(path: Path, note: Note) -> list[MeshPart]:
    """Triangles of an OBJ file, one part for each of its materials.

    Faces of smoothing group 0 (`s off`) are flat. In a file without `s` all faces are
    smooth, since many scanners and programs never write it.

    **Arguments:** `note`: called with a sentence for each unused part of the file and
    of its materials.

    **Raises:** `ValueError` that names the file and the line.
    """
    data = read_bytes(path)
    content = _Content()
    with naming(str(path)):
        afford(MEMORY * len(data), "triangles")
        _fill(content, data)
        if len(content.materials) > MOST:
            got = len(content.materials)
            raise ValueError(f"expected at most {MOST} materials, got {got}")
        corners, faces = _indices(content)

        def say(words: str) -> None:
            note(f"{path}: {words}")

        if content.unused:
            shown = ", ".join(repr(key[:20]) for key in list(content.unused)[:LISTED])
            say(f"its lines of {shown} are not used")
        places = np.asarray(content.places).reshape(-1, 3)
        cut = triangulate(places, corners[:, 0], faces[:, 0], say)
    if not len(cut.polygon):
        return []
    material, group = faces[cut.polygon, 2], faces[cut.polygon, 3]
    # Each flat polygon becomes a smoothing group.
    flat = (group == 0) & bool(content.groups)
    group = np.where(flat, len(content.groups) + 1 + cut.polygon, group)
    order = np.argsort(material, kind="stable")
    numbers, starts = np.unique(material[order], return_index=True)
    rows = dict(zip(numbers.tolist(), np.split(order, starts[1:]), strict=True))
    materials = _materials(path, content, -1 in rows, note)
    return [
        _part(content, corners[cut.corner[rows[k]]], group[rows[k]], *materials[k], say)
        for k in dict.fromkeys(material.tolist())
    ]


def _fill(content: _Content, data: bytes) -> None:
    number = 0
    try:
        for number, line in joined_lines(data):
            content.take(number, line)
    except ValueError as error:
        raise ValueError(f"line {number}: {error}") from error


def _indices(content: _Content) -> tuple[np.ndarray, np.ndarray]:
    """Rows of corners and of faces, after a check of all indices."""
    # NumPy makes C's long long of them, a type apart from int64.
    corners = np.frombuffer(content.corners, np.int64).reshape(-1, 3)
    faces = np.frombuffer(content.faces, np.int64).reshape(-1, 4)
    columns = (content.places, 3), (content.uv, 2), (content.normals, 3)
    for index, (numbers, width) in zip(corners.T, columns, strict=True):
        count = len(numbers) // width
        if (index >= count).any():
            first = np.argmax(index >= count)
            face = np.searchsorted(np.cumsum(faces[:, 0]), first, side="right")
            got = f"expected indices from 1 to {count}, got {index[first] + 1}"
            raise ValueError(f"line {faces[face, 1]}: f: {got}")
    return corners, faces


def _materials(
    path: Path, content: _Content, unnamed: bool, note: Note
) -> dict[int, tuple[str, Shaded]]:
    """Names and materials by number; −1 for faces without a material."""
    found: dict[str, Shaded] = {}
    for file in _libraries(path, content, note):
        found |= read_textured(file, note)
    names = content.materials
    missing = [name for name in names if name not in found]
    for name in missing[:FEW]:
        note(f"{path}: no .mtl has its material {name!r}, a default one is taken")
    if missing[FEW:]:
        note(f"{path}: nor {len(missing) - FEW} others of its materials")
    default = white() if content.coloured else Shaded()
    taken = {k: (name, found.get(name, default)) for name, k in names.items()}
    if unnamed and not names and len(found) == 1:
        return {-1: next(iter(found.items()))}
    if unnamed and found:
        told = "its faces before the first usemtl" if names else "its faces"
        note(f"{path}: {told} name no material, a default one is taken")
    other = UNNAMED
    while other in names:
        other = f"{other}-2"
    return taken | {-1: (other, default)}


def _libraries(path: Path, content: _Content, note: Note) -> list[Path]:
    """The existing .mtl files, each once."""
    found: dict[Path, None] = {}
    tried = 0
    for name, line in content.libraries.items():
        # The line is one name with blanks, or several names.
        names = re.findall(r'"[^"]*"|\S+', name)
        tried += 1 + len(names)
        if tried > MOST:
            raise ValueError(f"{path}: line {line}: expected at most {MOST} .mtl")
        whole = beside(path.parent, name)
        names = [name] if whole else names
        files = [whole] if whole else [beside(path.parent, k) for k in names]
        found |= dict.fromkeys(file for file in files if file is not None)
        missing = [k for k, file in zip(names, files, strict=True) if file is None]
        # If no part is a file, the line is a single name with blanks.
        missing = [name] if len(missing) == len(names) else missing
        for one in missing:
            note(
                f"{path}: line {line}: {one[:60] or 'a library of no name'} is missing"
            )
    return list(found)


def _part(
    content: _Content,
    corners: np.ndarray,
    groups: np.ndarray,
    name: str,
    shaded: Shaded,
    note: Note,
) -> MeshPart:
    """Triangles of one material.

    **Arguments:** `corners`: (T, 3, 3), indices of places, uv and normals; `groups`:
    (T,), numbers ≥ 0 of smoothing groups.
    """
    place, texture, normal = np.moveaxis(corners, -1, 0)
    given = np.asarray(content.normals).reshape(-1, 3)
    # Vertices are split by normals, or by groups where there are no normals.
    kind = np.where(normal >= 0, normal, len(given) + groups[:, None])
    kinds = int(kind.max()) + 1
    keys, faces = np.unique(place * kinds + kind, return_inverse=True)
    place, kind = np.divmod(keys, kinds)
    has_normal = kind < len(given)
    normals = np.zeros((len(kind), 3))
    normals[has_normal] = given[kind[has_normal]]
    uv, has_uv = None, texture >= 0
    if has_uv.any():
        uv = np.zeros((*texture.shape, 2))
        table = np.asarray(content.uv).reshape(-1, 2)
        uv[has_uv] = uv_from_below(table[texture[has_uv]])
    colours = {}
    if content.coloured and shaded.textures.diffuse is not None:
        note("its vertices' colours are not used where map_Kd is")
    elif content.coloured:
        rows = np.asarray(content.colours).reshape(-1, 3)
        colours = linear_colours(rows[place], note)
    return MeshPart(
        np.asarray(content.places).reshape(-1, 3)[place],
        faces.reshape(-1, 3),
        name,
        shaded,
        normals,
        uv,
        colours,
        np.maximum(kind - len(given), 0),
    )
