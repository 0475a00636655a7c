"""`phongfit export`: other programs read the same numbers."""

import base64
import dataclasses
import json
import re
import shutil
import subprocess
import warnings
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import pytest
import trimesh
import trimesh.viewer

import phongfit as pf
from phongfit.cli import main
from phongfit.files.gltf import roughness, specular_colour
from phongfit.files.limits import as_blinn
from phongfit.files.materials import read_material, write_material
from phongfit.files.opengl import opengl_lines
from phongfit.microfacets import roughness_from_shininess
from tests.helpers import floats, said

BRASS = pf.preset("brass")


def _gltf(path: Path) -> dict:
    """The JSON of a .glb file, by the layout of its specification."""
    content = path.read_bytes()
    length = int.from_bytes(content[12:16], "little")
    assert content[:4] == b"glTF" and content[16:20] == b"JSON"
    assert int.from_bytes(content[8:12], "little") == len(content)
    return json.loads(content[20 : 20 + length])


def _mesh(path: Path) -> Any:
    (mesh,) = trimesh.load_scene(path).geometry.values()
    return mesh


def test_mtl_as_trimesh_reads_it(tmp_path):
    assert (
        main(["export", "preset:brass", "--to", "mtl", "-o", f"{tmp_path}/a.mtl"]) == 0
    )
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nusemtl brass\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    )
    read = _mesh(tmp_path / "a.obj").visual.material.kwargs
    for key, leaf in {"ka": "ambient", "kd": "diffuse", "ks": "specular"}.items():
        np.testing.assert_allclose(read[key], getattr(BRASS, leaf), rtol=1e-6)
    np.testing.assert_allclose(read["ns"], BRASS.shininess, rtol=1e-6)
    own = pf.read_mtl(tmp_path / "a.mtl")["brass"]
    np.testing.assert_allclose(own.shininess, BRASS.shininess, rtol=1e-6)


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_gltf_as_trimesh_reads_it(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    assert main(["export", "preset:brass", "--to", "gltf", "-o", str(path)]) == 0
    mesh = _mesh(path)
    read = mesh.visual.material
    assert read.name == "brass" and read.metallicFactor == 0
    assert read.roughnessFactor == pytest.approx((2 / (BRASS.shininess + 2)) ** 0.25)
    # trimesh rounds colours to 8 bits.
    np.testing.assert_allclose(
        read.baseColorFactor[:3] / 255, BRASS.diffuse, atol=1 / 255
    )
    # A ball of radius 1 that faces outwards.
    np.testing.assert_allclose(mesh.bounds, [[-1] * 3, [1] * 3], atol=1e-3)
    assert mesh.volume == pytest.approx(4 / 3 * np.pi, rel=0.01)
    content = _gltf(path) if suffix == ".glb" else json.loads(path.read_text())
    (material,) = content["materials"]
    specular = material["extensions"]["KHR_materials_specular"]["specularColorFactor"]
    expected = 8 * np.asarray(BRASS.specular) / (float(BRASS.shininess) + 2) / 0.04
    np.testing.assert_allclose(specular, expected, rtol=1e-6)
    phong = material["extras"]["phong"]
    np.testing.assert_allclose(phong["ambient"], BRASS.ambient, rtol=1e-6)
    assert "roughness = " in material["extras"]["conversion"]


# The viewer shows what its own writer made, with the camera that came with it.
OWN_DATA, OWN_CAMERA = r'base64_data="[^"]*"', r"camera=gltf\.cameras\[0\];"
CAMERA = """
    window.gltf = gltf;
    camera = new THREE.PerspectiveCamera(35, 1, 0.1, 100);
    camera.position.set(0, 0, 4);
"""
MATERIAL = """() => {
    let found = [];
    gltf.scene.traverse(one => one.material && found.push(one.material));
    return found.map(m => [m.color.toArray(), m.roughness, m.specularColor.toArray()]);
}"""


@pytest.mark.extended
def test_gltf_opens_in_a_viewer(browser, tmp_path):
    """three.js, which trimesh brings along, shows a ball of the colours and numbers."""
    args = ["export", "preset:brass", "--to", "gltf", "-o", f"{tmp_path}/a.glb"]
    assert main(args) == 0
    content = base64.b64encode((tmp_path / "a.glb").read_bytes()).decode()
    page = trimesh.viewer.scene_to_html(trimesh.Scene(trimesh.creation.box()))
    page, once = re.subn(OWN_DATA, f'base64_data="{content}"', page)
    page, again = re.subn(OWN_CAMERA, CAMERA, page)
    assert once == again == 1
    (tmp_path / "a.html").write_text(page)
    window = browser.new_page(viewport={"width": 120, "height": 120})
    wrong: list[str] = []
    window.on("pageerror", lambda error: wrong.append(str(error)))
    window.goto((tmp_path / "a.html").as_uri())
    window.wait_for_function("window.gltf")
    ((color, rough, specular),) = window.evaluate(MATERIAL)
    # Such viewers know Blinn's lobe only by another name.
    f = float(BRASS.shininess)
    assert rough == pytest.approx((2 / (f + 2)) ** 0.25)
    np.testing.assert_allclose(color, BRASS.diffuse, rtol=1e-6)
    expected = 8 * np.asarray(BRASS.specular) / (f + 2) / 0.04
    np.testing.assert_allclose(specular, expected, rtol=1e-6)
    window.wait_for_timeout(500)
    seen = imagecodecs.png_decode(window.screenshot())[..., :3].astype(int)
    assert not wrong and (seen[:5] == 255).all()
    # Near the rim, for the middle is white in all but blue.
    red, green, blue = seen[60, 102]
    assert red > green > blue
    window.close()


def test_gltf_on_the_scenes_mesh(tmp_path):
    mesh = pf.Mesh(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 2, 0]],
        [[0, 1, 2], [0, 2, 3]],
        material_index=[1, 0],
    )
    pf.save_scene(tmp_path / "scene.json", pf.Scene(mesh))
    args = ["--scene", f"{tmp_path}/scene.json", "-o", f"{tmp_path}/a.glb"]
    assert main(["export", "preset:gold", "--to", "gltf", *args]) == 0
    read = trimesh.load_scene(tmp_path / "a.glb")
    assert [len(part.faces) for part in read.geometry.values()] == [2]
    np.testing.assert_allclose(read.bounds, [[0, 0, 0], [1, 2, 0]])
    (whole,) = read.geometry.values()
    corners = [(0, 0, 0), (0, 2, 0), (1, 0, 0), (1, 1, 0)]
    assert sorted(map(tuple, whole.vertices)) == corners


def test_conversions():
    # α = √(2/(f+2)) is 1 for a matte lobe and 0.1 for f = 198; roughness is its root.
    np.testing.assert_allclose(roughness([0, 198]), [1, 0.1**0.5])
    # ρ_s = F0 (f+2)/8: plastic's 4 % has a highlight of 1 at f = 198.
    assert specular_colour(1.0, 198.0) == pytest.approx(1)
    phong = as_blinn(pf.Material(0.5, 0.3, 10.0), pf.Phong())
    assert phong.shininess == 40 and float(phong.specular) == pytest.approx(0.3)
    model = pf.BlinnPhong(normalized=True)
    given = pf.Material((0.5, 0.6, 0.7), 0.1, 20.0)
    plain = as_blinn(given, model)
    camera, light = pf.OrthographicCamera(9, 9), pf.DirectionalLight((1, 1, 2))
    one, other = (
        pf.render(
            pf.Scene(pf.Sphere(), camera, light, specular_model=m),
            material,
            film=pf.Film(clamp=False),
        )
        for m, material in ((model, given), (pf.BlinnPhong(), plain))
    )
    np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("model", (pf.GGX(0.5, 0.25), pf.GGX(f0=0.25), pf.Ward()))
def test_facets_are_kept_as_gltf_has_them(model, tmp_path):
    """Roughness and F0 exactly; as Blinn's, the highlight seen head-on."""
    material = pf.Material((0.5, 0.4, 0.3), (0.8, 0.6, 0.4), 30.0)
    blinn = as_blinn(material, model)
    ahead = pf.Scene(
        pf.Sphere(), pf.OrthographicCamera(1, 1), pf.DirectionalLight((0, 0, 1))
    )
    bare = pf.Film(clamp=False)
    shown = [
        pf.render(dataclasses.replace(ahead, specular_model=one), given, film=bare)
        for one, given in ((model, material), (pf.BlinnPhong(), blinn))
    ]
    np.testing.assert_allclose(*shown, rtol=1e-5)
    write_material(tmp_path / "facets.json", "facets", material, model)
    read = read_material(str(tmp_path / "facets.json"))
    assert read.model == model
    assert main(["export", f"{tmp_path}/facets.json", "-o", f"{tmp_path}/a.gltf"]) == 0
    (written,) = json.loads((tmp_path / "a.gltf").read_text())["materials"]
    own = getattr(model, "roughness", None)
    rough = float(roughness_from_shininess(floats(30.0))) if own is None else float(own)
    found = written["pbrMetallicRoughness"]["roughnessFactor"]
    assert found == pytest.approx(rough, rel=1e-5)
    tint = written["extensions"]["KHR_materials_specular"]["specularColorFactor"]
    f0 = 0.25 if isinstance(model, pf.GGX) else 1
    np.testing.assert_allclose(tint, f0 * np.array([0.8, 0.6, 0.4]) / 0.04, rtol=1e-5)


@pytest.mark.parametrize("name", ["preset:brass", "preset:black_plastic"])
def test_c_lines_compile_and_hold_the_numbers(tmp_path, name):
    path = tmp_path / "material.c"
    assert main(["export", name, "--to", "opengl", "-o", str(path)]) == 0
    text = path.read_text()
    material = read_material(name).material
    for leaf in ("ambient", "diffuse", "specular", "emission"):
        numbers = text.split(f"GLfloat {leaf}[4] = {{")[1].split("}")[0]
        rgba = [np.float32(number.strip().removesuffix("f")) for number in
                numbers.split(",")]  # fmt: skip
        wanted = np.broadcast_to(np.asarray(getattr(material, leaf), np.float32), (3,))
        assert rgba == [*wanted, 1]
        assert f"glMaterialfv(GL_FRONT_AND_BACK, GL_{leaf.upper()}, {leaf});" in text
    if shutil.which("gcc") is None or not Path("/usr/include/GL/gl.h").exists():
        pytest.skip("there is no gcc, or there are no headers of OpenGL")
    command = ["gcc", "-fsyntax-only", "-Wall", "-Wextra", "-Werror", "-pedantic"]
    done = subprocess.run(
        [*command, "-Wno-unused-function", path], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_no_name_ends_a_comment():
    lines = opengl_lines("*/ int main() {} /* ä", BRASS)
    assert "static void set_material_int_main(void)" in lines
    assert lines.count("*/") == 1


def test_json_gives_the_material_and_its_model_back(tmp_path):
    path = tmp_path / "a.json"
    write_material(path, "some", pf.Material(0.5, 0.3, 10.0), pf.Phong(gate=False))
    args = ["--to", "json", "-o", str(tmp_path / "b.json")]
    assert main(["export", str(path), *args]) == 0
    read = read_material(str(tmp_path / "b.json"))
    assert read.name == "some" and read.model == pf.Phong(gate=False)
    assert read.material.shininess == 10 and read.material.diffuse == 0.5
    # What others get is Blinn's.
    assert main(["export", str(path), "--to", "mtl", "-o", f"{tmp_path}/b.mtl"]) == 0
    assert pf.read_mtl(tmp_path / "b.mtl")["some"].shininess == 40


def test_one_of_several_in_a_library(tmp_path, capsys):
    path = tmp_path / "two.mtl"
    pf.write_mtl(path, {"a": pf.preset("gold"), "b c": BRASS})
    assert read_material(f"{path}:b c").name == "b c"
    assert main(["export", str(path), "--to", "json", "-o", f"{tmp_path}/x.json"]) == 2
    assert said(
        f"{path}: expected one of its materials ... got none", capsys.readouterr().err
    )
    with pytest.raises(ValueError, match="expected one of its materials .*got 'd'"):
        read_material(f"{path}:d")


@pytest.mark.parametrize(
    "to, words",
    [
        ("opengl", "shininess: OpenGL holds at most 128, got 5000"),
        ("mtl", "shininess: .mtl holds at most 1000, got 5000"),
        ("gltf", "diffuse: glTF holds at most 1, got 2"),
    ],
)
def test_what_a_format_cannot_hold(tmp_path, capsys, refused, to, words):
    path, out = tmp_path / "bright.json", tmp_path / f"out.{to.replace('gltf', 'glb')}"
    leaves = (2.0, 0.5, 32.0) if to == "gltf" else (0.5, 0.5, 5000.0)
    write_material(path, "bright", pf.Material(*leaves), pf.BlinnPhong())
    args = ["export", str(path), "--to", to, "-o", str(out)]
    output = refused(*args)
    assert said(words, output) and not out.exists()
    assert "(--nearest takes the nearest that it holds)" in output
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert main([*args, "--nearest"]) == 0
    told = capsys.readouterr().err
    assert told.startswith(f"warning: {words}; the nearest is taken. Export ")
    assert (
        told.endswith(" [nearest-taken]\n") and told.count("\n") == 1 and out.exists()
    )


@pytest.mark.parametrize(
    "args, words",
    [
        (
            ["preset:gold", "--to", "gltf", "-o", "a.obj"],
            "expected suffix .glb ... got '.obj'",
        ),
        (
            ["nothing", "--to", "mtl", "-o", "a.mtl"],
            "material: expected ... got 'nothing'",
        ),
        (
            [".", "--to", "mtl", "-o", "a.mtl"],
            "holds neither a fit.json nor a maps.json",
        ),
        (["preset:gold", "-o", "a.xyz"], "out: expected a name that ends in ... a.xyz"),
        (
            ["preset:gold", "--to", "mtl", "-o", "a", "--scene", "s"],
            "mtl holds no shape",
        ),
        (["preset:gold", "--to", "png", "-o", "a"], "--to"),
    ],
)
def test_bad_options(tmp_path, monkeypatch, refused, args, words):
    monkeypatch.chdir(tmp_path)
    assert said(words, refused("export", *args))
    assert not list(tmp_path.iterdir())
