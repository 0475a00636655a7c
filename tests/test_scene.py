import jax
import numpy as np
import pytest

import phongfit as pf
from tests.helpers import near

FLAT = np.broadcast_to([0.0, 0.0, 1.0], (4, 5, 3))
SUN = pf.DirectionalLight((0, 0, 1))
BULB = pf.PointLight((0, 0, 3))


def test_defaults():
    scene = pf.Scene(pf.Sphere())
    assert (scene.camera.width, scene.camera.height) == (256, 256)
    assert isinstance(scene.camera, pf.OrthographicCamera)
    assert scene.lights == ()
    assert isinstance(scene.specular_model, pf.BlinnPhong)
    near(scene.ambient, [0, 0, 0])
    near(scene.background, [0, 0, 0])


def test_one_number_is_grey_and_one_light_is_a_list():
    scene = pf.Scene(pf.Sphere(), lights=SUN, ambient=0.3, background=0.1)
    assert scene.lights == (SUN,)
    near(scene.ambient, [0.3] * 3)
    near(scene.background, [0.1] * 3)


def test_lights_may_be_any_iterable():
    scene = pf.Scene(pf.Sphere(), lights=(light for light in [SUN, BULB]))
    assert [type(light) for light in scene.lights] == [
        pf.DirectionalLight,
        pf.PointLight,
    ]


def test_a_scene_is_a_pytree():
    scene = pf.Scene(pf.Sphere(), lights=[SUN, BULB])
    again = jax.tree.map(lambda leaf: leaf, scene)
    assert jax.tree.structure(again) == jax.tree.structure(scene)


@pytest.mark.parametrize(
    "arguments, name",
    [
        (dict(surface="ball"), "surface"),
        (dict(surface=SUN), "surface"),
        (dict(camera=pf.Sphere()), "camera"),
        (dict(camera=256), "camera"),
        (dict(lights=5), "lights"),
        (dict(lights=None), "lights"),
        (dict(lights=[SUN, "lamp"]), "lights"),
        (dict(lights="lamp"), "lights"),
        (dict(lights=[pf.Sphere()]), "lights"),
        (dict(specular_model="blinn"), "specular_model"),
        (dict(specular_model=pf.BlinnPhong), "specular_model"),
        (dict(ambient=-0.1), "ambient"),
        (dict(ambient=(0.1, 0.2)), "ambient"),
        (dict(ambient=float("nan")), "ambient"),
        (dict(background=-1), "background"),
        (dict(background="black"), "background"),
        (dict(surface=pf.NormalMap(FLAT), lights=[SUN, BULB]), "lights"),
        (
            dict(surface=pf.NormalMap(FLAT), lights=pf.SpotLight((0, 0, 1), (0, 0, 1))),
            "lights",
        ),
    ],
)
def test_errors_name_the_argument(arguments, name):
    with pytest.raises(ValueError, match=f"^{name}: "):
        pf.Scene(**{"surface": pf.Sphere()} | arguments)


def test_a_normal_map_with_positions_takes_every_light():
    surface = pf.NormalMap(FLAT, positions=np.zeros((4, 5, 3)))
    assert len(pf.Scene(surface, lights=[SUN, BULB]).lights) == 2
