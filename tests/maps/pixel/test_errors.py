"""Standard errors of a pixel, and what they are worth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import nnls

from phongfit.maps.pixel.columns import make_columns
from phongfit.maps.pixel.errors import standard_errors
from phongfit.maps.pixel.exponent import Box, evaluate
from phongfit.maps.pixel.settings import MapSettings
from tests.helpers import floats

IMAGES, NOISE = 40, 0.01
EXPONENT, SPECULAR, DIFFUSE = 12.0, 0.3, 0.5

rng = np.random.default_rng(0)
COSINES, LOGARITHMS = rng.random(IMAGES), -0.3 * rng.random(IMAGES)

SETTINGS = MapSettings(names=("diffuse", "specular", "shininess"))
BOX = Box((0.0, 0.0), (1.0, 1.0), *SETTINGS.log_bounds)


@jax.jit
def errors_at(t, moved, specular):
    """Of one channel, ρ_d, ρ_s and f unknown, without noise in its samples."""
    diffuse, angles = floats(COSINES[:, None, None]), floats(LOGARITHMS[:, None, None])
    one = floats(np.ones((IMAGES, 1, 1)))
    target = DIFFUSE * diffuse + specular * jnp.exp(EXPONENT * angles)
    columns = make_columns((diffuse,), target, one, one[:, None])
    t, moved = t.reshape(1, 1), moved.reshape(2, 1, 1)
    at = evaluate(columns, SETTINGS.lobes, angles, t, BOX)
    return standard_errors(
        at, columns, t, floats([[NOISE]]), moved, angles, BOX, SETTINGS
    )


STILL = np.zeros((1, 2))


def test_errors_of_the_minimum():
    found = errors_at(floats(np.log(EXPONENT)), floats(STILL), floats(SPECULAR))
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
    found = errors_at(floats(t), floats(moved), floats(SPECULAR))
    assert found.moving
    assert np.isinf(found.exponent) and np.isinf(found.reflectances).all()


def test_vague_errors_reach_as_far_as_the_profile():
    """By hand: at every exponent of the scan, all that two standard errors allow.

    That is further than with an exponent that were known.
    """
    faint = 0.02
    found = errors_at(floats(np.log(EXPONENT)), floats(STILL), floats(faint))
    assert found.dim and not found.moving
    target = DIFFUSE * COSINES + faint * np.exp(EXPONENT * LOGARITHMS)
    candidates = np.arange(BOX.lowest, BOX.highest, np.log(2)).tolist()
    reach = np.zeros(2)
    for t in [*candidates, BOX.highest]:
        basis = np.stack([COSINES, np.exp(np.exp(t) * LOGARITHMS)], axis=1)
        point, loss = nnls(basis, target)
        left = 4 * NOISE**2 - loss**2
        variance = np.diag(np.linalg.inv(basis.T @ basis))
        if left >= 0:
            off = np.abs(point - [DIFFUSE, faint]) + np.sqrt(left * variance)
            reach = np.maximum(reach, off / 2)
    np.testing.assert_allclose(found.reflectances.ravel(), reach, rtol=1e-3)
    highlight = np.exp(EXPONENT * LOGARITHMS)
    known = np.stack([COSINES, highlight], axis=1)
    narrow = NOISE * np.sqrt(np.diag(np.linalg.inv(known.T @ known)))
    assert np.all(reach > 1.2 * narrow)
