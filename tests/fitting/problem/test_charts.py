import jax
import jax.numpy as jnp
import numpy as np
import pytest

from phongfit.fitting.problem.charts import (
    nearest_rotation,
    on_sphere,
    spread_directions,
    tangents,
    turned,
)
from phongfit.testing import check_gradients
from tests.helpers import floats, near, random_rotation, random_units

BASE = random_units(1)[0]


def test_every_direction_but_one_is_reached():
    """The chart's inverse by hand: y = 2 (d − (b·d) b) / (1 + b·d)."""
    across = tangents(BASE)
    targets = random_units(200, seed=1)
    cosine = targets @ BASE
    assert cosine.min() < -0.95
    y = 2 * (targets @ across.T) / (1 + cosine[:, None])
    found = jax.vmap(on_sphere, in_axes=(None, None, 0))(
        floats(BASE), floats(across), y
    )
    near(found, targets, 1e-4 if found.dtype == np.float32 else 1e-12)


@pytest.mark.parametrize("y", [(0, 0), (0.5, -2), (1e4, 1e4)])
def test_steps_are_angles(y):
    """As long in either direction, at right angles, and 1 / (1 + |y|² / 4) long."""
    across = floats(tangents(BASE))
    slope = jax.jacfwd(lambda y: on_sphere(floats(BASE), across, y))(floats(y))
    length = 1 / (1 + np.dot(y, y) / 4)
    near(slope.T @ slope / length**2, np.eye(2), 1e-3 if y[0] > 1 else 1e-6)
    near(jnp.linalg.norm(on_sphere(floats(BASE), across, floats(y))), 1)


def test_spread_directions_leave_no_gap():
    spread = spread_directions(15)
    near(np.linalg.norm(spread, axis=1), 1, 1e-12)
    nearest = (random_units(2000) @ spread.T).max(axis=1)
    assert np.rad2deg(np.arccos(nearest.min())) < 40


@pytest.mark.parametrize("angle", [0, 1e-6, 1e-3, 20, 90, 180, 250])
def test_turned_stays_a_rotation_by_that_angle(angle):
    start, axis = floats(random_rotation(1)), random_units(1, seed=2)[0]
    found = np.asarray(turned(start, floats(angle * axis)), float)
    near(found.T @ found, np.eye(3))
    near(np.linalg.det(found), 1)
    # About an axis that moves with what is turned, and so stays where it is.
    near(found @ axis, np.asarray(start) @ axis)
    turn = np.asarray(start, float).T @ found
    near(np.trace(turn), 1 + 2 * np.cos(np.deg2rad(angle)), 2e-6)
    skew = [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    near(skew @ axis, 2 * np.sin(np.deg2rad(angle)), 2e-6)


def test_turned_has_derivatives():
    start = jnp.asarray(random_rotation(1), float)
    degrees = np.array([(0, 0, 0), (1e-4, 0, 0), (30, -50, 100)], float)
    check_gradients(lambda w: jax.vmap(turned, (None, 0))(start, w), degrees)


def test_nearest_rotation():
    exact = random_rotation(3).astype(float)
    off = exact + 1e-4 * np.random.default_rng(0).normal(size=(3, 3))
    found = nearest_rotation(off)
    near(found.T @ found, np.eye(3), 1e-14)
    near(found, exact, 5e-4)
    near(nearest_rotation(exact), exact, 1e-14)
