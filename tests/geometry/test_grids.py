"""Pixels' own triangles: a normal map with positions throws shadows."""

import jax
import numpy as np
import pytest

import phongfit as pf

N = 32
CAMERA = pf.OrthographicCamera(N, N, view_height=2)


def step(mask: np.ndarray | None = None) -> pf.NormalMap:
    """A floor, whose right quarter is half a unit higher; normals all up."""
    rays = np.asarray(CAMERA.rays().origin, float)
    points = np.where(rays[..., :1] > 0.5, [0, 0, 0.5], 0) + rays * [1, 1, 0]
    up = np.broadcast_to([0.0, 0, 1], points.shape)
    return pf.NormalMap(up, mask, points)


def shadow(surface: pf.NormalMap, light: pf.AbstractLight) -> np.ndarray:
    seen = pf.geometry.trace(surface, CAMERA, [light], shadows=True).visibility
    return np.asarray(seen)[..., 0] == 0


@pytest.mark.parametrize(
    "light, reach",
    [
        (pf.DirectionalLight((1, 0, 1)), 0.5),
        (pf.DirectionalLight((1, 0, 2)), 0.25),
        # From 1.5 above the floor's right edge: its ray grazes the step at x = 0.5.
        (pf.PointLight((1.5, 0, 1)), 1.0),
        (pf.DirectionalLight((0, 0, 1)), 0.0),
        (pf.DirectionalLight((-1, 0, 1)), 0.0),
    ],
)
def test_a_step_throws_the_shadow_that_geometry_says(light, reach):
    x = np.asarray(CAMERA.rays().origin)[0, :, 0]
    dark = shadow(step(), light)
    wanted = (x < 0.5) & (x > 0.5 - reach)
    # A pixel at each end: the step lies between two.
    clear = (abs(x - 0.5) > 3 / N) & (abs(x - 0.5 + reach) > 3 / N)
    # A ray along the outermost row grazes the rim of all triangles.
    middle = slice(8, 24) if isinstance(light, pf.PointLight) else slice(1, N - 1)
    assert np.all(dark[middle][:, clear] == wanted[clear])
    assert dark.any() == (reach > 0)


def test_pixels_outside_the_mask_throw_none():
    x = np.asarray(CAMERA.rays().origin)[..., 0]
    light = pf.DirectionalLight((1, 0, 1))
    assert shadow(step(), light).any()
    assert not shadow(step(x < 0.5), light).any()


def test_shadows_are_those_of_the_triangles_as_a_mesh():
    """And the same inside a compiled program."""
    rng = np.random.default_rng(3)
    x, y = np.moveaxis(np.asarray(CAMERA.rays().origin, float)[..., :2], -1, 0)
    height = 0.2 * np.sin(5 * x) * np.cos(4 * y) + 0.1 * x
    mask = (rng.random((N, N)) > 0.02) & (x**2 + y**2 < 0.9)
    points = np.stack([x, y, height], axis=-1)
    surface = pf.NormalMap(np.broadcast_to([0.0, 0, 1], points.shape), mask, points)
    light = pf.DirectionalLight((1, 0.3, 0.25))
    dark = shadow(surface, light)
    compiled = jax.jit(
        lambda s: pf.geometry.trace(s, CAMERA, [light], shadows=True).visibility
    )
    np.testing.assert_array_equal(dark, np.asarray(compiled(surface))[..., 0] == 0)
    high = np.where(mask, height, np.nan)
    cast = pf.geometry.cast_shadows(high, CAMERA, [light])[0]
    np.testing.assert_array_equal(dark[mask], cast[mask])
    assert 0.1 < dark[mask].mean() < 0.9
