"""PLY files: polygons with uv, normals and colours, in text or binary.

??? cite "Source"
    Turk, *The PLY polygon file format*, 1994. The uv of corners and the comment
    TextureFile are MeshLab's.
"""

import re
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

from phongfit.files.budget import afford
from phongfit.files.images import read_texels
from phongfit.files.inputs import Note, beside, listed, naming, read_bytes
from phongfit.files.mesh_parts import (
    UNNAMED,
    MeshPart,
    linear_colours,
    uv_from_below,
    white,
    with_colours,
    with_face_colours,
)
from phongfit.files.mtl_textures import Shaded
from phongfit.files.polygons import Triangles, triangulate
from phongfit.textures import Texture, Textures

MEMORY = 30
"""Memory that reading takes, as a multiple of the file's size (measured)."""
LIST = 300
"""Bytes of one number or list of an element whose lists differ in length."""

TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2"},
    **{"int": "i4", "uint": "u4", "float": "f4", "double": "f8"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"},
}
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}

WHITE = {"u1": 255.0, "u2": 65535.0, "f4": 1.0, "f8": 1.0}
"""The number that is white, by the type of a property."""

UV = ("texture_u", "texture_v"), ("u", "v"), ("s", "t")
PLACE, NORMAL, COLOUR = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
CORNERS = "vertex_indices", "vertex_index"
CORNER_UV = "texcoord"


class _Property(NamedTuple):
    """A property of an element; `length_type` is `None` unless it is a list."""

    name: str
    type: str
    length_type: str | None


class _Element(NamedTuple):
    name: str
    length: int
    properties: list[_Property]


class _Column(NamedTuple):
    """Values of a property for all elements; for lists, `counts` has their lengths."""

    type: str
    values: np.ndarray
    counts: np.ndarray | None


_Table = dict[str, _Column]


def read_ply(path: Path, note: Note) -> list[MeshPart]:
    """Triangles of a PLY file, as one part.

    **Arguments:** `note`: called with a sentence for each unused part of the file.

    **Raises:** `ValueError` that names the line of the header, or the element.
    """
    data = read_bytes(path)
    afford(MEMORY * len(data), "triangles")
    head, order, body = _split(data)
    elements = _elements(head)
    rest = _Body(body, order)
    tables = {element.name: rest.table(element) for element in elements}
    vertex, face = tables.get("vertex", {}), tables.get("face", {})
    places = _rows(vertex, PLACE)
    if places is None:
        raise ValueError("element vertex: expected x, y and z")
    corners = next((face[name] for name in CORNERS if name in face), None)
    if corners is None or corners.counts is None:
        return []
    vertices = _indices(corners)
    cut = triangulate(places, vertices, corners.counts, note)
    faces = vertices[cut.corner]
    uv = _uv(vertex, face, cut, faces, corners.counts, note)
    part = MeshPart(places, faces, UNNAMED, Shaded(), _rows(vertex, NORMAL), uv)
    _note_unused(tables, note)
    picture = _picture(path, head, uv is not None, note)
    if picture is None:
        return [_coloured(part, vertex, face, cut, note)]
    if COLOUR[0] in {*vertex, *face}:
        note("its colours are not used: it has a texture")
    return [part._replace(shaded=Shaded(white().material, picture))]


def _split(data: bytes) -> tuple[str, str, bytes]:
    """The header's text, the byte order (empty for text), and the body."""
    end = re.search(rb"(?m)^end_header[ \t]*(\r\n|\n|\r|\Z)", data)
    if not data.startswith(b"ply") or end is None:
        raise ValueError("cannot be read: its header has no end")
    head = data[: end.start()].decode("utf-8", "replace")
    kind = re.search(r"(?m)^format\s+(\S+)", head)
    if kind is None or kind[1] not in ORDERS:
        raise ValueError(f"format: expected one of {', '.join(ORDERS)}")
    return head, ORDERS[kind[1]], data[end.end() :]


def _elements(head: str) -> list[_Element]:
    elements: list[_Element] = []
    for number, line in enumerate(head.splitlines(), start=1):
        words = line.split()
        with naming(f"line {number}"):
            if words[:1] == ["element"]:
                if len(words) != 3 or not words[2].isdecimal():
                    raise ValueError("expected 'element NAME COUNT'")
                elements.append(_Element(words[1], int(words[2]), []))
            elif words[:1] == ["property"]:
                types = [TYPES.get(word) for word in words[1:-1] if word != "list"]
                lists = words[1:2] == ["list"]
                if not elements or len(types) != 1 + lists or None in types:
                    raise ValueError("expected 'property TYPE NAME' after an element")
                *length, kind = (str(one) for one in types)
                own = _Property(words[-1], kind, length[0] if length else None)
                elements[-1].properties.append(own)
    return elements


class _Body:
    """Reader of the file's body, after its header.

    **Arguments:** `order`: byte order; empty for text.
    """

    def __init__(self, data: bytes, order: str):
        self._data, self._order, self._at = memoryview(data), order, 0
        if order == "":
            with warnings.catch_warnings():
                # NumPy before 2.4 warns of a word that is not a number.
                warnings.simplefilter("error", DeprecationWarning)
                try:
                    numbers = np.fromstring(data.decode("latin-1"), sep=" ")
                except (DeprecationWarning, ValueError):
                    raise ValueError("it has words in place of numbers") from None
            self._data = numbers.data.cast("B")

    def _stored(self, type: str) -> np.dtype:
        """The type of numbers in the body; the numbers of a text are all floats."""
        return np.dtype(self._order + type if self._order else "f8")

    def _take(self, type: str, count: float = 1) -> np.ndarray:
        """The next numbers of a type."""
        dtype, start = self._stored(type), self._at
        if not 0 <= count * dtype.itemsize <= len(self._data) - start:
            raise ValueError("it is truncated, or a count in it is wrong")
        self._at += int(count) * dtype.itemsize
        return np.frombuffer(self._data, dtype, int(count), start)

    def _take_row(self, properties: list[_Property]) -> list[np.ndarray]:
        """One element: an array for each property."""
        return [
            self._take(
                one.type,
                # A Python number: products of NumPy's 8-bit counts would wrap.
                1 if one.length_type is None else self._take(one.length_type)[0].item(),
            )
            for one in properties
        ]

    def table(self, element: _Element) -> _Table:
        """Columns of all properties of an element, by name.

        **Raises:** `ValueError` if the file is shorter than the header states.
        """
        names = [one.name for one in element.properties]
        with naming(f"element {element.name}"):
            if element.length == 0 or not names:
                return {}
            columns = self._of_one_size(element) or self._of_many_sizes(element)
        return dict(zip(names, columns, strict=True))

    def _of_one_size(self, element: _Element) -> list[_Column]:
        """Columns, if each property's lists all have one length; otherwise empty."""
        start, length = self._at, element.length
        widths = [len(values) for values in self._take_row(element.properties)]
        row, self._at = self._at - start, start
        if row * length > len(self._data) - start:
            return []
        fields: list[tuple[str, np.dtype, tuple[int, ...]]] = []
        for k, (one, width) in enumerate(zip(element.properties, widths, strict=True)):
            if one.length_type is not None:
                fields.append((f"count{k}", self._stored(one.length_type), (1,)))
            fields.append((f"{k}", self._stored(one.type), (width,)))
        rows = np.frombuffer(self._data, np.dtype(fields), length, start)
        columns = []
        for k, (one, width) in enumerate(zip(element.properties, widths, strict=True)):
            counts = None
            if one.length_type is not None:
                if (rows[f"count{k}"] != width).any():
                    return []
                counts = np.full(length, width)
            columns.append(_Column(one.type, rows[f"{k}"].ravel(), counts))
        self._at = start + row * length
        return columns

    def _of_many_sizes(self, element: _Element) -> list[_Column]:
        properties = element.properties
        afford(LIST * element.length * len(properties), "lists of its elements")
        rows = [self._take_row(properties) for _ in range(element.length)]
        return [
            _Column(
                one.type,
                np.concatenate(values),
                None if one.length_type is None else np.array([len(k) for k in values]),
            )
            for one, values in zip(properties, zip(*rows, strict=True), strict=True)
        ]


def _rows(table: _Table, names: tuple[str, ...]) -> np.ndarray | None:
    """Columns stacked along the last axis; `None` if one of them is missing."""
    if any(name not in table or table[name].counts is not None for name in names):
        return None
    return np.stack([table[name].values.astype(float) for name in names], axis=-1)


def _indices(column: _Column) -> np.ndarray:
    values = column.values
    if values.dtype.kind == "f":
        if not (np.isfinite(values) & (values == np.floor(values))).all():
            raise ValueError("element face: expected whole numbers as indices")
    return values.astype(np.int64)


def _uv(
    vertex: _Table,
    face: _Table,
    cut: Triangles,
    faces: np.ndarray,
    counts: np.ndarray,
    note: Note,
) -> np.ndarray | None:
    """uv of the corners of triangles."""
    own = face.get(CORNER_UV)
    if own is not None and own.counts is not None:
        if (own.counts == 2 * counts).all():
            uv = own.values.astype(float).reshape(-1, 2)
            return uv_from_below(uv[cut.corner])
        note(f"its faces' {CORNER_UV} are not used: not all corners have uv")
    for names in UV:
        uv = _rows(vertex, names)
        if uv is not None:
            return uv_from_below(uv[faces])
    return None


def _note_unused(tables: dict[str, _Table], note: Note) -> None:
    known = {
        "vertex": {*PLACE, *NORMAL, *COLOUR, "alpha", *UV[0], *UV[1], *UV[2]},
        "face": {*CORNERS, *COLOUR, "alpha", CORNER_UV},
    }
    unused = [
        f"{name} of {element}"
        for element, table in tables.items()
        for name in table
        if name not in known.get(element, ())
    ]
    if unused:
        note(f"not used: {listed(unused)}")


def _picture(path: Path, head: str, has_uv: bool, note: Note) -> Textures | None:
    """The texture that a comment of the header names."""
    named = re.findall(r"(?mi)^comment\s+TextureFile\s+(.+?)\s*$", head)
    if not named:
        return None
    if not has_uv:
        note("its TextureFile is not used, for it has no uv")
        return None
    if len(named) > 1:
        note(f"of its {len(named)} textures only the first is used")
    file = beside(path.parent, named[0])
    if file is None:
        note(f"its texture {named[0][:60]!r} is missing")
        return None
    try:
        read = read_texels(read_bytes(file), file, "srgb")
    except ValueError as error:
        note(f"its texture cannot be read, and is not used: {error}")
        return None
    if read.transparent:
        note(f"its texture {file.name} is partly transparent, which is not used")
    return Textures(diffuse=Texture(read.values), ambient=Texture(read.values))


def _coloured(
    part: MeshPart, vertex: _Table, face: _Table, cut: Triangles, note: Note
) -> MeshPart:
    """A part with the colours of its vertices, or else of its faces."""
    if any(name in vertex for name in COLOUR):
        if any(name in face for name in COLOUR):
            note("its faces' colours are not used: its vertices have colours")
        return with_colours(part, _colours(vertex, note))
    of_polygons = _colours(face, note).items()
    return with_face_colours(part, {k: rows[cut.polygon] for k, rows in of_polygons})


def _colours(table: _Table, note: Note) -> dict[str, np.ndarray]:
    """Linear colours of all vertices or faces, by the parameters that they multiply."""
    types = {table[name].type for name in COLOUR if name in table}
    if not types:
        return {}
    rows = _rows(table, COLOUR)
    if rows is None or not types <= set(WHITE):
        wanted = "expected red, green and blue of uchar, ushort, float or double"
        note(f"its colours are not used: {wanted}")
        return {}
    alpha = _rows(table, ("alpha",))
    if alpha is not None and np.ptp(alpha) > 0:
        note("it is partly transparent, which is not used")
    return linear_colours(rows / [WHITE[table[name].type] for name in COLOUR], note)
