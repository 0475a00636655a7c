"""OFF files: polygons with normals and colours.

??? cite "Source"
    Phillips et al., *Geomview manual*, section 4.2.5, 1996.
"""

import math
import re
from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from phongfit.files.budget import afford
from phongfit.files.inputs import Note, floats, joined_lines, read_bytes, uncommented
from phongfit.files.mesh_parts import (
    UNNAMED,
    MeshPart,
    linear_colours,
    uv_from_below,
    with_colours,
    with_face_colours,
)
from phongfit.files.mtl_textures import Shaded
from phongfit.files.polygons import triangulate

MEMORY = 20
"""Memory that reading takes, as a multiple of the file's size (measured)."""

Lines = Iterator[tuple[int, list[str]]]
"""Line numbers, and the words of lines that are not empty."""


def read_off(path: Path, note: Note) -> list[MeshPart]:
    """Triangles of an OFF file, as one part.

    **Arguments:** `note`: called with a sentence for each unused part of the file.

    **Raises:** `ValueError` that names the line.
    """
    data = read_bytes(path)
    afford(MEMORY * len(data), "triangles")
    lines = _lines(data)
    number, words = next(lines)
    # Some programs omit the line break after OFF.
    kind = re.fullmatch(r"(ST)?(C)?(N)?OFF(\d*)", words[0] if words else "")
    if kind is None or words[1:2] == ["BINARY"]:
        raise ValueError(f"line {number}: expected OFF, and text, got {words[:2]}")
    words = [word for word in (kind[4], *words[1:]) if word]
    number, words = (number, words) if words else next(lines)
    if len(words) < 2 or not all(word.isdecimal() for word in words[:2]):
        raise ValueError(f"line {number}: expected the counts of vertices and faces")
    n_vertices, n_faces = map(int, words[:2])
    with_uv, coloured, with_normals = (kind[k] is not None for k in (1, 2, 3))
    least = 3 + 3 * with_normals + 3 * coloured + 2 * with_uv
    rows = _vertices(lines, n_vertices, least)
    if rows.shape[1] > least + coloured:
        note(f"columns {least + 1} to {rows.shape[1]} of its vertices are not used")
    corners, counts, own = _faces(lines, n_faces)
    cut = triangulate(rows[:, :3], corners, counts, note)
    faces = corners[cut.corner]
    part = MeshPart(
        rows[:, :3],
        faces,
        UNNAMED,
        Shaded(),
        rows[:, 3:6] if with_normals else None,
        uv_from_below(rows[:, -2:][faces]) if with_uv else None,
    )
    start = 3 + 3 * with_normals
    if coloured:
        colours = linear_colours(_to_one(rows[:, start : start + 3]), note)
        return [with_colours(part, colours)]
    if not np.isfinite(own).any():
        return [part]
    # Faces without a colour are white.
    shares = np.nan_to_num(_to_one(own), nan=1.0)[cut.polygon]
    return [with_face_colours(part, linear_colours(shares, note))]


def _vertices(lines: Lines, count: int, least: int) -> np.ndarray:
    """Rows of numbers, all as long as the first and with at least `least` numbers."""
    numbers, width = array("d"), 0
    for _ in range(count):
        number, words = next(lines)
        row = floats(words)
        width = width or len(row)
        if len(row) < least or len(row) != width:
            wanted = f"{max(width, least)} numbers"
            raise ValueError(f"line {number}: expected {wanted}, got {words[:8]}")
        numbers.extend(row)
    return np.array(numbers).reshape(count, max(width, least))


def _faces(lines: Lines, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices of all faces, the number of corners and the colour (or NaN) of each."""
    corners, counts, colours = array("q"), array("q"), array("d")
    for _ in range(count):
        number, words = next(lines)
        try:
            n, own, colour = _face(words)
        except ValueError:
            wanted = "the number of corners, their vertices, and perhaps a colour"
            got = " ".join(words)[:60]
            raise ValueError(f"line {number}: expected {wanted}, got {got!r}") from None
        counts.append(n)
        corners.extend(own)
        # One number is an index into an external colour map, which is not available.
        colours.extend(colour[:3] if len(colour) > 2 else [math.nan] * 3)
    rows = np.array(colours).reshape(-1, 3)
    return np.array(corners, np.int64), np.array(counts, np.int64), rows


def _face(words: list[str]) -> tuple[int, list[int], list[float]]:
    count, *others = words or ["no number"]
    n = int(count)
    if not 0 <= n <= len(others):
        raise ValueError
    corners = [int(k) for k in others[:n]]
    if not all(abs(k) < 2**62 for k in corners):
        raise ValueError
    return n, corners, [float(k) for k in others[n:]]


def _to_one(colours: np.ndarray) -> np.ndarray:
    """Colours from 0 to 1; divides by 255 if any is above 1."""
    return colours / 255 if np.nanmax(colours, initial=0) > 1 else colours


def _lines(data: bytes) -> Lines:
    """Numbered words of each nonempty line, then empty lines without end."""
    number = 0
    for number, line in joined_lines(data):
        if words := uncommented(line.split()):
            yield number, words
    while True:
        yield number + 1, []
