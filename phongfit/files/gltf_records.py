"""The records of a glTF file's JSON part: what is needed here of each object."""

from collections.abc import Iterator
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field

TRIANGLES, STRIP, FAN = 4, 5, 6

Item = TypeVar("Item")
Index = Annotated[int, Field(ge=0, lt=2**31)]
Count = Annotated[int, Field(ge=0, lt=2**40)]
Lots = Annotated[list[Item], Field(fail_fast=True, max_length=100_000)]
Share = Annotated[float, Field(ge=0, le=1)]
Vector3 = Annotated[list[float], Field(min_length=3, max_length=3)]
Vector4 = Annotated[list[float], Field(min_length=4, max_length=4)]


SILENT = frozenset(
    "name extras generator copyright minVersion mimeType min max normalized target "
    "minFilter alphaCutoff animations skins skin cameras camera targets weights".split()
)
"""Keys that change nothing here, or of which something else speaks."""
USUAL = {"alphaMode": "OPAQUE", "doubleSided": False}
"""Keys that change nothing where they have this value."""
COLOURS = {
    "COLOR_0": "diffuse",
    "_AMBIENT": "ambient",
    "_SPECULAR": "specular",
    "_EMISSION": "emission",
    "_SHININESS": "shininess",
}
"""Attributes of vertices that multiply a material's numbers; all but the first are our
own, which the format allows."""
READ = ("KHR_materials_specular",)
"""Extensions that are understood."""


class _Record(BaseModel):
    """An object of the JSON part; what has no place here is kept aside, to be named."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=False, defer_build=True)


def strangers(record: BaseModel) -> Iterator[str]:
    """What stands in a file and has no place in its records, with what it is of."""
    kind = type(record).__name__.removeprefix("Gltf").strip("_").lower()
    for key, value in (record.model_extra or {}).items():
        if isinstance(record, Extensions):
            yield f"extension {key!r}"
        elif key == "extensions" and isinstance(value, dict):
            yield from (f"extension {name!r}" for name in value)
        elif key not in SILENT and USUAL.get(key) != value:
            yield f"{kind}'s {key}" if kind != "file" else key
    for name in type(record).model_fields:
        value = getattr(record, name)
        for one in value if isinstance(value, list) else [value]:
            if isinstance(one, BaseModel):
                yield from strangers(one)


class _Asset(_Record):
    version: Annotated[str, Field(max_length=20)]


class Buffer(_Record):
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


class Accessor(_Record):
    bufferView: Index | None = None
    byteOffset: Count = 0
    componentType: Literal[5120, 5121, 5122, 5123, 5125, 5126]
    count: Count
    type: Literal["SCALAR", "VEC2", "VEC3", "VEC4", "MAT2", "MAT3", "MAT4"]
    sparse: _Sparse | None = None


class Primitive(_Record):
    attributes: dict[str, Index]
    indices: Index | None = None
    material: Index | None = None
    mode: Annotated[int, Field(ge=0, le=6)] = TRIANGLES


class _Mesh(_Record):
    primitives: Lots[Primitive]


class Node(_Record):
    children: Lots[Index] = []
    mesh: Index | None = None
    matrix: Annotated[list[float], Field(min_length=16, max_length=16)] | None = None
    translation: Vector3 = [0, 0, 0]
    rotation: Vector4 = [0, 0, 0, 1]
    scale: Vector3 = [1, 1, 1]


class _Scene(_Record):
    nodes: Lots[Index] = []


class TextureInfo(_Record):
    """Which texture, over which set of uv; `scale` is a normal map's."""

    index: Index
    texCoord: Index = 0
    scale: float = 1.0
    extensions: dict[str, Any] = {}


class _Roughness(_Record):
    baseColorFactor: Vector4 | None = None
    baseColorTexture: TextureInfo | None = None
    metallicFactor: float | None = None
    roughnessFactor: Share | None = None
    metallicRoughnessTexture: TextureInfo | None = None


class Specular(_Record):
    """KHR_materials_specular."""

    specularFactor: Share = 1.0
    specularTexture: TextureInfo | None = None
    specularColorFactor: Vector3 = [1, 1, 1]
    specularColorTexture: TextureInfo | None = None


class Extensions(_Record):
    KHR_materials_specular: Specular | None = None


class GltfMaterial(_Record):
    name: str | None = None
    pbrMetallicRoughness: _Roughness = _Roughness()
    normalTexture: TextureInfo | None = None
    emissiveFactor: Vector3 | None = None
    emissiveTexture: TextureInfo | None = None
    extensions: Extensions = Extensions()
    extras: Any = None


class Image(_Record):
    uri: str | None = None
    bufferView: Index | None = None


class _Sampler(_Record):
    magFilter: int = 9729
    wrapS: int = 10497
    wrapT: int = 10497


class _Texture(_Record):
    sampler: Index | None = None
    source: Index | None = None


class File(_Record):
    asset: _Asset
    scene: Index = 0
    scenes: Lots[_Scene] = []
    nodes: Lots[Node] = []
    meshes: Lots[_Mesh] = []
    accessors: Lots[Accessor] = []
    bufferViews: Lots[_View] = []
    buffers: Lots[Buffer] = []
    materials: Lots[GltfMaterial] = []
    textures: Lots[_Texture] = []
    images: Lots[Image] = []
    samplers: Lots[_Sampler] = []
    extensionsRequired: Lots[str] = []
    extensionsUsed: Lots[str] = []


def unused(file: File, content: dict[str, Any], uv_sets: list[int | None]) -> list[str]:
    """What of a file's JSON has no place here, in words that end with a verb.

    **Arguments:** `uv_sets`: which set of uv each material's textures use.
    """
    found: dict[str, None] = dict.fromkeys(
        f"its extension {name!r} is" for name in file.extensionsUsed if name not in READ
    )
    found |= dict.fromkeys(f"its {stranger[:80]} is" for stranger in strangers(file))
    for name in ("animations", "skins", "cameras"):
        if content.get(name):
            found[f"its {name} are"] = None
    for primitive in (one for mesh in file.meshes for one in mesh.primitives):
        if (primitive.model_extra or {}).get("targets"):
            found["its morph targets are"] = None
        if primitive.mode not in (TRIANGLES, STRIP, FAN):
            found["its points and lines are"] = None
        number, uv_set = primitive.material, None
        # Meshes that stand nowhere may be of materials that are not there.
        if number is not None and number < len(uv_sets):
            uv_set = uv_sets[number]
        # Tangents are compared with those of the uv.
        used = "POSITION", "NORMAL", "TANGENT", f"TEXCOORD_{uv_set or 0}", *COLOURS
        for name in primitive.attributes:
            # What is skinned or morphed says so above.
            if name not in used and not name.startswith(("JOINTS", "WEIGHTS")):
                found[f"its vertices' {name} are"] = None
    return list(found)
