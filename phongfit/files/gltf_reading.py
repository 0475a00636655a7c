"""glTF 2.0 read: triangles and base colours, every number checked before it is used.

A file is JSON that points into bytes: buffers are cut into views, views hold accessors
(arrays), and these are the attributes of primitives (triangles of one material), which
nodes put into the world.

??? cite "Source"
    Khronos, *glTF 2.0*, 2021: sections 3.5 to 3.7, and 4.4 for GLB.
"""

import base64
import binascii
import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, TypeVar
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float, Int
from pydantic import BaseModel, ConfigDict, Field
from scipy.spatial.transform import Rotation

from phongfit.files.budget import afford
from phongfit.files.inputs import inside, naming, read_bytes
from phongfit.files.records import validated
from phongfit.files.strict_json import parse_json

TRIANGLES, STRIP, FAN = 4, 5, 6

# What extensions may be required: those that change colours alone, which are not read.
HARMLESS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_punctual")

Item = TypeVar("Item")
Index = Annotated[int, Field(ge=0, lt=2**31)]
Count = Annotated[int, Field(ge=0, lt=2**40)]
Lots = Annotated[list[Item], Field(fail_fast=True, max_length=100_000)]
Vector3 = Annotated[list[float], Field(min_length=3, max_length=3)]
Vector4 = Annotated[list[float], Field(min_length=4, max_length=4)]


class _Record(BaseModel):
    """An object of the JSON part; what is not needed here is passed over."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False, defer_build=True)


class _Asset(_Record):
    version: Annotated[str, Field(max_length=20)]


class _Buffer(_Record):
    byteLength: Count
    uri: str | None = None


class _View(_Record):
    buffer: Index
    byteOffset: Count = 0
    byteLength: Count
    byteStride: Annotated[int, Field(ge=4, le=252)] | None = None


class _SparsePart(_Record):
    bufferView: Index
    byteOffset: Count = 0
    componentType: int = 5126


class _Sparse(_Record):
    count: Count
    indices: _SparsePart
    values: _SparsePart


class _Accessor(_Record):
    bufferView: Index | None = None
    byteOffset: Count = 0
    componentType: Literal[5120, 5121, 5122, 5123, 5125, 5126]
    count: Count
    type: Literal["SCALAR", "VEC2", "VEC3", "VEC4", "MAT2", "MAT3", "MAT4"]
    sparse: _Sparse | None = None


class _Primitive(_Record):
    attributes: dict[str, Index]
    indices: Index | None = None
    material: Index | None = None
    mode: Annotated[int, Field(ge=0, le=6)] = TRIANGLES


class _Mesh(_Record):
    primitives: Lots[_Primitive]


class _Node(_Record):
    children: Lots[Index] = []
    mesh: Index | None = None
    matrix: Annotated[list[float], Field(min_length=16, max_length=16)] | None = None
    translation: Vector3 = [0, 0, 0]
    rotation: Vector4 = [0, 0, 0, 1]
    scale: Vector3 = [1, 1, 1]


class _Scene(_Record):
    nodes: Lots[Index] = []


class _Roughness(_Record):
    baseColorFactor: Vector4 | None = None


class _Material(_Record):
    name: str | None = None
    pbrMetallicRoughness: _Roughness = _Roughness()
    emissiveFactor: Vector3 | None = None


class _File(_Record):
    asset: _Asset
    scene: Index = 0
    scenes: Lots[_Scene] = []
    nodes: Lots[_Node] = []
    meshes: Lots[_Mesh] = []
    accessors: Lots[_Accessor] = []
    bufferViews: Lots[_View] = []
    buffers: Lots[_Buffer] = []
    materials: Lots[_Material] = []
    extensionsRequired: Lots[str] = []


class Shade(NamedTuple):
    """What is taken of a material: its name and its colours, if it has them."""

    name: str | None
    base: list[float] | None
    emission: list[float] | None


class GltfPart(NamedTuple):
    """Triangles of one material in the world; `material` counts those of the file."""

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    normals: Float[np.ndarray, "vertices 3"] | None
    material: int | None


def read_gltf(path: Path) -> tuple[list[GltfPart], list[Shade]]:
    """The triangles of a glTF or GLB file, and its materials.

    **Raises:** `ValueError` that says what is wrong, and where in the file.
    """
    data = read_bytes(path)
    text, binary = _chunks(data) if path.suffix.lower() == ".glb" else (data, None)
    file = validated(parse_json(text), _File)
    if not file.asset.version.startswith("2."):
        raise ValueError(f"expected glTF version 2, got {file.asset.version!r}")
    for name in file.extensionsRequired:
        if not name.startswith(HARMLESS):
            raise ValueError(f"requires the extension {name!r}, which is unknown here")
    reader = _Reader(file, path.parent, binary)
    shades = [
        Shade(m.name, m.pbrMetallicRoughness.baseColorFactor, m.emissiveFactor)
        for m in file.materials
    ]
    return list(reader.parts()), shades


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

    def __init__(self, file: _File, folder: Path, binary: bytes | None):
        self._file = file
        self._folder = folder
        self._binary = binary
        self._buffers: dict[int, bytes] = {}
        self._read = 0
        self._made = 0

    def parts(self) -> Iterator[GltfPart]:
        """Triangles of every node of the scene."""
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
                            yield self._part(primitive, matrix)

    def _part(self, primitive: _Primitive, matrix: np.ndarray) -> GltfPart:
        if "POSITION" not in primitive.attributes:
            raise ValueError("attributes.POSITION: is missing")
        local = self._floats(primitive.attributes["POSITION"])
        normals = None
        if "NORMAL" in primitive.attributes:
            normals = self._floats(primitive.attributes["NORMAL"])
            if len(normals) != len(local):
                raise ValueError(
                    f"attributes.NORMAL: expected {len(local)}, got {len(normals)}"
                )
        if primitive.indices is None:
            corners = np.arange(len(local))
        else:
            corners = self._indices(primitive.indices, len(local))
        faces = _triangles(corners, primitive.mode)
        if primitive.material is not None:
            _at(self._file.materials, primitive.material, "material")
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
        return GltfPart(local @ linear.T + shift, faces, normals, primitive.material)

    def _floats(self, number: int) -> np.ndarray:
        with naming(f"accessors[{number}]"):
            accessor = _at(self._file.accessors, number, "number")
            if accessor.type != "VEC3" or accessor.componentType != 5126:
                raise ValueError(
                    "expected VEC3 of floats (5126), got "
                    f"{accessor.type} of {accessor.componentType}"
                )
            return self._array(accessor).astype(np.float64)

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

    def _array(self, accessor: _Accessor) -> np.ndarray:
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

    def _content(self, number: int, buffer: _Buffer) -> bytes:
        if buffer.uri is None:
            if number != 0 or self._binary is None:
                raise ValueError(f"buffers[{number}].uri: is missing")
            return self._binary[: buffer.byteLength]
        with naming(f"buffers[{number}].uri"):
            head, comma, coded = buffer.uri.partition(",")
            if not head.startswith("data:"):
                file = inside(self._folder, unquote(buffer.uri))
                return read_bytes(file)[: buffer.byteLength]
            if not comma or not head.endswith(";base64"):
                raise ValueError("expected base64")
            try:
                return base64.b64decode(coded, validate=True)[: buffer.byteLength]
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


def _transform(node: _Node) -> np.ndarray:
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
