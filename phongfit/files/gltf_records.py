"""Records of a glTF file's JSON part: the keys of each object that are used here."""

from collections.abc import Iterator
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field

TRIANGLES, STRIP, FAN = 4, 5, 6

Item = TypeVar("Item")
Index = Annotated[int, Field(ge=0, lt=2**31)]
Count = Annotated[int, Field(ge=0, lt=2**40)]
Lots = Annotated[list[Item], Field(fail_fast=True, max_length=100_000)]
Share = Annotated[float, Field(ge=0, le=1)]
Pair = Annotated[list[float], Field(min_length=2, max_length=2)]
Vector3 = Annotated[list[float], Field(min_length=3, max_length=3)]
Vector4 = Annotated[list[float], Field(min_length=4, max_length=4)]
# Some programs write colours above 1, which the format does not allow.
_Channel = Annotated[float, Field(ge=0)]
Rgb = Annotated[list[_Channel], Field(min_length=3, max_length=3)]
Rgba = Annotated[list[_Channel], Field(min_length=4, max_length=4)]

SILENT = frozenset(
    "name extras generator copyright minVersion mimeType min max target minFilter "
    "alphaCutoff camera skin weights extensionsUsed".split()
)
"""Keys without effect here, or that belong to a key which is listed as not used."""
USUAL = {"alphaMode": "OPAQUE", "doubleSided": False}
"""Values with which these keys have no effect."""
COLOURS = {
    "COLOR_0": "diffuse",
    "_AMBIENT": "ambient",
    "_SPECULAR": "specular",
    "_EMISSION": "emission",
    "_SHININESS": "shininess",
}
"""Attributes of vertices that multiply a material's parameters, in files that phongfit
wrote. All except `COLOR_0` are custom attributes, which the format allows."""
COLOUR_0 = {"COLOR_0": ("diffuse", "ambient")}
"""The attribute in files of other programs, where it multiplies base colour."""


class _Record(BaseModel):
    """An object of the JSON part; unknown keys are kept, to be listed as not used."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=False, defer_build=True)


def unused(record: BaseModel, place: str = "") -> Iterator[str]:
    """Keys of a file that are not used here, such as `materials.alphaMode`."""
    for key, value in (record.model_extra or {}).items():
        if key == "extensions" and isinstance(value, dict):
            yield from (f"{place}{key}.{name[:60]}" for name in value)
        elif key not in SILENT and USUAL.get(key) != value:
            yield f"{place}{key[:60]}"
    for name in type(record).model_fields:
        value = getattr(record, name)
        for one in value if isinstance(value, list) else [value]:
            if isinstance(one, BaseModel):
                yield from unused(one, f"{place}{name}.")


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


class _Place(_Record):
    """Start of numbers in a view; `componentType` is read for indices only."""

    bufferView: Index
    byteOffset: Count = 0
    componentType: Literal[5121, 5123, 5125] = 5121


class _Sparse(_Record):
    count: Count
    indices: _Place
    values: _Place


class Accessor(_Record):
    bufferView: Index | None = None
    byteOffset: Count = 0
    componentType: Literal[5120, 5121, 5122, 5123, 5125, 5126]
    normalized: bool = False
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


class Transform(_Record):
    """KHR_texture_transform."""

    offset: Pair = [0, 0]
    rotation: float = 0.0
    scale: Pair = [1, 1]
    texCoord: Index | None = None


class _OfTexture(_Record):
    KHR_texture_transform: Transform = Transform()


class TextureInfo(_Record):
    """A texture's number, and its set of uv; `scale` applies to normal maps."""

    index: Index
    texCoord: Index = 0
    scale: float = 1.0
    extensions: _OfTexture = _OfTexture()


class Roughness(_Record):
    """pbrMetallicRoughness."""

    baseColorFactor: Rgba = [1, 1, 1, 1]
    baseColorTexture: TextureInfo | None = None
    metallicFactor: Share = 1.0
    roughnessFactor: Share = 1.0
    metallicRoughnessTexture: TextureInfo | None = None


class Glossiness(_Record):
    """KHR_materials_pbrSpecularGlossiness."""

    diffuseFactor: Rgba = [1, 1, 1, 1]
    diffuseTexture: TextureInfo | None = None
    specularFactor: Rgb = [1, 1, 1]
    glossinessFactor: Share = 1.0
    specularGlossinessTexture: TextureInfo | None = None


class _Specular(_Record):
    """KHR_materials_specular."""

    specularFactor: Share = 1.0
    specularTexture: TextureInfo | None = None
    specularColorFactor: Rgb = [1, 1, 1]
    specularColorTexture: TextureInfo | None = None


class _Ior(_Record):
    """KHR_materials_ior; index 0 means a reflectance of 1."""

    ior: Annotated[float, Field(ge=0, le=1e3)] = 1.5


class _Strength(_Record):
    """KHR_materials_emissive_strength."""

    emissiveStrength: Annotated[float, Field(ge=0, le=1e30)] = 1.0


class _OfMaterial(_Record):
    KHR_materials_specular: _Specular = _Specular()
    KHR_materials_ior: _Ior = _Ior()
    KHR_materials_emissive_strength: _Strength = _Strength()
    KHR_materials_pbrSpecularGlossiness: Glossiness | None = None


class GltfMaterial(_Record):
    name: str | None = None
    pbrMetallicRoughness: Roughness = Roughness()
    normalTexture: TextureInfo | None = None
    emissiveFactor: Rgb = [0, 0, 0]
    emissiveTexture: TextureInfo | None = None
    extensions: _OfMaterial = _OfMaterial()
    extras: Any = None


class Image(_Record):
    uri: str | None = None
    bufferView: Index | None = None


class GltfSampler(_Record):
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
    samplers: Lots[GltfSampler] = []
    extensionsRequired: Lots[str] = []


def at(items: list[Item], number: int, what: str) -> Item:
    """An item of a list, by its number in the file.

    **Raises:** `ValueError` that names `what`, the key of the number.
    """
    if number >= len(items):
        raise ValueError(f"{what}: expected a number below {len(items)}, got {number}")
    return items[number]
