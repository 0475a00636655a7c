import jax
import numpy as np
import pytest

import phongfit as pf
from phongfit.fitting.problem.parameters import DEFAULT_BOUNDS, MATERIAL_PARAMETERS
from tests.fitting.scenes import unknowns_of
from tests.helpers import floats, near

KNOWN = pf.Material(0.1, (0.2, 0.3, 0.4), 50.0, 0.5, 0.6)


def test_labels_and_order():
    layout = unknowns_of(
        ("shininess", "specular", "ambient"), ("ambient", "shininess"), KNOWN, {}
    )
    assert layout.labels == (
        *("ambient.red", "ambient.green", "ambient.blue"),
        "specular",
        *("shininess.red", "shininess.green", "shininess.blue"),
    )
    assert layout.lower.shape == layout.upper.shape == (7,)
    assert np.array_equal(layout.logarithmic, [False] * 4 + [True] * 3)


def test_leaves_from_a_vector():
    layout = unknowns_of(("diffuse", "shininess"), ("diffuse",), KNOWN, {})
    material = layout.material(floats([0.7, 0.8, 0.9, np.log(20)]))
    near(material.diffuse, [0.7, 0.8, 0.9])
    near(material.shininess, 20, 1e-6)
    assert material.shininess.shape == ()
    # The rest is what was known.
    near(material.specular, KNOWN.specular)
    near(material.ambient, 0.5)
    near(material.emission, 0.6)


@pytest.mark.parametrize("name", MATERIAL_PARAMETERS)
@pytest.mark.parametrize("size", [1, 3])
def test_every_leaf(name, size):
    layout = unknowns_of((name,), (name,) if size == 3 else (), KNOWN, {})
    assert len(layout.labels) == size
    vector = layout.lower + floats(np.linspace(0.1, 0.2, size))
    leaf = np.atleast_1d(getattr(layout.material(vector), name))
    near(leaf, layout.values(vector), 1e-6)
    for other in set(MATERIAL_PARAMETERS) - {name}:
        near(getattr(layout.material(vector), other), getattr(KNOWN, other))
    (low, high), *_ = layout.bounds
    assert (low, high) == DEFAULT_BOUNDS[name]


def test_bounds_are_told_as_they_were_given():
    given = {"shininess": (2, 300), "diffuse": (-0.25, np.inf), "ambient": (0.1, 0.7)}
    layout = unknowns_of(
        ("ambient", "diffuse", "shininess"), ("diffuse",), KNOWN, given
    )
    expected = [(0.1, 0.7)] + [(-0.25, np.inf)] * 3 + [(2, 300)]
    assert np.array_equal(layout.bounds, expected)
    near(layout.lower, [0.1, -0.25, -0.25, -0.25, np.log(2)])


def test_bounds_of_what_is_known_are_allowed():
    layout = unknowns_of(("diffuse",), (), KNOWN, {"shininess": (1, 9)})
    assert layout.labels == ("diffuse",)


def test_it_is_differentiable():
    layout = unknowns_of(("specular", "shininess"), (), KNOWN, {})

    def product(y):
        material = layout.material(y)
        return material.specular * material.shininess

    slopes = jax.grad(product)(floats([0.5, np.log(10)]))
    near(slopes, [10, 5], 1e-5)


def test_several_materials():
    layout = unknowns_of(("diffuse", "shininess"), ("diffuse",), KNOWN, {}, materials=2)
    assert layout.labels == (
        *("diffuse[0].red", "diffuse[0].green", "diffuse[0].blue"),
        *("diffuse[1].red", "diffuse[1].green", "diffuse[1].blue"),
        *("shininess[0]", "shininess[1]"),
    )
    vector = floats([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, np.log(10), np.log(100)])
    material = layout.material(vector)
    near(material.diffuse, [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    near(material.shininess, [[10], [100]], 1e-5)
    assert np.array_equal(layout.y_material, [0, 0, 0, 1, 1, 1, 0, 1])
    assert np.array_equal(layout.y_channel, [0, 1, 2, 0, 1, 2, -1, -1])
