"""Least squares of JAX residuals, against solutions that are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.calibration.least_squares import (
    differentiated,
    least_squares,
    summed_by_block,
)
from phongfit.calibration.matte import AnyDistanceLight


def decay(values, times, data):
    """Residuals of an exponential."""
    return values[0] * jnp.exp(-values[1] * times) - data


TIMES = np.linspace(0, 3, 20)
DATA = 2 * np.exp(-0.7 * TIMES)


@pytest.mark.parametrize("upper, rate", [(np.inf, 0.7), (0.5, 0.5)])
def test_it_finds_the_minimum_within_bounds_in_double_precision(upper, rate):
    residual = differentiated(decay)
    with jax.enable_x64(False):
        found = least_squares(
            residual, np.array([1.0, 0.1]), TIMES, DATA, upper=np.array([9, upper])
        )
    assert found.values[1] == pytest.approx(rate, abs=1e-6)
    by_rate = -found.values[0] * TIMES * np.exp(-found.values[1] * TIMES)
    assert found.jacobian.dtype == np.float64
    assert found.jacobian[:, 1] == pytest.approx(by_rate, abs=1e-12)
    assert found.hat.sum() == pytest.approx(2)


def test_a_direction_without_information_has_no_variance():
    residual = differentiated(lambda values: jnp.stack([values[0] - 1, 0 * values[1]]))
    found = least_squares(residual, np.zeros(2))
    assert found.covariance == pytest.approx(np.diag([1.0, 0.0]))


def test_sums_by_block():
    scores = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    sums = summed_by_block(scores, np.array([7, 2, 7]))
    assert sums.tolist() == [[3, 4], [6, 8]]
    assert summed_by_block(scores[:0], np.zeros(0, int)).shape == (0, 2)


@pytest.mark.parametrize("falloff", [0.0, 0.5, 1.0])
def test_a_lamp_at_any_distance_is_a_point_light_or_a_directional_one(falloff):
    direction, reference = np.array([0.48, 0.6, 0.64]), np.array([0.0, 0.0, -10.0])
    point = jnp.array([0.3, -0.2, -9.0])

    def light(inverse):
        numbers = map(jnp.asarray, (direction, inverse, reference, falloff))
        return AnyDistanceLight(*numbers).illuminate(point)

    near = pf.PointLight(
        reference + 5 * direction, attenuation=(1 - falloff, 0, falloff / 25)
    )
    for own, known in (
        (light(0.2), near.illuminate(point)),
        (light(0.0), pf.DirectionalLight(direction).illuminate(point)),
    ):
        assert own.to_light == pytest.approx(known.to_light)
        assert own.intensity == pytest.approx(known.intensity)
        assert float(own.distance) == pytest.approx(float(known.distance))
