"""Scenes as OpenGL's state, both ways."""

from typing import Any

import equinox as eqx
import numpy as np
import pytest

import phongfit as pf
from experiments.opengl_scene import (
    camera_to_opengl,
    scene_from_opengl,
    scene_to_opengl,
    shading_from_opengl,
    shading_to_opengl,
)
from experiments.opengl_state import light_from_opengl, light_to_opengl
from tests.helpers import floats, near

BOX = pf.shapes.plane().mesh(1, 1)
VIEW = pf.PerspectiveCamera()


def test_what_opengl_takes_for_granted():
    dull = scene_from_opengl(BOX, VIEW, {})
    near(dull.ambient, 0.2)
    assert dull.lights == () and dull.shading == pf.GouraudShading(clamp=True)
    assert dull.local_viewer is False and dull.fog is None


@pytest.mark.parametrize(
    "call, named",
    [
        (lambda: shading_from_opengl("GL_PHONG"), "shade_model: expected GL_FLAT or"),
        (lambda: scene_from_opengl(BOX, VIEW, {"sun": 1}), "state: it has no sun"),
        (
            lambda: scene_from_opengl(BOX, VIEW, {"light_model": {"GL_FOG": 1}}),
            "light_model: it has no GL_FOG",
        ),
    ],
)
def test_bad_parameters(call, named):
    with pytest.raises(ValueError, match=f"^{named}"):
        call()


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
    given = scene().lights[0]
    assert eqx.tree_equal(
        light_from_opengl(state["lights"][0]), light_from_opengl(light_to_opengl(given))
    )
    again = scene_from_opengl(BOX, pf.PerspectiveCamera(), state)
    assert scene_to_opengl(again) == state
    # An orthographic camera has parallel rays, as OpenGL's viewer has by default.
    flat = eqx.tree_at(lambda s: s.camera, scene(), pf.OrthographicCamera())
    assert scene_to_opengl(flat)["light_model"]["GL_LIGHT_MODEL_LOCAL_VIEWER"] is False


@pytest.mark.parametrize(
    "named, keywords",
    [
        ("specular_model", dict(specular_model=pf.Phong())),
        ("specular_model", dict(specular_model=pf.BlinnPhong(normalized=True))),
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
    with pytest.raises(
        ValueError, match="^lights: expected at most 8, as OpenGL has, got 9"
    ):
        scene_to_opengl(many, nearest=True)
