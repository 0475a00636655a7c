"""Sums over the lamps are the derivatives of the cost that they say they are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.maps.pixel.lighting import make_lamps, make_lighting
from phongfit.maps.pixel.samples import Samples
from phongfit.maps.pixel.settings import MapSettings, Point, tangents, unknowns_of
from phongfit.maps.pixel.sums import gather
from tests.maps.synthetic import dtype


@pytest.mark.parametrize(
    "one_specular", [pytest.param(False, marks=pytest.mark.extended), True]
)
def test_pulls_are_half_of_the_cost_s_slope(one_specular):
    rng = np.random.default_rng(0)
    surface, camera = pf.Sphere(), pf.OrthographicCamera(2, 2)
    lamps = [pf.PointLight(p) for p in ((1, 1, 2), (-1, 0.5, 2), (0.2, -1, 3))]
    scenes = tuple(pf.Scene(surface, camera, lamp, 0.2) for lamp in lamps)
    pixels = 3
    position = jnp.asarray(rng.uniform(-0.3, 0.3, (pixels, 3)), dtype())
    viewer = jnp.asarray([[0, 0, 1]], dtype())
    made = make_lamps(make_lighting(scenes), position, viewer)
    settings = MapSettings(normals="fit", one_specular=one_specular)
    which = unknowns_of(settings)

    def numbers(*shape: int) -> jax.Array:
        return jnp.asarray(rng.uniform(0.2, 0.6, shape), dtype())

    samples = Samples(numbers(3, 3, pixels), jnp.ones((3, 3, pixels), dtype()), made)
    normal = jnp.asarray(rng.normal(size=(3, pixels)) + [[0], [0], [4]], dtype())
    normal = normal / jnp.linalg.norm(normal, axis=0, keepdims=True)
    point = Point(
        normal,
        jnp.log(jnp.asarray([5.0, 10, 30], dtype())),
        numbers(3, pixels),
        numbers(3, pixels),
        numbers(1 if one_specular else 3, pixels),
    )
    scale = numbers(pixels)

    @jax.jit
    def sums(point: Point):
        return gather(point, samples, scale, settings, which)

    def cost(moved):
        a, b, t, ambient, diffuse, specular = moved
        first, second = tangents(point.normal)
        turned = point.normal + a[None] * first + b[None] * second
        return jnp.sum(sums(Point(turned, t, ambient, diffuse, specular)).cost)

    none = jnp.zeros(pixels, dtype())
    slope = jax.jit(jax.jacfwd(cost))((none, none, *point[1:]))
    here = sums(point)
    shared = [slope[0], slope[1], slope[2], *([slope[5][0]] if one_specular else [])]
    own = {"ambient": slope[3], "diffuse": slope[4], "specular": slope[5]}
    for pull, expected in zip(here.pull_shared, shared, strict=True):
        np.testing.assert_allclose(-2 * pull, expected, rtol=2e-4, atol=2e-4)
    for pull, name in zip(here.pull_own, which.own, strict=True):
        np.testing.assert_allclose(-2 * pull, own[name], rtol=2e-4, atol=2e-4)
