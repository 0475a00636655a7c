"""Standard errors of a pixel, and what they are worth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from phongfit.maps.pixel.columns import make_columns
from phongfit.maps.pixel.errors import standard_errors
from phongfit.maps.pixel.exponent import Box, evaluate
from phongfit.maps.pixel.settings import MapSettings
from tests.helpers import floats

IMAGES, NOISE = 40, 0.01
EXPONENT, SPECULAR, DIFFUSE = 12.0, 0.3, 0.5


@jax.jit
def errors_at(t, moved):
    """Of one channel, ρ_d, ρ_s and f unknown, without noise in its samples."""
    rng = np.random.default_rng(0)
    diffuse = floats(rng.random((IMAGES, 1, 1)))
    angles = floats(-0.3 * rng.random((IMAGES, 1, 1)))
    one = floats(np.ones((IMAGES, 1, 1)))
    target = DIFFUSE * diffuse + SPECULAR * jnp.exp(EXPONENT * angles)
    columns = make_columns((diffuse,), target, one, one[:, None])
    settings = MapSettings(names=("diffuse", "specular", "shininess"))
    box = Box((0.0, 0.0), (1.0, 1.0), *settings.log_bounds)
    t, moved = t.reshape(1, 1), moved.reshape(2, 1, 1)
    at = evaluate(columns, settings.lobes, angles, t, box)
    whole, noise = jnp.ones((), bool), floats([[NOISE]])
    return standard_errors(at, columns, t, noise, moved, angles, box, whole, settings)


STILL = np.zeros((1, 2))


def test_errors_of_the_minimum():
    found = errors_at(floats(np.log(EXPONENT)), floats(STILL))
    assert not found.moving and np.isfinite(found.exponent)
    assert np.all(np.asarray(found.reflectances) < 0.1)


@pytest.mark.parametrize(
    "t, moved",
    [
        (np.log(EXPONENT) + 0.3, STILL),
        (np.log(EXPONENT), np.array([[0.0, 0.1]])),
    ],
)
def test_what_still_moves_has_no_errors(t, moved):
    """Where the exponent has not come to rest, or weights still move reflectances."""
    found = errors_at(floats(t), floats(moved))
    assert found.moving
    assert np.isinf(found.exponent) and np.isinf(found.reflectances).all()
