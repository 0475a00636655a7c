"""Bad input, as a table: every error names the argument."""

import equinox as eqx
import jax
import numpy as np
import pytest

import phongfit as pf
from phongfit.geometry.cameras import look_at
from phongfit.rendering.film import Film
from tests.helpers import floats

NAN, INF = float("nan"), float("inf")
FLAT = np.broadcast_to([0.0, 0.0, 1.0], (4, 5, 3))


def spot(**changes):
    return pf.SpotLight(**dict(position=(0, 0, 1), axis=(0, 0, -1)) | changes)


def sun(**changes):
    return pf.DirectionalLight(**dict(direction=(0, 0, 1)) | changes)


def bulb(**changes):
    return pf.PointLight(**dict(position=(0, 0, 1)) | changes)


def normal_map(**changes):
    return pf.NormalMap(**dict(normals=FLAT) | changes)


def view(**changes):
    return look_at(**dict(position=(0, 0, 5), target=(0, 0, 0)) | changes)


def at(array, place, value):
    changed = np.array(array, float)
    changed[place] = value
    return changed


# What is made, the argument, and values that it must refuse.
REFUSED = [
    (pf.Material, "diffuse", [-0.1, NAN, INF, (0.1, 0.2), (), "red", None, 1j]),
    (pf.Material, "specular", [-0.1, (0.1, NAN, 0.1), np.ones((3, 4)), [[1, 2], [3]]]),
    (pf.Material, "shininess", [-1, INF, [1, 2], {}, np.ma.masked_equal(3.0, 3)]),
    (pf.Material, "ambient", [-1e-6, NAN, object()]),
    (pf.Material, "emission", [-1, INF]),
    (sun, "direction", [(0, 0, 0), (0, 1), (NAN, 0, 1), 1, "up", np.ones((1, 3))]),
    (sun, "direction", [(1e-200, 0, 0), (1e200, 0, 0)]),
    (sun, "intensity", [-1, (1, 1, -1), (1, 2), NAN, "bright"]),
    (sun, "specular", [-1, (1, 1, 1, 1)]),
    (sun, "ambient", [-1, INF]),
    (bulb, "position", [(0, 0), (0, INF, 0), None]),
    (bulb, "intensity", [(-1, 0, 0), NAN]),
    (bulb, "attenuation", [(0, 0, 0), (1, -1, 0), (1, 0), 1, (NAN, 0, 0)]),
    (bulb, "specular", [-1]),
    (bulb, "ambient", [-1]),
    (spot, "position", [(0, NAN, 0), 3]),
    (spot, "axis", [(0, 0, 0), (0, 0, NAN), (1, 1)]),
    (spot, "cutoff", [0, -1, 90.1, NAN, (30, 40)]),
    (spot, "exponent", [-1, INF, (1, 2)]),
    (spot, "intensity", [-1]),
    (spot, "attenuation", [(0, 0, 0)]),
    (pf.Sphere, "center", [(0, 0), (NAN, 0, 0), "here"]),
    (pf.Sphere, "radius", [0, -1, NAN, INF, (1, 2)]),
    (normal_map, "normals", [np.ones((4, 3)), np.ones((4, 5, 2)), at(FLAT, 0, NAN)]),
    (normal_map, "normals", [at(FLAT, (1, 1, 1), INF), "map"]),
    (normal_map, "mask", [np.ones((5, 4), bool), True, "mask"]),
    (normal_map, "positions", [np.ones((4, 5)), at(FLAT, 0, NAN)]),
    (pf.OrthographicCamera, "width", [0, -1, 2.5, "4", True]),
    (pf.OrthographicCamera, "height", [0, None]),
    (pf.OrthographicCamera, "view_height", [0, -1, NAN, INF]),
    (pf.OrthographicCamera, "position", [(0, 0), (0, 0, NAN)]),
    (pf.OrthographicCamera, "rotation", [np.eye(4), 2 * np.eye(3), NAN * np.eye(3)]),
    (pf.OrthographicCamera, "rotation", [np.diag([-1.0, 1, 1]), np.zeros((3, 3))]),
    (pf.PerspectiveCamera, "width", [0, 1.5]),
    (pf.PerspectiveCamera, "height", [0]),
    (pf.PerspectiveCamera, "fov_y", [0, 180, -1, NAN]),
    (pf.PerspectiveCamera, "position", [1]),
    (pf.PerspectiveCamera, "rotation", [np.ones((3, 3))]),
    (view, "position", [(0, 0, 0), (0, 0), (0, 0, NAN)]),
    (view, "target", [(0,), (0, INF, 0)]),
    (view, "up", [(0, 0, 0), (0, 0, 1), (0, 0, -3), (0, 1)]),
    (Film, "encoding", ["sRGB", None, 2.2, ["srgb"]]),
    (Film, "bits", [0, 17, 8.0, True, "8", np.array([8, 8])]),
]
ROWS = [(make, name, value) for make, name, values in REFUSED for value in values]


@pytest.mark.parametrize("make, name, value", ROWS)
def test_refused(make, name, value):
    with pytest.raises(ValueError, match=f"^{name}: "):
        make(**{name: value})


@pytest.mark.parametrize("film", [dict(bits=8), dict(encoding="srgb")])
def test_a_film_that_stores_must_clamp(film):
    with pytest.raises(ValueError, match="^clamp: "):
        Film(clamp=False, **film)


# Inside jit the value is not known when the shapes are checked.
TRACED = [
    (pf.Material, "diffuse", -0.1),
    (pf.Material, "shininess", NAN),
    (sun, "direction", (0, 0, 0)),
    (sun, "intensity", (1, -1, 1)),
    (bulb, "position", (NAN, 0, 0)),
    (bulb, "attenuation", (0, 0, 0)),
    (spot, "axis", (0, 0, 0)),
    (spot, "cutoff", 91),
    (spot, "exponent", -1),
    (pf.Sphere, "radius", 0),
    (normal_map, "normals", at(FLAT, 0, NAN)),
    (normal_map, "positions", at(FLAT, 0, INF)),
    (pf.OrthographicCamera, "view_height", 0),
    (pf.OrthographicCamera, "rotation", np.diag([1, 1, -1])),
    (pf.PerspectiveCamera, "fov_y", 180),
    (view, "position", (0, 0, 0)),
    (view, "up", (0, 0, 1)),
]


@pytest.mark.parametrize("make, name, value", TRACED)
def test_refused_inside_jit(make, name, value):
    @eqx.filter_jit
    def traced(value):
        return jax.tree.leaves(make(**{name: value}))

    with pytest.raises(eqx.EquinoxRuntimeError, match=f"{name}: expected"):
        jax.block_until_ready(traced(floats(value)))


def test_good_values_pass_inside_jit():
    @jax.jit
    def traced(direction):
        return sun(direction=direction).direction, view(position=direction)

    direction, _ = traced(floats([1.0, 2.0, 3.0]))
    assert np.all(np.asarray(direction) == [1, 2, 3])


def test_numbers_of_other_kinds_become_floats():
    for value in (1, True, np.float16(1), np.int8(1), [1]):
        assert pf.Material(diffuse=value).diffuse.dtype == floats(0).dtype
