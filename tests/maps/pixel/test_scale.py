"""Losses as weights."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from phongfit.fitting.problem.losses import LOSSES, Huber, Linear
from phongfit.fitting.problem.noise import median_deviation
from phongfit.maps.pixel.scale import loss_weights, widening
from tests.helpers import floats

WIDENING = jax.jit(widening, static_argnums=0)


def test_weights_of_huber():
    weights = loss_weights(Huber(), floats([0.0, 1.0, -2.69, 13.45]))
    np.testing.assert_allclose(weights, [1, 1, 0.5, 0.1], rtol=1e-5)


def test_weights_fall():
    @jax.jit
    def weights_of(residual):
        return {name: loss_weights(loss, residual) for name, loss in LOSSES.items()}

    for name, weights in weights_of(floats(np.linspace(0, 20, 50))).items():
        assert np.all(np.diff(weights) <= 1e-6), name
        assert weights[0] == pytest.approx(1, abs=1e-4), name
        assert np.all(weights >= 0), name


def test_scale_from_the_median():
    rng = np.random.default_rng(0)
    residual = rng.normal(size=301) * 0.3
    residual[:60] = 50
    used = np.ones(301, bool)
    used[:30] = False
    found = jax.jit(median_deviation)(floats(residual), jnp.asarray(used))
    assert float(found) == pytest.approx(
        1.4826 * np.median(np.abs(residual[used])), rel=0.02
    )


def test_widening_on_gaussian_noise():
    """The constants are made for 95 % efficiency."""
    noise = floats(np.random.default_rng(0).normal(size=20000))
    used = jnp.ones(20000, bool)
    assert float(WIDENING(Linear(), noise, used)) == pytest.approx(1, abs=0.02)
    assert float(WIDENING(Huber(), noise, used)) == pytest.approx(0.95**-0.5, abs=0.02)


def test_widening_counts_the_unknowns():
    """As Huber has it: of n - p, and K; against NumPy's sums."""
    noise = np.random.default_rng(1).normal(size=40)
    inside = np.abs(noise) < 1.345
    share = inside.mean()
    square = np.sum(np.minimum(np.abs(noise), 1.345) ** 2) / 30
    expected = (1 + 10 / 40 * (1 - share) / share) * np.sqrt(square) / share
    found = WIDENING(Huber(), floats(noise), jnp.ones(40, bool), unknowns=10)
    assert float(found) == pytest.approx(expected, rel=1e-4)
