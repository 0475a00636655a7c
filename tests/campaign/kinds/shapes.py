"""Meshes and materials that were damaged, of every format."""

import base64
import functools
import json
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from phongfit.files.formats import encode_png
from phongfit.files.meshes import load_mesh
from phongfit.files.mtl import read_mtl
from tests.campaign.cases import Case, Kind, Wrong, blaming, put
from tests.campaign.damage import damaged

LIBRARY = b"""newmtl red clay
Kd 0.7 0.1 0.1
Ks 0.5 0.5 0.5
Ns 200
illum 2
map_Kd wood.png
newmtl blue
Kd 0 0 0.5
Ke 0.1
"""
OBJECTS = b"""mtllib a.mtl
v 0 0 0
v 1 0 0
v 1 1 1
v 0 1 1
vn 0 0 1
usemtl red clay
f 1//1 2//1 3//1
usemtl blue
s 1
f -4 -2 -1
s off
v 0.5 0.2 0
f 1 2 3 5
"""
COLOURED = b"""COFF
5 2 0
0 0 0 255 0 0
4 0 0 0 255 0
4 4 0 0 0 255
2 1 0 9 9 9
0 4 0 1 2 3
5 0 1 2 3 4
3 0 1 2
"""
HEAD = b"""ply
format binary_little_endian 1.0
element vertex 5
property float x
property float y
property float z
element face 2
property list uchar int vertex_indices
property uchar red
property uchar green
property uchar blue
end_header
"""
"""Of a triangle and a polygon that is not convex."""


@functools.cache
def whole() -> dict[str, bytes]:
    """A box in every format, by name."""
    box = trimesh.creation.box()
    found = {"a.obj": OBJECTS, "a.mtl": LIBRARY, "b.off": COLOURED}
    places = [(0, 0, 0), (4, 0, 0), (4, 4, 0), (2, 1, 0), (0, 4, 0)]
    found["c.ply"] = HEAD + np.array(places, "<f4").tobytes()
    for face in ([0, 1, 2, 3, 4], [0, 1, 2]):
        corners = np.array(face, "<i4").tobytes()
        found["c.ply"] += bytes([len(face)]) + corners + bytes([9, 99, 200])
    for name, kind in (
        ("a.stl", "stl"),
        ("b.stl", "stl_ascii"),
        ("a.ply", "ply"),
        ("a.off", "off"),
        ("a.glb", "glb"),
    ):
        content: Any = box.export(file_type=kind)
        found[name] = content.encode() if isinstance(content, str) else content
    text: Any = box.export(file_type="ply", encoding="ascii")
    found["b.ply"] = text
    data = found["a.glb"]
    length = int.from_bytes(data[12:16], "little")
    scene = json.loads(data[20 : 20 + length])
    scene["buffers"][0]["uri"] = "buffer.bin"
    found["a.gltf"] = json.dumps(scene).encode()
    found["buffer.bin"] = data[28 + length :]
    found["b.gltf"] = json.dumps(scene | _looks(scene)).encode()
    return found


def _looks(scene: dict[str, Any]) -> dict[str, Any]:
    """Materials of a box in glTF, with textures and uv that are its corners."""
    pixels = np.arange(64, dtype=np.uint8).reshape(4, 4, 4)
    picture = base64.b64encode(encode_png(pixels)).decode()
    info = {"index": 0, "extensions": {"KHR_texture_transform": {"rotation": 0.5}}}
    both = {"KHR_materials_pbrSpecularGlossiness": {"specularGlossinessTexture": info}}
    metal = {"baseColorTexture": info, "metallicRoughnessTexture": info}
    materials = [{"pbrMetallicRoughness": metal}, {"extensions": both}]
    accessors = scene["accessors"]
    (primitive,) = scene["meshes"][0]["primitives"]
    attributes = primitive["attributes"]
    uv = accessors[attributes["POSITION"]] | {"type": "VEC2"}
    primitive = primitive | {"attributes": attributes | {"TEXCOORD_0": len(accessors)}}
    return {
        "accessors": [*accessors, uv],
        "images": [{"uri": f"data:image/png;base64,{picture}"}],
        "textures": [{"source": 0}],
        "materials": materials,
        "meshes": [{"primitives": [primitive | {"material": k} for k in (0, 1)]}],
    }


def make(random: np.random.Generator, stock: Path) -> Case:
    del stock
    sources = whole()
    hit = str(random.choice(sorted(sources)))
    what, data = damaged(random, sources[hit])
    # What is read where a part of it was damaged.
    read = {"a.mtl": "a.obj", "buffer.bin": "b.gltf"}.get(hit, hit)
    if hit == "a.mtl" and random.random() < 0.5:
        read = hit

    def act(folder: Path) -> None:
        if read == "a.mtl":
            with blaming(read):
                read_mtl(folder / read)
            return
        with blaming(read if read == hit else read[:2]):
            mesh, material, names = load_mesh(folder / read)
        if not np.isfinite(mesh.vertices).all() or len(names) != mesh.materials:
            raise Wrong("a mesh that is none")
        if not all(np.isfinite(leaf).all() for leaf in (material.diffuse,)):
            raise Wrong("a material that is none")

    return Case(f"{hit}: {what}", put(sources | {hit: data}), act)


KIND = Kind(make)
