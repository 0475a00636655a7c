"""Read glTF 2.0: triangles and materials, with all sizes and indices checked.

A file is JSON that points into bytes: buffers are cut into views, views hold accessors
(arrays), and these are the attributes of primitives (triangles of one material), which
nodes place in the world. One note lists the parts of a file that are not used.

trimesh is not used, since its reader loses numbers without a message: it reads sparse
accessors as zeros, normalized integers without their scale, and only the first set of
uv; and it drops fans, tangents, samplers and transforms of textures.

??? cite "Source"
    Khronos, *glTF 2.0*, 2021: sections 3.5 to 3.7, and 4.4 for GLB;
    *KHR_mesh_quantization*.
"""

import base64
import binascii
import contextlib
import math
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from scipy.spatial.transform import Rotation

from phongfit.files.budget import afford
from phongfit.files.gltf import COLOUR_0, COLOURS
from phongfit.files.gltf_materials import GltfShade, Shading, at, vector, whole
from phongfit.files.inputs import Note, inside, listed, naming, read_bytes, reason
from phongfit.files.mesh_parts import UNNAMED, MeshPart, apart, white
from phongfit.files.mtl_textures import Shaded
from phongfit.files.strict_json import parse_json
from phongfit.geometry.normals import triangle_normals

TRIANGLES, STRIP, FAN = 4, 5, 6

REQUIRED = (
    *("KHR_materials_", "KHR_texture_", "EXT_texture_"),
    *("KHR_lights_punctual", "KHR_mesh_quantization"),
)
"""Prefixes of extensions that a file may require: they are read, or change only colours
and are listed as not used."""

READ = {
    "KHR_materials_specular",
    "KHR_materials_ior",
    "KHR_materials_emissive_strength",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
}
"""Extensions that are read."""

VISIT = 1000
"""Bytes that a primitive counts for, whatever it holds."""


def read_gltf(path: Path, note: Note) -> list[MeshPart]:
    """The triangles of a glTF or GLB file, a part for each primitive.

    **Arguments:** `note`: called with one line that lists the parts that are not used.

    **Raises:** `ValueError` that describes the error and its place in the file.
    """
    data = read_bytes(path)
    text, binary = _chunks(data) if path.suffix.lower() == ".glb" else (data, None)
    file = _tidied(parse_json(text))
    with _reading("asset"):
        if not file["asset"]["version"].startswith("2."):
            raise ValueError(f"expected glTF 2, got {file['asset']['version'][:20]!r}")
    with _reading("extensionsRequired"):
        for name in file.get("extensionsRequired", []):
            if not name.startswith(REQUIRED):
                raise ValueError(
                    f"requires the extension {name[:60]!r}, which is not read: export "
                    "it without"
                )
    reader = _Reader(file, path.parent, binary)
    parts = list(reader.parts())
    with _reading("meshes, materials and extensionsUsed"):
        lost = [*reader.unused, *dict.fromkeys(_unused(file))]
    if lost:
        note(f"not used: {listed(lost)}")
    names = _unique_names(file, dict.fromkeys(number for number, _ in parts))
    return [
        part._replace(name=names[number]) for number, part in parts if len(part.faces)
    ]


def _tidied(value: Any) -> Any:
    """JSON in which a key with `null` is absent, and 3.0 is the integer 3."""
    if isinstance(value, dict):
        return {key: _tidied(one) for key, one in value.items() if one is not None}
    if isinstance(value, list):
        return [_tidied(one) for one in value]
    small = isinstance(value, float) and abs(value) < 2**53
    return int(value) if small and value.is_integer() else value


@contextlib.contextmanager
def _reading(place: str) -> Iterator[None]:
    """Name the place of an error in the file, also of one that Python raises."""
    with naming(place):
        try:
            yield
        except (ArithmeticError, AttributeError, LookupError, TypeError) as error:
            # Files are written by programs: one sentence is enough for other faults.
            what = f"{type(error).__name__}: {reason(error)}"
            raise ValueError(f"is no valid glTF ({what})") from error


def _unused(file: dict[str, Any]) -> Iterator[str]:
    """Parts of a file that change its looks, but are not used here."""
    yield from (name for name in ("animations", "skins") if file.get(name))
    for mesh in file.get("meshes", []):
        if any("targets" in primitive for primitive in mesh["primitives"]):
            yield "morph targets"
    extensions = [*file.get("extensionsUsed", [])]
    for material in file.get("materials", []):
        extensions += material.get("extensions", {})
        for name, usual in (
            ("occlusionTexture", None),
            ("alphaMode", "OPAQUE"),
            ("doubleSided", False),
        ):
            if material.get(name, usual) != usual:
                yield name
    yield from (name[:60] for name in extensions if name not in READ)


def _unique_names(
    file: dict[str, Any], numbers: Iterable[int | None]
) -> dict[int | None, str]:
    """Names of materials by their numbers; `None` is the default one."""
    names: dict[int | None, str] = {}
    times: dict[str, int] = {}
    for number in sorted(numbers, key=lambda number: number is not None):
        given = None if number is None else file["materials"][number].get("name")
        name = given = given or UNNAMED
        while name in names.values():
            times[given] = times.get(given, 1) + 1
            name = f"{given}-{times[given]}"
        names[number] = name
    return names


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    """JSON and binary chunk of a GLB file."""
    if len(data) < 12 or not data.startswith(b"glTF\2\0\0\0"):
        raise ValueError("does not start as a GLB file of version 2 does")
    found: dict[bytes, bytes] = {}
    start = 12
    while start + 8 <= len(data) and len(found) < 2:
        size, kind = struct.unpack_from("<I4s", data, start)
        start += 8 + size
        if start > len(data):
            raise ValueError(f"expected a chunk of {size} bytes: it is truncated")
        found.setdefault(kind, data[start - size : start])
    if b"JSON" not in found:
        raise ValueError("expected a JSON chunk first")
    return found[b"JSON"], found.get(b"BIN\0")


class _Reader:
    """Arrays, triangles and their materials; `unused` lists other parts of the file."""

    def __init__(self, file: dict[str, Any], folder: Path, binary: bytes | None):
        self.unused: dict[str, None] = {}
        self.shades: dict[int, GltfShade] = {}
        self._shading = Shading(file, self._image, self.unused)
        self._file = file
        self._folder = folder
        self._binary = binary
        self._buffers: dict[int, bytes] = {}
        self._read = 0
        self._made = 0

    def parts(self) -> Iterator[tuple[int | None, MeshPart]]:
        """Triangles of every node of the scene, with the numbers of their materials."""
        file = self._file
        if not file.get("scenes"):
            return
        seen: set[int] = set()
        scene = at(file, "scenes", file.get("scene", 0), "scene")
        with _reading("scenes"):
            left = [(root, np.eye(4)) for root in scene.get("nodes", [])]
        while left:
            number, outer = left.pop()
            node = at(file, "nodes", number, "nodes")
            if number in seen:
                raise ValueError(f"nodes[{number}]: expected one parent, got two")
            seen.add(number)
            with _reading(f"nodes[{number}]"):
                matrix = outer @ _transform(node)
                if not np.isfinite(matrix).all():
                    raise ValueError("expected a finite transformation")
                left += [(child, matrix) for child in node.get("children", [])]
            if "mesh" not in node:
                continue
            mesh = at(file, "meshes", node["mesh"], "mesh")
            with _reading(f"meshes[{node['mesh']}].primitives"):
                primitives = [dict(one) for one in mesh["primitives"]]
            for k, primitive in enumerate(primitives):
                # Nodes that share a mesh may have more primitives than the file.
                self._made += VISIT
                afford(self._made, "primitives")
                with naming(f"meshes[{node['mesh']}].primitives[{k}]"):
                    if whole(primitive, "mode", TRIANGLES) in (TRIANGLES, STRIP, FAN):
                        yield primitive.get("material"), self._part(primitive, matrix)
                    else:
                        self.unused["points and lines"] = None

    def _part(self, primitive: dict[str, Any], matrix: np.ndarray) -> MeshPart:
        with _reading("attributes"):
            left = dict(primitive["attributes"])
        local = self._attribute(left, "POSITION", "VEC3")
        if local is None:
            raise ValueError("attributes.POSITION: is missing")
        count = len(local)
        corners = np.arange(count)
        if "indices" in primitive:
            corners = self._indices(primitive["indices"], count)
        faces = _triangles(corners, primitive.get("mode", TRIANGLES))
        shade = self._shade(primitive.get("material"))
        normals = self._attribute(left, "NORMAL", "VEC3", count=count)
        uv = self._uv(left, shade, count)
        colours = self._colours(left, shade, count)
        if shade.shaded.textures.normal is None:
            # Only normal maps need tangents, and phongfit computes them from the uv.
            left.pop("TANGENT", None)
        self.unused |= dict.fromkeys(f"attributes.{name[:60]}" for name in left)
        linear, shift = matrix[:3, :3], matrix[:3, 3]
        turn = np.linalg.det(linear)
        flat = normals is None or turn == 0
        # Each instance of a mesh takes memory, and more when all are joined.
        self._made += 6 * (faces.nbytes + 48 * (faces.size if flat else count))
        afford(self._made, "triangles")
        place = local @ linear.T + shift
        if turn < 0:
            # A reflection reverses the order of the corners.
            faces = faces[:, ::-1]
        part = MeshPart(
            place,
            faces,
            UNNAMED,
            white() if colours and "material" not in primitive else shade.shaded,
            None if normals is None or flat else normals @ np.linalg.inv(linear),
            None if uv is None else uv[faces],
            colours,
            np.zeros(count, int),
        )
        # Without normals faces are flat (section 3.7.2.1).
        if part.normals is not None:
            return part
        return apart(part)._replace(
            normals=np.repeat(triangle_normals(place[faces]), 3, axis=0)
        )

    def _shade(self, number: int | None) -> GltfShade:
        if number is None:
            return GltfShade(Shaded(), None, COLOUR_0)
        material = at(self._file, "materials", number, "material")
        if number not in self.shades:
            with _reading(f"materials[{number}]"):
                self.shades[number] = self._shading.read(material)
        return self.shades[number]

    def _uv(
        self, left: dict[str, int], shade: GltfShade, count: int
    ) -> np.ndarray | None:
        """The transformed uv of a part's textures; without textures, its first set."""
        placing = shade.placing
        name = f"TEXCOORD_{0 if placing is None else placing.uv_set}"
        uv = self._attribute(left, name, "VEC2", count=count)
        if placing is None:
            return uv
        if uv is None:
            raise ValueError(f"attributes.{name}: is missing, for its textures")
        return placing.of(uv)

    def _colours(
        self, left: dict[str, int], shade: GltfShade, count: int
    ) -> dict[str, np.ndarray]:
        """Rows for a part's vertices, by the parameter that they multiply."""
        found: dict[str, np.ndarray] = {}
        for name, leaves in shade.multiplied.items():
            rows = self._attribute(left, name, "VEC3", "VEC4", count=count)
            if rows is None:
                continue
            if not (rows >= 0).all():
                raise ValueError(
                    f"attributes.{name}: expected colours ≥ 0, got {rows.min():g}"
                )
            for leaf in leaves:
                if getattr(shade.shaded.textures, leaf) is not None:
                    self.unused[f"attributes.{name} where there is a texture"] = None
                else:
                    found[leaf] = rows[:, :3]
        return found

    def _attribute(
        self, left: dict[str, int], name: str, *kinds: str, count: int | None = None
    ) -> np.ndarray | None:
        """Rows of an attribute as floats; removes it from `left`."""
        if name not in left:
            return None
        with naming(f"attributes.{name}"):
            number = left.pop(name)
            numbers, normalized = self._array(number, *kinds)
            if count not in (None, len(numbers)):
                raise ValueError(f"expected {count}, got {len(numbers)}")
        if numbers.dtype.kind == "f" or not (normalized or name in COLOURS):
            return numbers.astype(np.float64)
        # Normalized integers: section 3.6.2.2.
        return np.maximum(numbers / np.iinfo(numbers.dtype).max, -1)

    def _indices(self, number: int, vertices: int) -> np.ndarray:
        numbers, _ = self._array(number, "SCALAR")
        with naming(f"accessors[{number}]"):
            return _below(numbers, vertices)

    def _array(self, number: int, *kinds: str) -> tuple[np.ndarray, bool]:
        """The rows of an accessor of one of these types, and its `normalized` flag."""
        with _reading(f"accessors[{number}]"):
            accessor = at(self._file, "accessors", number, "number")
            kind = accessor["type"]
            if kind not in kinds:
                raise ValueError(f"type: expected {' or '.join(kinds)}, got {kind!r}")
            dtype = np.dtype(_TYPES[accessor["componentType"]])
            shape = whole(accessor, "count"), _SIZES[kind]
            if not isinstance(accessor.get("normalized", False), bool):
                raise ValueError("normalized: expected true or false")
            few = accessor.get("sparse")
            if "bufferView" in accessor:
                rows = self._rows(accessor, dtype, shape)
            elif few is not None:
                afford(math.prod(shape) * dtype.itemsize, "an array")
                rows = np.zeros(shape, dtype)
            else:
                raise ValueError(
                    "bufferView: is missing, as in compressed meshes: expected one"
                )
            if few is not None:
                with naming("sparse"):
                    count = whole(few, "count")
                    of_indices = np.dtype(_TYPES[few["indices"]["componentType"]])
                    which = self._rows(few["indices"], of_indices, (count, 1))
                    rows = rows.copy()
                    rows[_below(which, shape[0])] = self._rows(
                        few["values"], dtype, (count, shape[1])
                    )
            return rows, accessor.get("normalized", False)

    def _rows(
        self, place: dict[str, Any], dtype: np.dtype, shape: tuple[int, int]
    ) -> np.ndarray:
        """Rows of numbers in the view at a place, without a copy."""
        view, start = place["bufferView"], whole(place, "byteOffset", 0)
        data = self._view(view)
        row = shape[1] * dtype.itemsize
        stride = whole(self._file["bufferViews"][view], "byteStride", 0) or row
        needed = start + max(shape[0] - 1, 0) * stride + row
        if stride < row or needed > len(data):
            raise ValueError(
                f"bufferView: expected {needed} bytes in bufferViews[{view}], got "
                f"{len(data)}"
            )
        return np.ndarray(shape, dtype, data, start, (stride, dtype.itemsize))

    def _view(self, number: int) -> memoryview:
        cut = at(self._file, "bufferViews", number, "bufferView")
        with naming(f"bufferViews[{number}]"):
            data, start = self._buffer(cut["buffer"]), whole(cut, "byteOffset", 0)
            end = start + whole(cut, "byteLength")
            if end > len(data):
                raise ValueError(
                    f"expected bytes {start} to {end}, got {len(data)} in "
                    f"buffers[{cut['buffer']}]"
                )
        return memoryview(data)[start:end]

    def _buffer(self, number: int) -> bytes:
        buffer = at(self._file, "buffers", number, "buffer")
        if number not in self._buffers:
            content = self._binary
            if "uri" in buffer or number > 0 or content is None:
                with naming(f"buffers[{number}].uri"):
                    content = self._named(buffer.get("uri", ""))
            self._read += len(content)
            afford(self._read, "buffers")
            with naming(f"buffers[{number}]"):
                self._buffers[number] = content[: whole(buffer, "byteLength")]
        return self._buffers[number]

    def _image(self, number: int) -> tuple[bytes, Path]:
        """The bytes of an image, and its name in messages."""
        image = at(self._file, "images", number, "source")
        name = f"images[{number}]"
        if "bufferView" in image:
            return bytes(self._view(image["bufferView"])), self._folder / name
        uri = image.get("uri", "")
        with naming(f"{name}.uri"):
            content = self._named(uri)
        return content, self._folder / (
            name if uri.startswith("data:") else unquote(uri)
        )

    def _named(self, uri: str) -> bytes:
        """The bytes in a data URI, or of the file that a URI names."""
        if not uri.startswith("data:"):
            return read_bytes(inside(self._folder, unquote(uri)))
        head, _, coded = uri.partition(",")
        if not head.endswith(";base64"):
            raise ValueError("expected base64")
        try:
            return base64.b64decode(coded, validate=True)
        except binascii.Error as error:
            raise ValueError(f"expected base64: {error}") from None


_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_SIZES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def _transform(node: dict[str, Any]) -> np.ndarray:
    """Matrix from a node's axes to its parent's, from `matrix` or from T R S."""
    if "matrix" in node:
        return vector(node, "matrix", [0] * 16).reshape(4, 4).T
    matrix, rotation = np.eye(4), vector(node, "rotation", (0, 0, 0, 1))
    if not math.isfinite(length := math.hypot(*rotation)) or length == 0:
        raise ValueError(
            f"rotation: expected a unit quaternion, got {rotation.tolist()}"
        )
    turn = Rotation.from_quat(rotation / length).as_matrix()
    matrix[:3, :3] = turn * vector(node, "scale", (1, 1, 1))
    matrix[:3, 3] = vector(node, "translation", (0, 0, 0))
    return matrix


def _below(numbers: np.ndarray, limit: int) -> np.ndarray:
    """The indices in the only column of an array, all below a limit."""
    if numbers.dtype.kind != "u":
        raise ValueError(f"expected whole numbers from 0, got {numbers.dtype}")
    indices = numbers[:, 0].astype(np.int64)
    if len(indices) and indices.max() >= limit:
        raise ValueError(f"expected indices below {limit}, got {indices.max()}")
    return indices


def _triangles(corners: np.ndarray, mode: int) -> np.ndarray:
    """Indices of counter-clockwise triangles from a list, strip or fan."""
    if mode == TRIANGLES:
        if len(corners) % 3:
            raise ValueError(f"expected three corners a triangle, got {len(corners)}")
        return corners.reshape(-1, 3)
    count = max(len(corners) - 2, 0)
    first = corners[:count] if mode == STRIP else np.repeat(corners[:1], count)
    faces = np.stack([first, corners[1:-1][:count], corners[2:]], axis=-1)
    if mode == STRIP:
        # Every second triangle of a strip is clockwise.
        faces[1::2] = faces[1::2, [1, 0, 2]]
    # Drop triangles without area, which join strips.
    a, b, c = faces.T
    return faces[(a != b) & (b != c) & (a != c)]
