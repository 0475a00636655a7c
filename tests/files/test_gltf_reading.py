"""glTF files: what they say is checked before it is believed."""

import base64
import json
from typing import Any

import numpy as np
import pytest

import phongfit as pf
from tests.helpers import known, near


def triangle(**changes) -> dict[str, Any]:
    """The JSON of a glTF file of one triangle, with other entries at its top."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32).tobytes()
    uri = f"data:application/octet-stream;base64,{base64.b64encode(corners).decode()}"
    return {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}
        ],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36, "uri": uri}],
    } | changes


def _accessor(**changes) -> list[dict[str, Any]]:
    """The only accessor of [`triangle`][], with other entries, or without some."""
    (accessor,) = triangle()["accessors"]
    whole = accessor | changes
    return [{key: value for key, value in whole.items() if value is not None}]


def _primitive(**changes) -> dict[str, Any]:
    """The JSON of [`triangle`][], with other entries in its primitive."""
    primitive = {"attributes": {"POSITION": 0}} | changes
    return triangle(meshes=[{"primitives": [primitive]}])


def _material(**material) -> dict[str, Any]:
    """The JSON of [`triangle`][], with a material."""
    return _primitive(material=0) | {"materials": [material]}


WRONG_GLTF = {
    "no view": (
        triangle(accessors=_accessor(bufferView=None, count=2**30)),
        r"accessors\[0\]: bufferView: is missing, as in compressed meshes",
    ),
    "too many": (
        triangle(accessors=_accessor(count=2**30)),
        r"accessors\[0\]: bufferView: expected 12884901888 bytes",
    ),
    "past the buffer": (
        triangle(bufferViews=[{"buffer": 0, "byteOffset": 4, "byteLength": 36}]),
        r"bufferViews\[0\]: expected bytes 4 to 40, got 36",
    ),
    "no such view": (
        triangle(accessors=_accessor(bufferView=7)),
        r"bufferView: expected a number below 1, got 7",
    ),
    "negative": (
        triangle(accessors=_accessor(count=-1)),
        r"accessors\[0\]: count: expected a whole number ≥ 0, got -1",
    ),
    "Draco": (
        triangle(extensionsRequired=["KHR_draco_mesh_compression"]),
        "requires the extension 'KHR_draco_mesh_compression', which is not read",
    ),
    "two parents": (
        triangle(nodes=[{"children": [1, 1]}, {"mesh": 0}]),
        r"nodes\[1\]: expected one parent",
    ),
    "before a view": (
        triangle(accessors=_accessor(byteOffset=-12)),
        r"accessors\[0\]: byteOffset: expected a whole number ≥ 0, got -12",
    ),
    "no list": (triangle(nodes={"a": 1}), r"nodes: expected a list, got {\"a\": 1}"),
    "no number": (
        triangle(accessors=_accessor(count="3")),
        r"accessors\[0\]: count: expected a whole number ≥ 0, got \"3\"",
    ),
    "no key": (
        triangle(accessors=[{}]),
        r"accessors\[0\]: is no valid glTF \(KeyError: 'type'\)",
    ),
    "no length": (
        triangle(buffers=[{"byteLength": -1, "uri": "data:;base64,"}]),
        r"buffers\[0\]: byteLength: expected a whole number ≥ 0, got -1",
    ),
    "a flag in words": (
        triangle(accessors=_accessor(normalized="false")),
        r"accessors\[0\]: normalized: expected true or false",
    ),
    "a list as a name": (_material(name=["a"]), r"materials\[0\]: name: expected"),
    "a mode in words": (
        _primitive(mode="4"),
        r"meshes\[0\].primitives\[0\]: mode: expected a whole number ≥ 0, got \"4\"",
    ),
    "one number": (
        triangle(nodes=[{"mesh": 0, "translation": [5]}]),
        r"nodes\[0\]: translation: expected 3 numbers, got \[5\]",
    ),
    "rows": (
        triangle(nodes=[{"mesh": 0, "matrix": np.eye(4).tolist()}]),
        r"nodes\[0\]: matrix: expected 16 numbers",
    ),
    "sparse": (
        triangle(
            accessors=_accessor(
                sparse={
                    "count": 1,
                    "indices": {"bufferView": 0, "componentType": 5122},
                    "values": {"bufferView": 0},
                }
            )
        ),
        r"accessors\[0\]: sparse: expected whole numbers from 0, got int16",
    ),
    "past the rows": (
        triangle(
            accessors=_accessor(
                sparse={
                    "count": 1,
                    "indices": {
                        "bufferView": 0,
                        "byteOffset": 15,
                        "componentType": 5121,
                    },
                    "values": {"bufferView": 0},
                }
            )
        ),
        r"accessors\[0\]: sparse: expected indices below 3, got 63",
    ),
    "a mirror": (
        _material(extensions={"KHR_materials_ior": {"ior": -0.9}}),
        r"materials\[0\]: ior: expected 0 to 1000, got -0.9",
    ),
    "one colour": (
        _material(emissiveFactor=[1]),
        r"materials\[0\]: emissiveFactor: expected 3 numbers, got \[1\]",
    ),
    "five colours": (
        _material(pbrMetallicRoughness={"baseColorFactor": [1] * 5}),
        r"materials\[0\]: baseColorFactor: expected 4 numbers",
    ),
    "a number of words": (
        _material(pbrMetallicRoughness={"metallicFactor": "1"}),
        r"materials\[0\]: metallicFactor: expected 0 to 1, got \"1\"",
    ),
    "no objects": (
        _material(pbrMetallicRoughness=[]),
        r"materials\[0\]: is no valid glTF \(AttributeError",
    ),
    "version 1": (triangle(asset={"version": "1.0"}), "expected glTF 2, got '1.0'"),
    "empty": ("", "is no JSON"),
    "cut": ("{", "is no JSON"),
}


@pytest.mark.parametrize("case", WRONG_GLTF)
def test_gltf_that_says_what_it_does_not_hold(tmp_path, case):
    content, said = WRONG_GLTF[case]
    # A whole one beside it is none of its business.
    (tmp_path / "model.gltf").write_text(json.dumps(triangle()))
    text = content if isinstance(content, str) else json.dumps(content)
    (tmp_path / "x.gltf").write_text(text)
    with pytest.raises(ValueError, match=rf"x\.gltf: .*{said}"):
        pf.load_mesh(tmp_path / "x.gltf")


def test_gltf_of_floats_and_null(tmp_path):
    """As programs write it that know only floats, and every key."""
    content = _material(
        name=None,
        emissiveTexture=None,
        normalTexture={
            "index": 0.0,
            "extensions": {"KHR_texture_transform": {"texCoord": None}},
        },
    ) | {
        "nodes": [{"mesh": 0.0, "matrix": None, "translation": [0.0, 0.0, 2.0]}],
        "accessors": _accessor(bufferView=0.0, count=3.0, componentType=5126.0),
        "bufferViews": [{"buffer": 0.0, "byteLength": 36.0, "byteStride": 12.0}],
        "textures": [{"source": 0.0, "sampler": None}],
        "images": [{"uri": None}],
    }
    content["meshes"][0]["primitives"][0] |= {"indices": None, "mode": 4.0}
    (tmp_path / "a.gltf").write_text(json.dumps(content))
    with pytest.warns(UserWarning, match=r"normalTexture of a material \(images\[0\]"):
        mesh = pf.load_mesh(tmp_path / "a.gltf").mesh
    near(mesh.vertices, [[0, 0, 2], [1, 0, 2], [0, 1, 2]])


def test_gltf_with_sparse_positions(tmp_path):
    numbers = np.array([2], np.uint32).tobytes(), np.array([0, 5, 0], "<f4").tobytes()
    coded = base64.b64encode(b"".join(numbers)).decode()
    content = triangle(
        accessors=_accessor(
            sparse={
                "count": 1,
                "indices": {"bufferView": 1, "componentType": 5125},
                "values": {"bufferView": 1, "byteOffset": 4},
            }
        )
    )
    content["bufferViews"].append({"buffer": 1, "byteLength": 16})
    content["buffers"].append({"byteLength": 16, "uri": f"data:;base64,{coded}"})
    (tmp_path / "a.gltf").write_text(json.dumps(content))
    near(pf.load_mesh(tmp_path / "a.gltf").mesh.vertices[2], (0, 5, 0))


def test_gltf_strips_fans_and_nodes_within_nodes(tmp_path):
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], np.float32)
    coded = base64.b64encode(corners.tobytes()).decode()
    primitives = [{"attributes": {"POSITION": 0}, "mode": mode} for mode in (0, 5, 6)]
    content = triangle(
        meshes=[{"primitives": primitives}],
        accessors=_accessor(count=4),
        bufferViews=[{"buffer": 0, "byteLength": 48}],
        buffers=[{"byteLength": 48, "uri": f"data:;base64,{coded}"}],
        nodes=[
            {"children": [1], "translation": [0, 0, 5]},
            {"mesh": 0, "rotation": [0, 0, 1, 0], "scale": [2, 1, 1]},
        ],
    )
    (tmp_path / "a.gltf").write_text(json.dumps(content))
    with pytest.warns(UserWarning, match="a.gltf: not used: points and lines"):
        mesh = pf.load_mesh(tmp_path / "a.gltf").mesh
    turned = corners * [-2, -1, 1] + [0, 0, 5]
    wanted = turned[[[0, 1, 2], [2, 1, 3], [0, 1, 2], [0, 2, 3]]]
    near(np.asarray(mesh.vertices)[np.asarray(mesh.faces)], wanted)


def binary(content: dict[str, Any], **arrays: np.ndarray) -> dict[str, Any]:
    """A file of [`triangle`][] with arrays as accessors, by the attribute's name."""
    (primitive,) = content["meshes"][0]["primitives"]
    kinds = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
    types = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
    for name, rows in arrays.items():
        coded = base64.b64encode(rows.tobytes()).decode()
        number = len(content["accessors"])
        view = {"buffer": len(content["buffers"]), "byteLength": rows.nbytes}
        accessor = {
            "bufferView": len(content["bufferViews"]),
            "componentType": types[rows.dtype.str[1:]],
            "count": len(rows),
            "type": kinds[rows.shape[1]],
            "normalized": rows.dtype.kind != "f",
        }
        content["accessors"].append(accessor)
        content["bufferViews"].append(view)
        uri = f"data:application/octet-stream;base64,{coded}"
        content["buffers"].append({"byteLength": rows.nbytes, "uri": uri})
        if name == "indices":
            primitive["indices"] = number
        else:
            primitive["attributes"][name] = number
    return content


CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1]])
"""Two sides of a cube: two triangles of z = 0, and one of x = 0."""
SIDES = np.array([[0, 2, 1], [0, 3, 2], [0, 4, 3]])


def test_faces_without_normals_are_flat(tmp_path):
    content = binary(
        triangle(),
        POSITION=CORNERS.astype("f4"),
        indices=SIDES.reshape(-1, 1).astype("u2"),
        COLOR_0=np.linspace(0, 255, 15).reshape(5, 3).astype("u1"),
    )
    (tmp_path / "a.gltf").write_text(json.dumps(content))
    mesh, _, _ = pf.load_mesh(tmp_path / "a.gltf")
    faces = np.asarray(mesh.faces)
    near(np.asarray(mesh.vertices)[faces], CORNERS[SIDES])
    wanted = np.array([[0, 0, -1], [0, 0, -1], [-1, 0, 0]])
    near(mesh.vertex_normals()[faces], np.repeat(wanted[:, None], 3, axis=1))
    (textures,) = known(mesh.textures)
    rows = np.linspace(0, 255, 15).reshape(5, 3).astype("u1") / 255
    near(known(textures.diffuse).values[faces], rows[SIDES])
    # Smooth normals on request, of vertices that are shared again.
    smooth = pf.load_mesh(tmp_path / "a.gltf", crease_angle=180).mesh
    assert smooth.vertices.shape == (5, 3)
    at = np.argmin(np.linalg.norm(np.asarray(smooth.vertices), axis=1))
    near(smooth.vertex_normals()[at], np.array([-1, 0, -2]) / 5**0.5)


@pytest.mark.parametrize("normalized", [True, False])
@pytest.mark.parametrize("kind", ["i1", "u1", "i2", "u2"])
def test_quantized_meshes(tmp_path, kind, normalized):
    """Positions, normals and uv as whole numbers, as gltfpack writes them."""
    highest = np.iinfo(kind).max
    signed = kind[0] == "i"
    up = np.array([[0, 0, highest]] * 3, kind)
    uv = np.array([[0, 0], [highest, 0], [0, highest]], kind)
    content = binary(
        triangle(
            nodes=[{"mesh": 0, "scale": [2, 2, 2]}],
            extensionsUsed=["KHR_mesh_quantization"],
            extensionsRequired=["KHR_mesh_quantization"],
        ),
        POSITION=np.array([[0, 0, 0], [100, 0, 0], [0, 120, 0]], kind),
        **({"NORMAL": up} if signed else {}),
        TEXCOORD_0=uv,
    )
    for accessor in content["accessors"][1:]:
        accessor["normalized"] = normalized
    (tmp_path / "a.gltf").write_text(json.dumps(content))
    mesh = pf.load_mesh(tmp_path / "a.gltf").mesh
    scale = 2 / highest if normalized else 2
    near(mesh.vertices, scale * np.array([[0, 0, 0], [100, 0, 0], [0, 120, 0]]), 1e-5)
    near(mesh.vertex_normals(), np.tile([0, 0, 1], (3, 1)))
    near(known(mesh.uv)[0], uv / highest if normalized else uv, 1e-6)


def test_the_least_whole_number_is_minus_one(tmp_path):
    rows = np.array([[-128, 0, 0], [127, 0, 0], [0, 127, 0]], "i1")
    content = binary(triangle(), POSITION=rows)
    (tmp_path / "a.gltf").write_text(json.dumps(content))
    mesh = pf.load_mesh(tmp_path / "a.gltf").mesh
    near(mesh.vertices, [[-1, 0, 0], [1, 0, 0], [0, 1, 0]])
