"""glTF files: what they say is checked before it is believed."""

import base64
import json
from typing import Any

import numpy as np
import pytest

import phongfit as pf
from tests.helpers import near


def _triangle(**changes) -> dict[str, Any]:
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
    """The only accessor of [`_triangle`][], with other entries, or without some."""
    (accessor,) = _triangle()["accessors"]
    whole = accessor | changes
    return [{key: value for key, value in whole.items() if value is not None}]


WRONG_GLTF = {
    "no view": (
        _triangle(accessors=_accessor(bufferView=None, count=2**30)),
        r"accessors\[0\]: bufferView: is missing, as in compressed meshes",
    ),
    "too many": (
        _triangle(accessors=_accessor(count=2**30)),
        r"accessors\[0\]: bufferView: expected 12884901888 bytes",
    ),
    "past the buffer": (
        _triangle(bufferViews=[{"buffer": 0, "byteOffset": 4, "byteLength": 36}]),
        r"bufferViews\[0\]: expected bytes up to 40, got 36",
    ),
    "no such view": (
        _triangle(accessors=_accessor(bufferView=7)),
        r"bufferView: expected a number below 1, got 7",
    ),
    "negative": (
        _triangle(accessors=_accessor(count=-1)),
        r"accessors\[0\].count: expected greater than or equal to 0, got -1",
    ),
    "Draco": (
        _triangle(extensionsRequired=["KHR_draco_mesh_compression"]),
        "requires the extension 'KHR_draco_mesh_compression'",
    ),
    "two parents": (
        _triangle(nodes=[{"children": [1, 1]}, {"mesh": 0}]),
        r"nodes\[1\]: expected one parent",
    ),
    "version 1": (_triangle(asset={"version": "1.0"}), "expected glTF version 2"),
    "empty": ("", "is no JSON"),
    "cut": ("{", "is no JSON"),
}


@pytest.mark.parametrize("case", WRONG_GLTF)
def test_gltf_that_says_what_it_does_not_hold(tmp_path, case):
    content, said = WRONG_GLTF[case]
    # A whole one beside it is none of its business.
    (tmp_path / "model.gltf").write_text(json.dumps(_triangle()))
    text = content if isinstance(content, str) else json.dumps(content)
    (tmp_path / "x.gltf").write_text(text)
    with pytest.raises(ValueError, match=rf"x\.gltf: .*{said}"):
        pf.load_mesh(tmp_path / "x.gltf")


def test_gltf_with_sparse_positions(tmp_path):
    numbers = np.array([2], np.uint32).tobytes(), np.array([0, 5, 0], "<f4").tobytes()
    coded = base64.b64encode(b"".join(numbers)).decode()
    content = _triangle(
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
    content = _triangle(
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
    with pytest.warns(UserWarning, match="a.gltf: its points and lines are not used"):
        mesh = pf.load_mesh(tmp_path / "a.gltf").mesh
    turned = corners * [-2, -1, 1] + [0, 0, 5]
    near(mesh.vertices, np.concatenate([turned, turned]))
    wanted = [[0, 1, 2], [2, 1, 3], [4, 5, 6], [4, 6, 7]]
    np.testing.assert_array_equal(mesh.faces, wanted)
