import json
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest

import phongfit as pf
from phongfit.files.opengl import (
    fog_from_opengl,
    fog_to_opengl,
    light_from_opengl,
    light_to_opengl,
    material_from_opengl,
    material_to_opengl,
)
from phongfit.files.opengl_scene import (
    camera_to_opengl,
    scene_from_opengl,
    scene_to_opengl,
    shading_from_opengl,
    shading_to_opengl,
)
from tests.helpers import floats, near


class Glow(pf.AbstractLight):
    """Light from everywhere."""

    def illuminate(self, position):
        raise NotImplementedError


BOX = pf.shapes.plane().mesh(1, 1)
VIEW = pf.PerspectiveCamera()
COLOURS = dict(specular=(0.1, 0.2, 0.3), ambient=(0.01, 0.02, 0.03))


def same(one, other):
    assert type(one) is type(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        near(a, b)


def test_a_material():
    material = pf.Material(
        (0.1, 0.2, 0.3), (0.4, 0.5, 0.6), 50, (0.7, 0.8, 0.9), (0, 0, 1)
    )
    parameters = material_to_opengl(material)
    assert list(parameters) == [
        "GL_AMBIENT",
        "GL_DIFFUSE",
        "GL_SPECULAR",
        "GL_EMISSION",
        "GL_SHININESS",
    ]
    near(parameters["GL_AMBIENT"], (0.7, 0.8, 0.9, 1))
    near(parameters["GL_DIFFUSE"], (0.1, 0.2, 0.3, 1))
    near(parameters["GL_SPECULAR"], (0.4, 0.5, 0.6, 1))
    near(parameters["GL_EMISSION"], (0, 0, 1, 1))
    assert parameters["GL_SHININESS"] == 50.0
    same(material_from_opengl(parameters), material)
    # Plain numbers, as JSON and PyOpenGL take them.
    assert json.loads(json.dumps(parameters)) == parameters
    near(material_to_opengl(pf.Material(0.5))["GL_DIFFUSE"], (0.5, 0.5, 0.5, 1))


def test_what_opengl_takes_for_granted():
    dull = scene_from_opengl(BOX, VIEW, {})
    near(dull.ambient, 0.2)
    assert dull.lights == () and dull.shading == pf.GouraudShading(clamp=True)
    assert dull.local_viewer is False and dull.fog is None
    same(
        material_from_opengl({}),
        pf.Material((0.8,) * 3, (0,) * 3, 0, (0.2,) * 3, (0,) * 3),
    )
    both = material_from_opengl({"GL_AMBIENT_AND_DIFFUSE": (0.1, 0.2, 0.3, 1)})
    near(both.ambient, (0.1, 0.2, 0.3))
    near(both.diffuse, (0.1, 0.2, 0.3))
    same(light_from_opengl({}), pf.DirectionalLight((0, 0, 1), specular=(1, 1, 1)))
    same(fog_from_opengl({}), pf.Fog(0, "exp", density=1, start=0, end=1))


@pytest.mark.parametrize(
    "material, said, leaf, taken",
    [
        (
            pf.Material(shininess=600),
            "shininess: 600 came, OpenGL holds at most 128",
            "GL_SHININESS",
            128,
        ),
        (
            pf.Material(shininess=(16, 32, 64)),
            "shininess: 16, 32, 64 came, OpenGL holds one",
            "GL_SHININESS",
            32,
        ),
    ],
)
def test_a_material_out_of_range(material, said, leaf, taken):
    with pytest.raises(ValueError, match=f"^{said}.*nearest=True"):
        material_to_opengl(material)
    with pytest.warns(UserWarning, match=said):
        near(material_to_opengl(material, nearest=True)[leaf], taken, 1e-6)


@pytest.mark.parametrize("shape", [(2, 3), (4, 5, 3)])
def test_one_material_at_a_time(shape):
    with pytest.raises(ValueError, match="^diffuse: shape .* that of one material"):
        material_to_opengl(pf.Material(diffuse=np.zeros(shape)), nearest=True)


@pytest.mark.parametrize(
    "light, names",
    [
        (pf.DirectionalLight((1, 2, 3), 0.5, **COLOURS), 4),
        (pf.PointLight((1, 2, 3), 0.5, attenuation=(1, 0.2, 0.3), **COLOURS), 7),
        (
            pf.SpotLight(
                (1, 2, 3),
                (0, -1, 0.5),
                (0.5, 0.6, 0.7),
                cutoff=30,
                exponent=4,
                attenuation=(0, 0, 1),
                **COLOURS,
            ),
            10,
        ),
    ],
)
def test_a_light(light, names):
    parameters = light_to_opengl(light)
    assert len(parameters) == names
    near(parameters["GL_POSITION"], (1, 2, 3, 0 if names == 4 else 1))
    near(parameters["GL_AMBIENT"], (0.01, 0.02, 0.03, 1))
    near(parameters["GL_SPECULAR"], (0.1, 0.2, 0.3, 1))
    same(light_from_opengl(parameters), light)
    assert json.loads(json.dumps(parameters)) == parameters


def test_a_light_without_a_colour_of_its_own_shines_in_one():
    near(
        light_to_opengl(pf.PointLight((0, 0, 0), 0.5))["GL_SPECULAR"],
        (0.5, 0.5, 0.5, 1),
    )


def test_w_is_divided_out():
    light = light_from_opengl({"GL_POSITION": (2, 4, 6, 2)})
    assert isinstance(light, pf.PointLight)
    near(light.position, (1, 2, 3))


def test_a_sharp_spot_is_out_of_range():
    light = pf.SpotLight((0, 0, 1), (0, 0, -1), exponent=200)
    with pytest.raises(
        ValueError, match="^exponent: 200 came, OpenGL holds at most 128"
    ):
        light_to_opengl(light)
    with pytest.warns(UserWarning, match="exponent: 200 came"):
        assert light_to_opengl(light, nearest=True)["GL_SPOT_EXPONENT"] == 128


@pytest.mark.parametrize("mode", ["linear", "exp", "exp2"])
def test_fog(mode):
    fog = pf.Fog((0.1, 0.2, 0.3), mode, density=0.4, start=1, end=9)
    parameters = fog_to_opengl(fog)
    assert parameters is not None
    assert parameters["GL_FOG_MODE"] == f"GL_{mode.upper()}"
    same(fog_from_opengl(parameters), fog)
    assert fog_to_opengl(None) is None and fog_from_opengl(None) is None


@pytest.mark.parametrize("clamp", [True, False])
@pytest.mark.parametrize("name", ["GL_FLAT", "GL_SMOOTH"])
def test_shade_model(name, clamp):
    shading = shading_from_opengl(name, clamp)
    assert shading_to_opengl(shading) == name and shading.clamp is clamp


@pytest.mark.parametrize(
    "shading, nearest",
    [(pf.PhongShading(), "GL_SMOOTH"), (pf.FlatShading(), "GL_FLAT")],
)
def test_shading_that_opengl_does_not_have(shading, nearest):
    with pytest.raises(ValueError, match="^shading: OpenGL "):
        shading_to_opengl(shading)
    with pytest.warns(UserWarning, match="shading: OpenGL "):
        assert shading_to_opengl(shading, nearest=True) == nearest


@pytest.mark.parametrize(
    "call, named",
    [
        (
            lambda: material_from_opengl({"GL_POSITION": 1}),
            "material: it has no GL_POS",
        ),
        (lambda: light_from_opengl({"GL_SHININESS": 1}), "light: it has no GL_SHIN"),
        (lambda: light_from_opengl({"GL_POSITION": (1, 2, 3)}), "GL_POSITION: shape"),
        (lambda: light_from_opengl({"GL_SPOT_CUTOFF": 30}), "GL_SPOT_CUTOFF: "),
        (lambda: light_from_opengl({"GL_DIFFUSE": (-1, 0, 0)}), "intensity: "),
        (lambda: fog_from_opengl({"GL_FOG_MODE": "exp"}), "GL_FOG_MODE: 'exp' came"),
        (lambda: fog_from_opengl({"start": 1}), "fog: it has no start"),
        (lambda: shading_from_opengl("GL_PHONG"), "shade_model: 'GL_PHONG'"),
        (lambda: scene_from_opengl(BOX, VIEW, {"sun": 1}), "state: it has no sun"),
        (
            lambda: scene_from_opengl(BOX, VIEW, {"light_model": {"GL_FOG": 1}}),
            "light_model: it has no GL_FOG",
        ),
        (lambda: fog_to_opengl(pf.Fog(2)), "color: 2 came"),
        (lambda: light_to_opengl(Glow()), "light: OpenGL has no Glow"),
    ],
)
def test_bad_parameters(call, named):
    with pytest.raises(ValueError, match=f"^{named}"):
        call()


@pytest.mark.parametrize(
    "camera",
    [
        pf.PerspectiveCamera.look_at((1, 2, 3), width=40, height=20, fov_y=50),
        pf.OrthographicCamera.look_at((1, 2, 3), width=40, height=20, view_height=3),
    ],
)
def test_matrices_send_a_pixels_ray_to_that_pixel(camera):
    projection, modelview = camera_to_opengl(camera, 0.5, 20)
    for x, y in ((0.5, 0.5), (39.5, 0.5), (13.5, 17.5)):
        ray = camera.ray(floats(x), floats(y))
        point = np.append(np.asarray(ray.origin + 4 * ray.direction, float), 1)
        clip = projection @ modelview @ point
        device = clip[:3] / clip[3]
        near(device[0], 2 * x / 40 - 1, 1e-5)
        near(device[1], 1 - 2 * y / 20, 1e-5)
    for depth, expected in ((0.5, -1), (20, 1)):
        clip = projection @ np.array([0, 0, -depth, 1])
        near(clip[2] / clip[3], expected)


def scene(**keywords):
    options: dict[str, Any] = dict(shading=pf.GouraudShading(clamp=True)) | keywords
    return pf.Scene(
        BOX, pf.PerspectiveCamera(), pf.PointLight((1, 2, 3)), 0.2, **options
    )


def test_a_scene():
    state = scene_to_opengl(scene(fog=pf.Fog(0.5), background=(0.1, 0.2, 0.3)))
    assert state["light_model"]["GL_LIGHT_MODEL_LOCAL_VIEWER"] is True
    near(state["light_model"]["GL_LIGHT_MODEL_AMBIENT"], (0.2, 0.2, 0.2, 1))
    assert state["shade_model"] == "GL_SMOOTH" and state["clamp_vertex_color"]
    assert state["fog"]["GL_FOG_MODE"] == "GL_EXP"
    near(state["background"], (0.1, 0.2, 0.3))
    same(
        light_from_opengl(state["lights"][0]),
        light_from_opengl(light_to_opengl(scene().lights[0])),
    )
    again = scene_from_opengl(BOX, pf.PerspectiveCamera(), state)
    assert scene_to_opengl(again) == state
    # An orthographic camera has parallel rays, as OpenGL's viewer has by default.
    flat = eqx.tree_at(lambda s: s.camera, scene(), pf.OrthographicCamera())
    assert scene_to_opengl(flat)["light_model"]["GL_LIGHT_MODEL_LOCAL_VIEWER"] is False


@pytest.mark.parametrize(
    "named, keywords",
    [
        ("specular", dict(specular=pf.Phong())),
        ("specular", dict(specular=pf.BlinnPhong(normalized=True))),
        ("shadows", dict(shadows=True)),
        ("shading", dict(shading=pf.PhongShading())),
        ("background", dict(background=2)),
        ("color", dict(fog=pf.Fog(1.5))),
    ],
)
def test_a_scene_out_of_range(named, keywords):
    with pytest.raises(ValueError, match=f"^{named}: "):
        scene_to_opengl(scene(**keywords))
    with pytest.warns(UserWarning, match=f"{named}: .*the nearest is taken"):
        scene_to_opengl(scene(**keywords), nearest=True)


def test_at_most_eight_lights():
    light = pf.PointLight((1, 2, 3))
    many = pf.Scene(BOX, lights=[light] * 9, shading=pf.GouraudShading())
    with pytest.raises(ValueError, match="^lights: 9 came, OpenGL has 8"):
        scene_to_opengl(many, nearest=True)


def test_the_reference_scenes_survive_a_round_trip():
    folder = Path(__file__).parents[1] / "data" / "references" / "opengl"
    for path in sorted(folder.glob("*.json")):
        said = json.loads(path.read_text())
        material = said["material"]
        again = material_to_opengl(material_from_opengl(material))
        for name, value in material.items():
            near(again[name], value, 1e-6)
        for light in said["lights"]:
            again = light_to_opengl(light_from_opengl(light))
            for name, value in light.items():
                near(again[name], value, 1e-6)
