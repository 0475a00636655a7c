"""Derivatives of the image in every leaf, to second order, at the awkward points too.

Where the picture itself has a kink or a jump (the horizon, the clamp), there is nothing
for finite differences to find: there both modes must be finite and agree, and finite
differences are compared a little to either side.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.rendering.film import Film
from phongfit.rendering.terms import combine, point_terms
from phongfit.testing import check_gradients
from tests.helpers import floats

COLOURS = dict(specular=(0.9, 0.8, 0.7), ambient=(0.02, 0.01, 0.03))
SUN = pf.DirectionalLight((1, 1, 2), (0.5, 0.4, 0.3), **COLOURS)
BULB = pf.PointLight((-2, 1, 3), (0.4, 0.5, 0.6), attenuation=(1, 0.1, 0.02), **COLOURS)
SPOT = pf.SpotLight(
    (1.5, -2, 3),
    (-1.5, 2, -3.2),
    (0.6, 0.5, 0.4),
    cutoff=30,
    exponent=3,
    attenuation=(1, 0.1, 0.02),
    **COLOURS,
)
MATERIAL = pf.Material(
    diffuse=(0.6, 0.3, 0.2),
    specular=(0.7, 0.4, 0.5),
    shininess=(20.0, 25.0, 30.0),
    ambient=(0.5, 0.4, 0.3),
    emission=(0.01, 0.02, 0.03),
)
BALL = pf.Sphere((0.05, 0.02, 0.1), 1.1)
PINHOLE = pf.PerspectiveCamera.look_at((0.5, 0.3, 5), width=6, height=6, fov_y=28)


def scene_of(surface, camera, lights, specular, background=0.1):
    # A black background would lie on the clamp's lower kink.
    return pf.Scene(
        surface,
        camera,
        lights,
        (0.1, 0.2, 0.3),
        specular_model=specular,
        background=background,
    )


def maps():
    """A normal map with positions, and a material for each of its pixels."""
    rng = np.random.default_rng(0)
    normals = rng.uniform(-0.4, 0.4, (2, 2, 3)) + np.array([0, 0, 1])
    positions = rng.uniform(-0.3, 0.3, (2, 2, 3))
    surface = pf.NormalMap(normals, [[True, True], [False, True]], positions)
    values = rng.uniform(0.1, 0.9, (2, 2, 3))
    material = pf.Material(values, values[::-1], 20 * values[:, :, :1], 0.3, values)
    normalized = pf.BlinnPhong(normalized=True)
    return scene_of(surface, pf.PerspectiveCamera(2, 2), BULB, normalized), material


SCENES = {
    "two lights": (
        scene_of(BALL, PINHOLE, (SUN, SPOT), pf.BlinnPhong()),
        MATERIAL,
    ),
    "perspective, Blinn": (
        scene_of(BALL, PINHOLE, (SUN, BULB, SPOT), pf.BlinnPhong()),
        MATERIAL,
    ),
    "orthographic, Phong": (
        scene_of(BALL, pf.OrthographicCamera(6, 6), (SUN, BULB), pf.Phong()),
        MATERIAL,
    ),
    "maps": maps(),
}


def rendered(both):
    return pf.render(*both)


@pytest.mark.parametrize("name", ["two lights", "maps"])
def test_every_leaf(name):
    scene, material = SCENES[name]
    image, mask = pf.render(scene, material), scene.trace().mask
    assert image[mask].max() > 0.6 and 0 < mask.sum() < mask.size
    check_gradients(rendered, (scene, material), order=1)


@pytest.mark.extended
@pytest.mark.parametrize("name", ["perspective, Blinn", "orthographic, Phong", "maps"])
def test_every_leaf_to_second_order(name):
    check_gradients(rendered, SCENES[name])


# Many points at once, which compile as one: light, viewer and normal of shape (N, 3),
# and a material each. The first index in a failure's path is the row.
Points = dict[str, Any]


def lit(specular, film, point: Points):
    def one(light, view, normal, material):
        sun = pf.DirectionalLight(light)
        origin, ambient = jnp.zeros(3), jnp.full(3, 0.1)
        terms = point_terms((sun,), ambient, specular, origin, normal, view)
        return film.expose(combine(terms, material))[0]

    return jax.vmap(one)(
        point["light"], point["view"], point["normal"], point["material"]
    )


def points(rows) -> Points:
    """Rows of (light, view, normal, ρ_s, f); vectors become unit vectors."""

    def units(vectors):
        array = np.array(vectors, float)
        return array / np.linalg.norm(array, axis=1, keepdims=True)

    lights, views, normals, rho_s, shininess = zip(*rows, strict=True)
    return {
        "light": units(lights),
        "view": units(views),
        "normal": units(normals),
        "material": material_of(rho_s, shininess),
    }


def material_of(rho_s, shininess):
    """A material for each row: leaves of shape (N, 1)."""

    def column(values):
        return np.broadcast_to(np.array(values, float), (len(rho_s),))[:, None]

    return pf.Material(
        column(0.6), column(rho_s), column(shininess), column(0.5), column(0.0)
    )


UP, X = (0, 0, 1), (1, 0, 0)
LEFT, RIGHT = (-1, 0.2, 2), (1, 0.3, 2)
MODELS = [pf.Phong(), pf.BlinnPhong(), pf.BlinnPhong(gate=False, normalized=True)]

# Smooth, though each is a place where careless formulas give NaN.
SMOOTH = [
    (UP, UP, UP, 0.4, 30),  # normal = light = viewer: the centre of the highlight
    (RIGHT, LEFT, UP, 0.4, 1),  # f at its lower bound
    (RIGHT, LEFT, UP, 0, 30),  # no highlight: f is free, and its derivative 0
    (RIGHT, LEFT, UP, 0, 1),
    ((1, 0, 1), (1, 0, 1), UP, 0.4, 10),  # r·v is exactly zero
    ((1, 0, 1e-3), LEFT, UP, 0.4, 10),  # the light just above the horizon
    ((1, 0, -1e-3), LEFT, UP, 0.4, 10),  # and just below
    (RIGHT, LEFT, UP, 0.4, 10),
    (LEFT, UP, UP, 0.9, 3),
]
# f at its upper bound: differences lose digits to the steepness of cos^1000. (As many
# rows as of kinks, so that all compile as one.)
SHARP = 3 * [
    (UP, UP, UP, 0.4, 1000),
    (RIGHT, LEFT, UP, 0.4, 1000),
    (UP, UP, UP, 0, 1000),
]
# On the kink or the jump itself.
KINKS = [
    (X, LEFT, UP, 0.4, 10),  # the light at the horizon
    (X, UP, UP, 0.4, 1),
    (X, X, UP, 0.4, 1),  # light and viewer at the horizon
    ((1, 0, 1), (1, 0, 1), UP, 0.4, 1),  # r·v is exactly zero, where cos¹ has a kink
    ((1, 0, 1), (1, 0, 1), UP, 0, 1),
    (X, (-1, 0, 0), UP, 0.4, 10),  # light opposite to the viewer: no half vector
    ((0.6, 0, 0.8), (0.6, 0, -0.8), UP, 0.4, 1),  # h·m is exactly zero
    ((0.6, 0, 0.8), (0.6, 0, -0.8), UP, 0.4, 1000),
    ((0, 0, -1), UP, UP, 0.4, 10),  # the light straight behind, opposite to the viewer
]


@pytest.mark.parametrize(
    "model, order",
    [
        (MODELS[0], 1),
        pytest.param(MODELS[0], 2, marks=pytest.mark.extended),
        (MODELS[1], 2),
        pytest.param(MODELS[2], 2, marks=pytest.mark.extended),
    ],
)
def test_awkward_points(model, order):
    def shown(rows):
        return lit(model, Film(clamp=False), rows)

    check_gradients(shown, points(SMOOTH), order=order)
    check_gradients(shown, points(SHARP), order=order, rtol=1e-3)
    check_gradients(shown, points(KINKS), order=order, finite_differences=False)


def test_the_clamp():
    """Highlights that end just below white, just above, and on it."""
    row = (RIGHT, LEFT, UP, 0.4, 10)

    def function(p):
        return lit(pf.BlinnPhong(), Film(), p)

    four = points([row] * 4)
    diffuse = 0.6 * math.cos(math.atan(math.hypot(1, 0.3) / 2))
    unclamped = jax.jit(lambda p: lit(pf.BlinnPhong(), Film(clamp=False), p))
    highlight = unclamped(jax.tree.map(floats, four))
    lobe = (float(highlight[0]) - 0.05 - diffuse) / 0.4
    to_white = (1 - 0.05 - diffuse) / lobe
    rho_s = to_white * np.array([0.999, 1.001, 0.9, 1.5])
    near_white = four | {"material": material_of(rho_s, [10] * 4)}
    values = np.asarray(jax.jit(function)(jax.tree.map(floats, near_white)))
    assert np.array_equal(values == 1, [False, True, False, True])
    # On white itself, and to second order: `test_film`.
    check_gradients(function, near_white, order=1)


def test_a_light_on_a_pixel_leaves_no_nan():
    """Pixels outside a mask are often at the origin, and so are flash lights."""
    lights = (
        pf.PointLight((0, 0, 0), attenuation=(0, 0, 1)),
        pf.SpotLight((0, 0, 0), (0, 0, -1), exponent=2.5, attenuation=(0, 1, 0)),
    )
    positions = np.zeros((1, 2, 3))
    positions[0, 1] = (0.3, 0.2, -2)
    normals = np.broadcast_to([0.1, 0.0, 1.0], (1, 2, 3))
    surface = pf.NormalMap(normals, [[False, True]], positions)
    scene = pf.Scene(
        surface, pf.PerspectiveCamera(2, 1, position=(0, 0, 0)), lights, 0.1
    )

    def loss(both):
        return jnp.sum(pf.render(*both) ** 2)

    slopes = eqx.filter_jit(eqx.filter_grad(loss))((scene, MATERIAL))
    leaves = jax.tree.leaves(slopes)
    assert len(leaves) > 10 and all(np.all(np.isfinite(leaf)) for leaf in leaves)


@pytest.mark.parametrize("precision", ["float32"], indirect=True)
def test_gradients_are_finite_in_single_precision(precision):
    """At the silhouette, and where nothing is seen at all."""
    del precision
    camera = pf.OrthographicCamera(9, 9, view_height=2.4)
    lights = pf.DirectionalLight((1, 1, 2)), pf.PointLight((-2, 1, 3))
    material = pf.Material(0.6, 0.4, 20.0)
    slopes_of = eqx.filter_jit(eqx.filter_grad(lambda both: jnp.sum(pf.render(*both))))
    for sphere in (pf.Sphere(radius=1.1), pf.Sphere((0, 0, 9))):
        scene = pf.Scene(sphere, camera, lights, 0.1)
        slopes = jax.tree.leaves(slopes_of((scene, material)))
        assert slopes[0].dtype == np.float32
        assert all(np.all(np.isfinite(leaf)) for leaf in slopes)
