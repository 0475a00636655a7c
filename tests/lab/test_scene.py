"""From the sliders to a scene."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import phongfit as pf
from phongfit.lab.scene import (
    Frame,
    angles,
    fitted_into_view,
    make_camera,
    make_lights,
    make_scene,
)
from phongfit.lab.settings import Settings
from tests.helpers import near

FRAME = Frame(32, 32)


@pytest.mark.parametrize(
    "azimuth, elevation, towards",
    [(0, 0, (0, 0, 1)), (90, 0, (1, 0, 0)), (0, 90, (0, 1, 0)), (-90, 0, (-1, 0, 0))],
)
def test_where_light_comes_from(azimuth, elevation, towards):
    settings = Settings(azimuth=azimuth, elevation=elevation)
    (light,) = make_lights(settings)
    assert isinstance(light, pf.DirectionalLight)
    near(light.direction, towards, 1e-6)


def test_kinds_of_light():
    place: dict[str, Any] = {"azimuth": 20.0, "elevation": -40.0, "distance": 4.0}
    (point,) = make_lights(Settings(light="point", falloff=0.5, **place))
    assert isinstance(point, pf.PointLight)
    near(angles(point.position), (20, -40, 4), 1e-5)
    # At the origin it is as strong as it says, and falls off by half from there.
    near(point.attenuation, (0.5, 0, 0.5 / 16))
    near(point.illuminate(jnp.zeros(3)).intensity, np.ones(3), 1e-6)
    (spot,) = make_lights(Settings(light="spot", cutoff=9.0, exponent=3.0, **place))
    assert isinstance(spot, pf.SpotLight)
    near(spot.position, -4 * spot.axis, 1e-5)
    near([spot.cutoff, spot.exponent], [9, 3])
    assert make_lights(Settings(light="none")) == ()


def test_a_sphere_lies_where_a_photograph_has_it():
    """Centre and radius are shares of a photograph that is no square."""
    settings = Settings(centre_x=30.0, centre_y=60.0, radius=20.0)
    frame = Frame(100, 200, free=True)
    seen = np.asarray(make_scene(settings, pf.Sphere(), frame).trace().mask)
    rows, columns = np.nonzero(seen)
    near(columns.mean() + 0.5, 60, 0.01)
    near(rows.mean() + 0.5, 60, 0.01)
    assert seen.any(axis=0).sum() == seen.any(axis=1).sum() == 40
    # Elsewhere they do nothing: the sphere fills ten elevenths.
    whole = np.asarray(make_scene(settings, pf.Sphere(), Frame(110, 110)).trace().mask)
    assert whole.any(axis=0).sum() == whole.any(axis=1).sum() == 100


def test_a_mesh_is_looked_at_from_the_side():
    camera = make_camera(Settings(surface="mesh", turn=90.0), FRAME)
    near(camera.rotation[:, 2], (1, 0, 0), 1e-6)
    # The sphere keeps its light in place.
    near(make_camera(Settings(turn=90.0), FRAME).rotation, np.eye(3), 1e-6)


def test_any_mesh_fits_into_the_view():
    ball = trimesh.creation.icosphere(1, radius=7.0)
    fitted = fitted_into_view(pf.Mesh(ball.vertices + 100, ball.faces))
    near(np.linalg.norm(fitted.vertices, axis=1), 1, 1e-4)
    assert fitted.two_sided and fitted.materials == 1
    point = pf.Mesh(np.ones((3, 3)), [[0, 1, 2]])
    with pytest.raises(ValueError, match="all in one place"):
        fitted_into_view(point)
