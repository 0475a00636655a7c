"""glTF 2.0 read: triangles and materials, every number checked before it is used.

A file is JSON that points into bytes: buffers are cut into views, views hold accessors
(arrays), and these are the attributes of primitives (triangles of one material), which
nodes put into the world. What of all this has no place here is named in a note.

??? cite "Source"
    Khronos, *glTF 2.0*, 2021: sections 3.5 to 3.7, and 4.4 for GLB.
"""

import base64
import binascii
import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from phongfit.files.budget import afford
from phongfit.files.gltf_materials import GltfShade, read_shade
from phongfit.files.gltf_records import (
    COLOURS,
    FAN,
    STRIP,
    TRIANGLES,
    Accessor,
    Buffer,
    File,
    Image,
    Item,
    Node,
    Primitive,
    unused,
)
from phongfit.files.gltf_tangents import differing, vertex_tangents
from phongfit.files.inputs import inside, naming, read_bytes
from phongfit.files.mtl_textures import Note
from phongfit.files.records import validated
from phongfit.files.strict_json import parse_json

# What extensions may be required: those that change colours alone.
HARMLESS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_punctual")


class GltfPart(NamedTuple):
    """Triangles of one material in the world; `material` counts those of the file.

    `colours` are rows for its vertices, (V, 3), by the parameter that they multiply.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    normals: Float[np.ndarray, "vertices 3"] | None
    material: int | None
    uv: Float[np.ndarray, "vertices 2"] | None = None
    colours: dict[str, np.ndarray] = {}  # noqa: RUF012


def read_gltf(path: Path, note: Note) -> tuple[list[GltfPart], list[GltfShade]]:
    """The triangles of a glTF or GLB file, and its materials.

    **Arguments:** `note`: is told what of the file is not used.

    **Raises:** `ValueError` that says what is wrong, and where in the file.
    """
    data = read_bytes(path)
    text, binary = _chunks(data) if path.suffix.lower() == ".glb" else (data, None)
    content = parse_json(text)
    file = validated(content, File)
    if not file.asset.version.startswith("2."):
        raise ValueError(f"expected glTF version 2, got {file.asset.version!r}")
    for name in file.extensionsRequired:
        if not name.startswith(HARMLESS):
            raise ValueError(f"requires the extension {name!r}, which is unknown here")
    reader = _Reader(file, path.parent, binary, note)
    shades = []
    for number, material in enumerate(file.materials):
        with naming(f"materials[{number}]"):
            shades.append(read_shade(material, file, reader.image, note))
    parts = list(reader.parts(shades))
    for words in unused(file, content, [shade.uv_set for shade in shades]):
        note(f"{words} not used")
    return parts, shades


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    """JSON and binary chunk of a GLB file."""
    if len(data) < 12 or data[:4] != b"glTF":
        raise ValueError("does not start as a GLB file does")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise ValueError(f"expected GLB version 2, got {version}")
    if length > len(data):
        raise ValueError(f"expected {length} bytes, got {len(data)}: it is truncated")
    found, at = [], 12
    while at + 8 <= length and len(found) < 2:
        size, kind = struct.unpack_from("<I4s", data, at)
        if at + 8 + size > length:
            raise ValueError(f"expected a chunk of {size} bytes: it is truncated")
        found.append((kind, data[at + 8 : at + 8 + size]))
        at += 8 + size
    if not found or found[0][0] != b"JSON":
        raise ValueError("expected a JSON chunk first")
    return found[0][1], found[1][1] if found[1:] and found[1][0] == b"BIN\0" else None


class _Reader:
    """Arrays and triangles of a file."""

    def __init__(self, file: File, folder: Path, binary: bytes | None, note: Note):
        self._file = file
        self._note = note
        self._folder = folder
        self._binary = binary
        self._buffers: dict[int, bytes] = {}
        self._read = 0
        self._made = 0

    def image(self, number: int) -> tuple[bytes, Path]:
        """The bytes of an image, and what to call it; none if its file is missing."""
        image: Image = _at(self._file.images, number, "source")
        name = self._folder / f"images[{number}]"
        if image.bufferView is not None:
            cut = _at(self._file.bufferViews, image.bufferView, "bufferView")
            data = self._buffer(cut.buffer)
            if cut.byteOffset + cut.byteLength > len(data):
                raise ValueError(f"images[{number}]: it is truncated")
            return data[cut.byteOffset : cut.byteOffset + cut.byteLength], name
        with naming(f"images[{number}].uri"):
            if image.uri is None:
                raise ValueError("is missing")
            if image.uri.startswith("data:"):
                return _base64(image.uri), name
            file = inside(self._folder, unquote(image.uri))
            return (read_bytes(file) if file.is_file() else b""), file

    def parts(self, shades: list[GltfShade]) -> Iterator[GltfPart]:
        """Triangles of every node of the scene, of these materials."""
        file = self._file
        if not file.scenes:
            return
        seen: set[int] = set()
        scene = _at(file.scenes, file.scene, "scene")
        left = [(root, np.eye(4)) for root in scene.nodes]
        while left:
            number, outer = left.pop()
            node = _at(file.nodes, number, "nodes")
            if number in seen:
                raise ValueError(f"nodes[{number}]: expected one parent, got two")
            seen.add(number)
            with naming(f"nodes[{number}]"):
                matrix = outer @ _transform(node)
                if not np.isfinite(matrix).all():
                    raise ValueError("expected a finite transformation")
            left += [(child, matrix) for child in node.children]
            if node.mesh is not None:
                mesh = _at(file.meshes, node.mesh, "mesh")
                for k, primitive in enumerate(mesh.primitives):
                    if primitive.mode in (TRIANGLES, STRIP, FAN):
                        with naming(f"meshes[{node.mesh}].primitives[{k}]"):
                            yield self._part(primitive, matrix, shades)

    def _part(
        self, primitive: Primitive, matrix: np.ndarray, shades: list[GltfShade]
    ) -> GltfPart:
        if "POSITION" not in primitive.attributes:
            raise ValueError("attributes.POSITION: is missing")
        local = self._floats(primitive.attributes["POSITION"], "VEC3")
        normals = None
        if "NORMAL" in primitive.attributes:
            normals = self._floats(primitive.attributes["NORMAL"], "VEC3")
            if len(normals) != len(local):
                raise ValueError(
                    f"attributes.NORMAL: expected {len(local)}, got {len(normals)}"
                )
        if primitive.indices is None:
            corners = np.arange(len(local))
        else:
            corners = self._indices(primitive.indices, len(local))
        faces = _triangles(corners, primitive.mode)
        shade = None
        if primitive.material is not None:
            shade = _at(shades, primitive.material, "material")
        uv = self._uv(primitive, shade, len(local))
        colours = self._colours(primitive, shade, len(local))
        if uv is not None and normals is not None:
            self._compare(primitive, local, faces, normals, uv)
        # A mesh may be in many places: all of them take memory, and more when joined.
        self._made += 6 * (faces.nbytes + 2 * local.nbytes)
        afford(self._made, "triangles")
        linear, shift = matrix[:3, :3], matrix[:3, 3]
        if np.linalg.det(linear) < 0:
            # A mirror turns the order of the corners.
            faces = faces[:, ::-1]
        if normals is not None:
            try:
                normals = normals @ np.linalg.inv(linear)
            except np.linalg.LinAlgError:
                normals = None
        place = local @ linear.T + shift
        return GltfPart(place, faces, normals, primitive.material, uv, colours)

    def _compare(self, primitive: Primitive, *of_uv: np.ndarray) -> None:
        """Tangents are found from the uv: does a normal map's own say otherwise?"""
        number = primitive.attributes.get("TANGENT")
        if number is None or primitive.material is None:
            return
        if self._file.materials[primitive.material].normalTexture is None:
            return
        given = self._floats(number, "VEC4")
        if len(given) != len(of_uv[0]):
            raise ValueError(
                f"attributes.TANGENT: expected {len(of_uv[0])}, got {len(given)}"
            )
        if far := differing(given, vertex_tangents(*of_uv)):
            self._note(
                f"its vertices' TANGENT are not used: {far} of {len(given)} are not "
                "those of the uv, which are"
            )

    def _uv(
        self, primitive: Primitive, shade: GltfShade | None, vertices: int
    ) -> np.ndarray | None:
        """The uv of a part's textures, or else its first ones."""
        wanted = None if shade is None else shade.uv_set
        name = f"TEXCOORD_{wanted or 0}"
        if name not in primitive.attributes:
            if wanted is not None:
                raise ValueError(f"attributes.{name}: is missing, for its textures")
            return None
        uv = self._floats(primitive.attributes[name], "VEC2", shares=True)
        if len(uv) != vertices:
            raise ValueError(f"attributes.{name}: expected {vertices}, got {len(uv)}")
        return uv

    def _colours(
        self, primitive: Primitive, shade: GltfShade | None, vertices: int
    ) -> dict[str, np.ndarray]:
        """Rows for a part's vertices, by the parameter that they multiply.

        As a texture of it, base colour is ambient light's, too, but in what we wrote.
        """
        found: dict[str, np.ndarray] = {}
        own = shade is not None and shade.own
        for name, leaf in COLOURS.items():
            number = primitive.attributes.get(name)
            if number is None:
                continue
            if not own and name != "COLOR_0":
                self._note(f"its vertices' {name} are not used")
                continue
            if shade is not None and getattr(shade.shaded.textures, leaf) is not None:
                self._note(f"its vertices' {name} are not used: there is a texture")
                continue
            rows = self._floats(number, "VEC3", "VEC4", shares=True)
            if len(rows) != vertices or not (rows >= 0).all():
                raise ValueError(
                    f"attributes.{name}: expected {vertices} colours ≥ 0, got "
                    f"{len(rows)} from {rows.min():g}"
                )
            if (rows[:, 3:] != 1).any():
                self._note(f"its vertices' {name} are partly transparent: not used")
            found[leaf] = rows[:, :3]
        if "diffuse" in found and not own:
            found["ambient"] = found["diffuse"]
        return found

    def _floats(self, number: int, *kinds: str, shares: bool = False) -> np.ndarray:
        """Rows of floats, or with `shares` of whole numbers: shares of the highest."""
        with naming(f"accessors[{number}]"):
            accessor: Accessor = _at(self._file.accessors, number, "number")
            whole = shares and accessor.componentType in (5121, 5123)
            known = whole or accessor.componentType == 5126
            if accessor.type not in kinds or not known:
                raise ValueError(
                    f"expected {' or '.join(kinds)} of floats (5126), got "
                    f"{accessor.type} of {accessor.componentType}"
                )
            numbers = self._array(accessor)
            highest = np.iinfo(numbers.dtype).max if whole else 1
            return numbers.astype(np.float64) / highest

    def _indices(self, number: int, vertices: int) -> np.ndarray:
        with naming(f"accessors[{number}]"):
            accessor = _at(self._file.accessors, number, "number")
            if accessor.type != "SCALAR" or accessor.componentType not in _UNSIGNED:
                raise ValueError(
                    "expected SCALAR of whole numbers, got "
                    f"{accessor.type} of {accessor.componentType}"
                )
            corners = self._array(accessor)[:, 0].astype(np.int64)
            if len(corners) and corners.max() >= vertices:
                raise ValueError(
                    f"expected indices below {vertices}, got {corners.max()}"
                )
            return corners

    def _array(self, accessor: Accessor) -> np.ndarray:
        """The rows of an accessor."""
        dtype, columns = np.dtype(_TYPES[accessor.componentType]), _SIZES[accessor.type]
        if accessor.bufferView is None:
            if accessor.sparse is None:
                raise ValueError(
                    "bufferView: is missing, as in compressed meshes: expected one"
                )
            afford(accessor.count * columns * dtype.itemsize, "an array")
            rows = np.zeros((accessor.count, columns), dtype)
        else:
            place = accessor.bufferView, accessor.byteOffset
            rows = self._rows(*place, dtype, accessor.count, columns)
        if accessor.sparse is None:
            return rows
        rows = rows.copy()
        with naming("sparse"):
            few = accessor.sparse
            where, what = few.indices, few.values
            if where.componentType not in _UNSIGNED:
                raise ValueError("indices.componentType: expected whole numbers")
            kind = np.dtype(_TYPES[where.componentType])
            at = self._rows(where.bufferView, where.byteOffset, kind, few.count, 1)
            if len(at) and at.max() >= accessor.count:
                raise ValueError(f"indices: expected numbers below {accessor.count}")
            place = what.bufferView, what.byteOffset
            rows[at[:, 0]] = self._rows(*place, dtype, few.count, columns)
        return rows

    def _rows(
        self, view: int, start: int, dtype: np.dtype, count: int, columns: int
    ) -> np.ndarray:
        """Numbers in a view, in place: `count` rows of `columns`."""
        cut = _at(self._file.bufferViews, view, "bufferView")
        row = columns * dtype.itemsize
        stride = cut.byteStride or row
        needed = (count - 1) * stride + row if count else 0
        if stride < row or start + needed > cut.byteLength:
            raise ValueError(
                f"bufferView: expected {start + needed} bytes in bufferViews[{view}], "
                f"got {cut.byteLength}"
            )
        with naming(f"bufferViews[{view}]"):
            buffer = self._buffer(cut.buffer)
            if cut.byteOffset + cut.byteLength > len(buffer):
                raise ValueError(
                    f"expected bytes up to {cut.byteOffset + cut.byteLength}, got "
                    f"{len(buffer)} in buffers[{cut.buffer}]"
                )
        bytes_ = np.frombuffer(buffer, np.uint8, needed, cut.byteOffset + start)
        if stride != row:
            shape, strides = (count, row), (stride, 1)
            bytes_ = np.lib.stride_tricks.as_strided(bytes_, shape, strides)
        # Copied, since numbers may lie at odd places.
        return np.ascontiguousarray(bytes_).view(dtype).reshape(count, columns)

    def _buffer(self, number: int) -> bytes:
        if number not in self._buffers:
            content = self._content(number, _at(self._file.buffers, number, "buffer"))
            self._read += len(content)
            afford(self._read, "buffers")
            self._buffers[number] = content
        return self._buffers[number]

    def _content(self, number: int, buffer: Buffer) -> bytes:
        if buffer.uri is None:
            if number != 0 or self._binary is None:
                raise ValueError(f"buffers[{number}].uri: is missing")
            return self._binary[: buffer.byteLength]
        with naming(f"buffers[{number}].uri"):
            if not buffer.uri.startswith("data:"):
                file = inside(self._folder, unquote(buffer.uri))
                return read_bytes(file)[: buffer.byteLength]
            return _base64(buffer.uri)[: buffer.byteLength]


def _base64(uri: str) -> bytes:
    head, comma, coded = uri.partition(",")
    if not comma or not head.endswith(";base64"):
        raise ValueError("expected base64")
    try:
        return base64.b64decode(coded, validate=True)
    except binascii.Error as error:
        raise ValueError(f"expected base64: {error}") from None


_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_UNSIGNED = (5121, 5123, 5125)
_SIZES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4} | {
    f"MAT{side}": side * side for side in (2, 3, 4)
}


def _at(items: list[Item], number: int, what: str) -> Item:
    """One of several, by its number in the file."""
    if number >= len(items):
        raise ValueError(f"{what}: expected a number below {len(items)}, got {number}")
    return items[number]


def _transform(node: Node) -> np.ndarray:
    """From a node's axes to its parent's: a matrix, or T R S."""
    if node.matrix is not None:
        return np.array(node.matrix).reshape(4, 4).T
    matrix = np.eye(4)
    if not math.isfinite(length := math.hypot(*node.rotation)) or length == 0:
        raise ValueError(f"rotation: expected a unit quaternion, got {node.rotation}")
    turn = Rotation.from_quat(np.array(node.rotation) / length).as_matrix()
    matrix[:3, :3] = turn * np.array(node.scale)
    matrix[:3, 3] = node.translation
    return matrix


def _triangles(corners: np.ndarray, mode: int) -> np.ndarray:
    """Indices of triangles, counter-clockwise, from those of a list, strip or fan."""
    if mode == TRIANGLES:
        if len(corners) % 3:
            raise ValueError(f"expected three corners a triangle, got {len(corners)}")
        return corners.reshape(-1, 3)
    count = max(len(corners) - 2, 0)
    first = corners[:count] if mode == STRIP else np.repeat(corners[:1], count)
    faces = np.stack([first, corners[1:-1][:count], corners[2:]], axis=-1)
    if mode == STRIP:
        # Every second one runs the other way round.
        faces[1::2] = faces[1::2, [1, 0, 2]]
    # Strips are joined by triangles without an area.
    a, b, c = faces.T
    return faces[(a != b) & (b != c) & (a != c)]
