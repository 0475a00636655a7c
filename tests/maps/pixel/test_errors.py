"""Standard errors of a pixel, and what they are worth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from phongfit.maps.pixel.columns import make_columns
from phongfit.maps.pixel.errors import standard_errors
from phongfit.maps.pixel.exponent import Box, evaluate
from phongfit.maps.pixel.settings import MapSettings
from phongfit.maps.pixel.small import over_channels
from tests.helpers import floats

IMAGES, NOISE = 40, 0.01
EXPONENT, SPECULAR, DIFFUSE = 12.0, 0.3, 0.5


@jax.jit
def errors_at(t, moved):
    """Of one channel, ρ_d, ρ_s and f unknown, without noise in its samples."""
    rng = np.random.default_rng(0)
    diffuse = floats(rng.random((1, IMAGES)))
    cosine = (floats(-0.3 * rng.random(IMAGES)),)
    strength = (floats(np.ones((1, IMAGES))),)
    lobe = jnp.exp(EXPONENT * cosine[0])[None]
    target = DIFFUSE * diffuse + SPECULAR * lobe
    weight = floats(np.ones((1, IMAGES)))
    columns = over_channels(make_columns, (diffuse,), target, weight, strength)
    settings = MapSettings(names=("diffuse", "specular", "shininess"))
    low, high = settings.log_bounds
    edges = (floats(0.0), floats(0.0)), (floats(1.0), floats(1.0))
    box = Box(*edges, floats(low), floats(high))
    at = evaluate(columns, settings.lobes, cosine, t, box)
    whole = jnp.ones((), bool)
    noise = floats(NOISE)
    return standard_errors(at, columns, t, noise, moved, cosine, box, whole, settings)


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
