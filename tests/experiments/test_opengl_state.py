import json
from pathlib import Path

import jax
import numpy as np
import pytest

import phongfit as pf
from experiments.opengl_state import (
    fog_from_opengl,
    fog_to_opengl,
    light_from_opengl,
    light_to_opengl,
    material_from_opengl,
)
from phongfit.files.opengl import material_to_opengl
from tests.helpers import near


class Glow(pf.AbstractLight):
    """Light from everywhere."""

    def illuminate(self, position):
        raise NotImplementedError


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
            "shininess: OpenGL holds at most 128, got 600",
            "GL_SHININESS",
            128,
        ),
        (
            pf.Material(shininess=(16, 32, 64)),
            "shininess: OpenGL holds one .*got 16, 32, 64",
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
    with pytest.raises(ValueError, match="^diffuse: expected one material, got shape"):
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
        ValueError, match="^exponent: OpenGL holds at most 128, got 200"
    ):
        light_to_opengl(light)
    with pytest.warns(UserWarning, match="exponent: OpenGL holds at most 128, got 200"):
        assert light_to_opengl(light, nearest=True)["GL_SPOT_EXPONENT"] == 128


@pytest.mark.parametrize("mode", ["linear", "exp", "exp2"])
def test_fog(mode):
    fog = pf.Fog((0.1, 0.2, 0.3), mode, density=0.4, start=1, end=9)
    parameters = fog_to_opengl(fog)
    assert parameters is not None
    assert parameters["GL_FOG_MODE"] == f"GL_{mode.upper()}"
    same(fog_from_opengl(parameters), fog)
    assert fog_to_opengl(None) is None and fog_from_opengl(None) is None


@pytest.mark.parametrize(
    "call, named",
    [
        (
            lambda: material_from_opengl({"GL_POSITION": 1}),
            "material: it has no GL_POS",
        ),
        (lambda: light_from_opengl({"GL_SHININESS": 1}), "light: it has no GL_SHIN"),
        (
            lambda: light_from_opengl({"GL_POSITION": (1, 2, 3)}),
            "GL_POSITION: expected shape",
        ),
        (lambda: light_from_opengl({"GL_SPOT_CUTOFF": 30}), "GL_SPOT_CUTOFF: "),
        (lambda: light_from_opengl({"GL_DIFFUSE": (-1, 0, 0)}), "intensity: "),
        (
            lambda: fog_from_opengl({"GL_FOG_MODE": "exp"}),
            "GL_FOG_MODE: expected.*got 'exp'",
        ),
        (lambda: fog_from_opengl({"start": 1}), "fog: it has no start"),
        (lambda: fog_to_opengl(pf.Fog(2)), "color: OpenGL holds at most 1, got 2"),
        (lambda: light_to_opengl(Glow()), "light: OpenGL has no Glow"),
    ],
)
def test_bad_parameters(call, named):
    with pytest.raises(ValueError, match=f"^{named}"):
        call()


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
