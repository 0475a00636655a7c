from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.geometry.cameras import Ray
from phongfit.vectors import norm
from tests.helpers import check_surface, floats, known, near

VIEW = pf.PerspectiveCamera.look_at((1, 2, 4), width=12, height=12, fov_y=26)


class Ellipsoid(eqx.Module):
    axes: jax.Array

    def __call__(self, position):
        # No distance: its slope is not 1, and its value is far from one.
        return 7 * (jnp.sum((position / self.axes) ** 2) - 1)


def ball(position):
    return norm(position) - 1


def test_contract():
    # Where rays meet it, to third order: below.
    surface = pf.ImplicitSurface(Ellipsoid(floats([0.9, 0.7, 0.8])))
    check_surface(surface, pf.PerspectiveCamera(4, 3, fov_y=12))


def test_a_ball_is_the_sphere():
    traced = pf.ImplicitSurface(ball, (-1.1,) * 3, (1.1,) * 3).trace(VIEW)
    exact = pf.Sphere().trace(VIEW)
    np.testing.assert_array_equal(traced.mask, exact.mask)
    mask = exact.mask[..., None]
    for one, other in zip(
        jax.tree.leaves(traced)[:3], jax.tree.leaves(exact)[:3], strict=True
    ):
        near(jnp.where(mask, one, 0), jnp.where(mask, other, 0), 1e-5)


def test_derivatives_of_where_a_ray_meets_the_surface():
    """Of z = c √(1 − x²/a² − y²/b²), to third order."""
    surface = pf.ImplicitSurface(Ellipsoid(floats([0.9, 0.7, 0.8])))

    def traced(x):
        ray = Ray(jnp.stack([x, floats(0.1), floats(5)]), floats([0, 0, -1]))
        return surface.intersect(ray)[0][2]

    def exact(x):
        return 0.8 * jnp.sqrt(1 - (x / 0.9) ** 2 - (0.1 / 0.7) ** 2)

    for _ in range(4):
        near(jax.jit(traced)(floats(0.3)), exact(floats(0.3)), 1e-10)
        traced, exact = jax.grad(traced), jax.grad(exact)


def test_a_ball_throws_the_shadow_of_a_sphere():
    lights = (pf.DirectionalLight((1, 1, 0)), pf.PointLight((0, 3, 3)))
    surface = pf.ImplicitSurface(ball, (-1.1,) * 3, (1.1,) * 3)
    view = pf.OrthographicCamera(31, 31)
    one, other = (
        pf.geometry.trace(s, view, lights, shadows=True) for s in (surface, pf.Sphere())
    )
    facing = np.stack(
        [np.asarray(one.normal) @ np.array([1, 1, 0]), np.ones((31, 31))], -1
    )
    clear = np.asarray(one.mask)[..., None] & (abs(facing) > 0.05)
    np.testing.assert_array_equal(
        np.where(clear, known(one.visibility), 1),
        np.where(clear, known(other.visibility), 1),
    )


def test_one_part_shades_another():
    def two(position):
        small = norm(position - floats([0, 0, 1.5])) - 0.3
        return jnp.minimum(norm(position) - 1, small)

    surface = pf.ImplicitSurface(two, (-1.1, -1.1, -1.1), (1.1, 1.1, 2))
    view = pf.OrthographicCamera.look_at(
        (5, 0, 0.5), (0, 0, 0.5), width=64, height=64, view_height=3.2
    )
    light = pf.DirectionalLight((0, 0, 1))
    buffer = pf.geometry.trace(surface, view, [light], shadows=True)
    x, y, z = np.moveaxis(np.asarray(buffer.position), -1, 0)
    shaded = (
        np.asarray(buffer.mask)
        & (np.asarray(buffer.visibility)[..., 0] == 0)
        & (z > 0.05)
        & (z < 1.1)
    )
    assert shaded.any()
    assert np.all(np.hypot(x, y)[shaded] < 0.31)


def test_what_the_box_leaves_out_is_not_seen():
    half = pf.ImplicitSurface(ball, (-1.1, -1.1, -1.1), (1.1, 0, 1.1))
    buffer = half.trace(pf.OrthographicCamera(20, 20))
    assert buffer.mask.any() and np.all(buffer.position[..., 1][buffer.mask] <= 0)


@pytest.mark.parametrize(
    "named, arguments",
    [
        ("function", dict(function=3)),
        ("lower", dict(lower=(0, 0))),
        ("upper", dict(upper=(1, -1, 1))),
        ("steps", dict(steps=0)),
        ("steps", dict(steps=10.0)),
    ],
)
def test_bad_surfaces(named, arguments):
    with pytest.raises(ValueError, match=f"^{named}: "):
        pf.ImplicitSurface(**dict(function=ball) | arguments)


@pytest.mark.parametrize("jit", [True, False], ids=["jit", "grad"])
def test_a_network_can_be_the_function(jit):
    class Bumpy(eqx.Module):
        radius: jax.Array
        # A function among the arrays, not marked as static.
        bend: Callable[[jax.Array], jax.Array]

        def __call__(self, position):
            return norm(position) - self.radius + 0.1 * self.bend(position[0])

    def depth(radius):
        surface = pf.ImplicitSurface(Bumpy(radius, jnp.sin))
        return surface.trace(pf.OrthographicCamera(1, 1, view_height=0.1)).position[
            0, 0, 2
        ]

    # Seen from +z at x = 0, the surface lies at z = radius.
    if jit:
        near(depth(floats(0.8)), 0.8, 1e-6)
    else:
        near(jax.grad(depth)(floats(0.8)), 1, 1e-6)
