"""What the film makes of light, on average: `phongfit.fitting.texels.lit`."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

import phongfit as pf
from phongfit.fitting.problem.noise import end_steps
from phongfit.fitting.texels.lit import film_response
from tests.helpers import near


@pytest.mark.parametrize("noise", [0.003, 0.005, 0.01])
def test_light_that_is_clipped_and_rounded(noise):
    film = pf.Film(bits=8)
    step, levels = 1 / 255, np.arange(1, 256)[:, None]
    light = np.concatenate([np.linspace(0, 0.05, 40), np.linspace(0.95, 1, 40)])
    # A level is reached from half a step below it on.
    edges = (levels - 0.5) * step
    expected = step * norm.sf((edges - light) / noise).sum(axis=0)
    whole = np.full_like(light, np.hypot(noise, step / np.sqrt(12)))
    light, whole = (np.asarray(jnp.asarray(one))[:, None] for one in (light, whole))
    known = film_response(light, whole, True, end_steps(film)).mean[:, 0]
    near(known, expected, 2e-3 * noise)
    # Without the steps it is an order of magnitude further off, which a million see.
    plain = film_response(light, whole, True).mean[:, 0]
    off = abs(plain - expected).max()
    assert off > 5 * abs(known - expected).max() and off > 0.005 * noise


def test_steps_at_the_ends():
    assert end_steps(pf.Film()) == (0.0, 0.0)
    near(np.array(end_steps(pf.Film(bits=8))), np.full(2, 1 / 255), 1e-6)
    dark, bright = end_steps(pf.Film(encoding="srgb", bits=8))
    near(np.array(dark), np.array(1 / 255 / 12.92), 1e-6)
    assert 2 / 255 < bright < 2.4 / 255
