import jax
import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.material import PRESETS
from tests.helpers import eps, floats, near

# Some rows of the table, as they stand in it: ambient, diffuse, specular, shininess.
CLASSICS = {
    "emerald": (
        (0.0215, 0.1745, 0.0215),
        (0.07568, 0.61424, 0.07568),
        (0.633, 0.727811, 0.633),
        76.8,
    ),
    "gold": (
        (0.24725, 0.1995, 0.0745),
        (0.75164, 0.60648, 0.22648),
        (0.628281, 0.555802, 0.366065),
        51.2,
    ),
    "brass": (
        (0.329412, 0.223529, 0.027451),
        (0.780392, 0.568627, 0.113725),
        (0.992157, 0.941176, 0.807843),
        27.897436,
    ),
    "red_plastic": ((0, 0, 0), (0.5, 0, 0), (0.7, 0.6, 0.6), 32.0),
    "cyan_rubber": ((0, 0.05, 0.05), (0.4, 0.5, 0.5), (0.04, 0.7, 0.7), 10.0),
}
METALS = ("brass", "bronze", "chrome", "copper", "gold", "silver")
GEMS = ("emerald", "jade", "obsidian", "pearl", "ruby", "turquoise")
COLOURS = ("black", "cyan", "green", "red", "white", "yellow")


@pytest.mark.parametrize("name", CLASSICS)
def test_classic_materials(name):
    material, (ambient, diffuse, specular, shininess) = pf.preset(name), CLASSICS[name]
    near(material.ambient, ambient, eps())
    near(material.diffuse, diffuse, eps())
    near(material.specular, specular, eps())
    near(material.shininess, shininess, eps())
    near(material.emission, 0)


def test_all_24_are_there():
    made = [f"{colour}_{of}" for of in ("plastic", "rubber") for colour in COLOURS]
    assert sorted(PRESETS) == sorted([*METALS, *GEMS, *made])
    for name in PRESETS:
        material = pf.preset(name)
        for leaf in (material.ambient, material.diffuse, material.specular):
            assert leaf.shape == (3,) and np.all(leaf >= 0) and np.all(leaf <= 1)
        assert material.shininess.shape == ()
        assert 10 <= material.shininess <= 76.81


@pytest.mark.parametrize("name", ["Red Plastic", "red-plastic", " RED_PLASTIC "])
def test_a_preset_by_another_spelling(name):
    near(pf.preset(name).diffuse, [0.5, 0, 0])


@pytest.mark.parametrize(
    "name, hint",
    [
        ("bras", "did you mean 'brass'"),
        ("quux", "emerald, jade"),
        (3, "expected text, got 3"),
    ],
)
def test_no_such_preset(name, hint):
    with pytest.raises(ValueError, match=f"^name: .*{hint}"):
        pf.preset(name)


def test_leaves_keep_their_shape():
    material = pf.Material(
        diffuse=(0.1, 0.2, 0.3),
        specular=0.5,
        shininess=[[1.0], [2.0]],
        ambient=np.zeros((4, 5, 3)),
        emission=1,
    )
    shapes = ((3,), (), (2, 1), (4, 5, 3), ())
    leaves = (
        material.diffuse,
        material.specular,
        material.shininess,
        material.ambient,
        material.emission,
    )
    for leaf, shape in zip(leaves, shapes, strict=True):
        assert leaf.shape == shape
        assert leaf.dtype == jnp.result_type(float)


def test_defaults_are_matte():
    material = pf.Material()
    near(material.specular, 0)
    near(material.emission, 0)
    assert floats(0) < material.diffuse <= 1


@pytest.mark.parametrize(
    "material, words",
    [
        (
            pf.Material((0.6, 0.3, 0.25), 1 / 3, 20.0, 0.5),
            "Material(diffuse=(0.6, 0.3, 0.25), specular=0.3333, shininess=20, "
            "ambient=0.5, emission=0)",
        ),
        (pf.Material(np.full((4, 3), 0.1)), "Material(diffuse=f*[4,3], specular=0,"),
        (jax.tree.map(lambda _: None, pf.Material()), "Material(diffuse=None,"),
    ],
)
def test_it_is_written_in_numbers(material, words):
    text = str(material).replace("f32[", "f*[").replace("f64[", "f*[")
    assert text.startswith(words) and repr(material) == str(material)


def test_it_is_written_under_jit_as_well():
    def shape(material):
        assert "diffuse=f" in str(material)
        return material.diffuse

    jax.jit(shape)(pf.Material())
