"""Scene files: exact round trips, and errors that name the field."""

import json

import equinox as eqx
import numpy as np
import pytest

import phongfit as pf
from phongfit.files.scenes import load_scene, load_truth, save_scene, save_truth
from phongfit.geometry.cameras import AbstractCamera
from tests.helpers import said

LIGHTS = (
    pf.DirectionalLight((1, 1, 2), 0.7),
    pf.PointLight((1, 2, 3), (0.1, 0.2, 0.3), attenuation=(0, 0.1, 0.3), specular=0.3),
    pf.SpotLight((1, 2, 3), (0, 0, -1), cutoff=33, exponent=2.5, ambient=0.1),
    pf.HarmonicLight(np.linspace(-0.1, 1.2, 27).reshape(9, 3)),
)


@pytest.mark.parametrize(
    "camera",
    [
        pf.OrthographicCamera(5, 4),
        pf.PerspectiveCamera.look_at((1, 2, 3.3), width=5, height=4, fov_y=33.3),
    ],
)
@pytest.mark.parametrize(
    "specular", [pf.Phong(gate=False), pf.BlinnPhong(normalized=True)]
)
def test_round_trip_is_exact(tmp_path, camera: AbstractCamera, specular):
    sphere = pf.Sphere((0.1, -0.7, 1 / 3), 1.3)
    scene = pf.Scene(
        sphere, camera, LIGHTS, 0.3, specular_model=specular, background=0.1
    )
    save_scene(tmp_path, scene)
    assert eqx.tree_equal(load_scene(tmp_path), scene)
    assert eqx.tree_equal(load_scene(tmp_path / "scene.json"), scene)


def test_normal_map_goes_into_files_beside_it(tmp_path):
    normals = np.random.default_rng(0).normal(size=(4, 5, 3))
    mask = np.arange(20).reshape(4, 5) % 3 > 0
    camera = pf.OrthographicCamera(5, 4)
    for positions in (None, normals * 2):
        surface = pf.NormalMap(normals, mask, positions)
        save_scene(tmp_path / "a.json", pf.Scene(surface, camera))
        back = load_scene(tmp_path / "a.json").surface
        assert isinstance(back, pf.NormalMap)
        assert np.array_equal(back.mask, surface.mask)
        # Normals are brought to length 1 again, which may turn the last bit.
        np.testing.assert_allclose(back.normals, surface.normals, rtol=1e-6)
        assert eqx.tree_equal(back.positions, surface.positions)


def test_a_kind_that_files_do_not_know(tmp_path):
    class Laser(pf.AbstractLight):
        def illuminate(self, position):
            raise NotImplementedError

    scene = pf.Scene(pf.Sphere(), lights=Laser())
    with pytest.raises(ValueError, match="Laser: cannot be saved"):
        save_scene(tmp_path, scene)
    assert not list(tmp_path.iterdir())


def test_defaults_and_look_at_by_hand(tmp_path):
    camera = {"kind": "perspective", "width": 4, "height": 3, "position": [0, 0, 5]}
    data = {
        "format": "phongfit scene",
        "version": 1,
        "surface": {"kind": "sphere"},
        "camera": camera | {"target": [0, 0, 0], "up": [1, 0, 0]},
        "lights": [{"kind": "directional", "direction": [0, 0, 1]}],
    }
    (tmp_path / "scene.json").write_text(json.dumps(data))
    scene = load_scene(tmp_path)
    expected = pf.Scene(
        pf.Sphere(),
        pf.PerspectiveCamera.look_at((0, 0, 5), up=(1, 0, 0), width=4, height=3),
        pf.DirectionalLight((0, 0, 1)),
    )
    assert eqx.tree_equal(scene, expected)


MAP = {"kind": "normal_map", "normals": "n.npy"}

# A place in the file, its wrong value (... to remove it), and words of the message.
WRONG = [
    ("colour", 3, "the file: \"colour\" is no key of it; known: ['format'"),
    ("ambeint", 3, "\"ambeint\" is no key of it; did you mean 'ambient'?"),
    ("lights.1.intensty", 1, 'lights[1]: "intensty" is no key'),
    ("camera.fov", 30, 'camera: "fov" is no key'),
    (
        "lights.0.direction",
        [0, 0, 0],
        "lights[0].direction: expected ... got [0. 0. 0.]",
    ),
    ("lights.0.direction", [0, 1], "lights[0].direction: expected th ... got [0, 1]"),
    ("lights.0.direction", [0, "a", 1], 'lights[0].direction[1]: expected ... got "a"'),
    ("lights.0.direction", ..., "lights[0].direction: is missing"),
    (
        "lights.0.intensity",
        [0, -1, 0],
        "lights[0].intensity: expected ... got [ 0. -1.",
    ),
    ("lights.0.intensity", -1, "lights[0].intensity: expected ... got [-1. -1. -1.]"),
    ("lights.0.intensity", "much", 'lights[0].intensity: expected one ... got "much"'),
    ("lights.0.intensity", True, "lights[0].intensity: expected one ... got true"),
    (
        "lights.1.attenuation",
        [0, 0, 0],
        "lights[1].attenuation: expected ... got [0. 0. 0.]",
    ),
    ("lights.2.axis", [0, 0, 0], "lights[2].axis: expected ... got [0. 0. 0.]"),
    ("lights.2.cutoff_degrees", 91, "lights[2].cutoff_degrees: expected ... got 91."),
    ("lights.2.exponent", -1, "lights[2].exponent: expected ... got -1."),
    ("lights.0.kind", "laser", 'lights[0].kind: expected one of ... got "laser"'),
    ("lights.0.kind", ..., "lights[0].kind: is missing"),
    ("lights.0", 3, "lights[0]: expected an object {…}, got 3"),
    ("lights", 3, "lights: expected a valid list, got 3"),
    ("camera.width", 0, "camera.width: expected a whole number ≥ 1, got 0"),
    ("camera.width", 2.5, "camera.width: expected a valid integer ... got 2.5"),
    ("camera.width", 2**26, "camera.width: expected ... got 67108864 × 4 pixels"),
    (
        "camera.fov_y_degrees",
        180,
        "camera.fov_y_degrees: expected a number ... got 180.",
    ),
    ("camera.target", [0, 0, 0], "camera.rotation: expected it or target"),
    ("camera.rotation", [[1, 0, 0]], "camera.rotation: expected ... got [[1, 0, 0]]"),
    (
        "camera.rotation",
        [[1, 0, 0], [0, 1, 0], [0, 0, 2]],
        "camera.rotation: expected orthonormal ... got [[1. 0. 0.] [0. 1.",
    ),
    ("surface.radius", -1, "surface.radius: expected a number > 0, got -1."),
    ("surface.kind", "cube", 'surface.kind: expected ... got "cube"'),
    ("surface", MAP, "surface.normals: "),
    (
        "surface",
        MAP | {"normals": "../n.npy"},
        "surface.normals: expected ... got '../n.npy'",
    ),
    ("surface", MAP | {"mask": "/m.png"}, "surface."),
    ("specular.gate", 1, "specular.gate: expected a valid boolean ... got 1"),
    ("specular.kind", "minnaert", 'specular.kind: expected ... got "minnaert"'),
    ("ambient", None, "ambient: expected ... got null"),
    ("ambient", -0.5, "ambient: expected ... got [-0.5 -0.5 -0.5]"),
    ("format", "mesh", "format: expected 'phongfit scene', got \"mesh\""),
    ("version", 2, "version: expected 1, got 2"),
    ("encoding", "gamma", "encoding: expected 'linear' or 'srgb' ... got \"gamma\""),
    ("bits", 17, "bits: expected ... got 17"),
    ("surface", ..., "surface: is missing"),
]


@pytest.mark.parametrize("place, value, message", WRONG)
def test_wrong_values(tmp_path, place, value, message):
    camera = pf.PerspectiveCamera(5, 4)
    save_scene(
        tmp_path, pf.Scene(pf.Sphere(), camera, LIGHTS, specular_model=pf.Phong())
    )
    data = json.loads((tmp_path / "scene.json").read_text())
    *path, last = place.split(".")
    part = data
    for key in path:
        part = part[int(key) if key.isdecimal() else key]
    if value is ...:
        del part[last]
    else:
        part[int(last) if last.isdecimal() else last] = value
    _check_error(tmp_path, json.dumps(data), message)


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "is no JSON"),
        ('{"format": ', "is no JSON: Expecting value: line 1"),
        ("[]", "the file: expected an object {…}, got []"),
        ('{"ambient": NaN}', "expected finite numbers, got NaN"),
        ('{"ambient": -Infinity}', "expected finite numbers, got -Infinity"),
        ('{"a": 1, "a": 2}', 'expected each key once in an object, got "a" twice'),
        ("[" * 100000, "is nested too deeply"),
        ('{"version": ' + "9" * 5000 + "}", "expected finite numbers, got 999"),
        (" " * (2**24 + 1), "expected at most ... bytes, got"),
    ],
    ids=["empty", "cut", "list", "nan", "inf", "twice", "deep", "digits", "huge"],
)
def test_wrong_json(tmp_path, text, message):
    _check_error(tmp_path, text, message)


def test_infinite_numbers(tmp_path):
    save_scene(tmp_path, pf.Scene(pf.Sphere(), lights=LIGHTS))
    text = (tmp_path / "scene.json").read_text().replace("0.7", "1e999", 1)
    _check_error(
        tmp_path, text, "lights[0].intensity[0]: expected a finite ... got Infinity"
    )


def test_normal_maps_that_do_not_fit(tmp_path):
    save_scene(
        tmp_path,
        pf.Scene(pf.NormalMap(np.ones((4, 5, 3))), pf.OrthographicCamera(5, 4)),
    )
    text = (tmp_path / "scene.json").read_text()
    wrong = text.replace('"width": 5', '"width": 6')
    _check_error(tmp_path, wrong, "surface: expected a normal map of ... got (4, 5)")
    for array, message in (
        (
            np.ones((4, 5)),
            "surface.normals: expected shape (height, width, 3), got (4, 5)",
        ),
        (np.full((4, 5, 3), np.nan), "surface.normals: "),
        (np.array([{}]), "surface.normals: "),
    ):
        np.save(tmp_path / "scene_normals.npy", array)
        _check_error(tmp_path, text, message)
    data = (tmp_path / "scene_normals.npy").read_bytes()
    (tmp_path / "scene_normals.npy").write_bytes(data[:-10])
    _check_error(tmp_path, text, "scene_normals.npy: cannot be read")
    np.savez(tmp_path / "n.npz", other=np.ones((4, 5, 3)))
    text = text.replace("scene_normals.npy", "n.npz")
    _check_error(tmp_path, text, "expected an array 'normals', got ['other']")
    np.savez(tmp_path / "n.npz", normals=np.ones((4, 5, 3)))
    (tmp_path / "scene.json").write_text(text)
    assert isinstance(load_scene(tmp_path).surface, pf.NormalMap)


def _check_error(folder, text, message) -> None:
    path = folder / "scene.json"
    path.write_text(text)
    with pytest.raises(ValueError) as caught:
        load_scene(folder)
    told = str(caught.value)
    assert told.startswith(f"{path}: ") and said(message, told) and "\n" not in told


@pytest.mark.parametrize(
    "shading",
    [pf.FlatShading("last_vertex", True), pf.GouraudShading(clamp=True)],
    ids=["flat", "gouraud"],
)
def test_round_trip_of_a_mesh_in_fog(tmp_path, shading):
    ring = pf.shapes.Torus().mesh(8, 6)
    mesh = pf.Mesh(ring.vertices, ring.faces, None, np.arange(len(ring.faces)) % 2)
    scene = pf.Scene(
        mesh,
        pf.PerspectiveCamera(8, 6),
        pf.PointLight((1, 2, 3)),
        shading=shading,
        fog=pf.Fog((0.1, 0.2, 0.3), "linear", start=2, end=9),
        shadows=True,
        local_viewer=False,
    )
    save_scene(tmp_path, scene)
    assert eqx.tree_equal(load_scene(tmp_path), scene)


def test_a_mesh_in_a_common_format(tmp_path):
    (tmp_path / "t.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    text = """{"format": "phongfit scene", "version": 1,
      "surface": {"kind": "mesh_file", "file": "FILE"},
      "camera": {"kind": "orthographic", "width": 4, "height": 4}}"""
    (tmp_path / "scene.json").write_text(text.replace("FILE", "t.obj"))
    surface = load_scene(tmp_path).surface
    assert isinstance(surface, pf.Mesh) and len(surface.faces) == 1
    _check_error(tmp_path, text.replace("FILE", "u.obj"), "u.obj")
    _check_error(tmp_path, text.replace("FILE", "../t.obj"), "surface.file: ")


def test_truth_round_trip(tmp_path):
    path = tmp_path / "truth.json"
    material = pf.Material((0.6, 1 / 3, 0.2), 0.3, 60.0, 0.5)
    save_truth(path, material, noise=0.01, seed=3)
    assert eqx.tree_equal(load_truth(path), material)
    data = json.loads(path.read_text())
    assert data["noise"] == 0.01 and data["seed"] == 3
    assert data["material"]["shininess"] == 60
    data["material"]["shininess"] = -1
    path.write_text(json.dumps(data))
    with pytest.raises(
        ValueError, match=r"truth\.json: material\.shininess: expected .*, got -1"
    ):
        load_truth(path)
    with pytest.raises(ValueError, match=r"diffuse: expected shape.*got \(2, 3\)"):
        save_truth(path, pf.Material(np.ones((2, 3))))
