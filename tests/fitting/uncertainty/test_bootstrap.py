"""The parametric bootstrap: its spread is what the errors state."""

import jax
import numpy as np
import pytest

import phongfit as pf
from tests.fitting.scenes import ball, photograph, truth

SCENE, TRUTH, NOISE = ball(), truth(), 0.01
KEY = jax.random.key(0)


def noisy(scene: pf.Scene, film: pf.Film, seed: int = 0) -> np.ndarray:
    """A photograph with noise."""
    light = photograph(scene, TRUTH)
    noise = np.random.default_rng(seed).normal(size=light.shape)
    return np.asarray(film.expose(np.float32(light + NOISE * noise)))


@pytest.fixture(scope="module")
def fit() -> pf.Fit:
    return pf.fit(SCENE, noisy(SCENE, pf.Film()))


def test_the_spread_is_that_of_the_errors(fit):
    draws = 200
    found = fit.bootstrap(draws, key=KEY)
    assert found.labels == fit.labels and found.failed == 0
    assert found.values.shape == (draws, len(fit.labels))
    ratio = found.errors / fit.errors
    # Four standard errors of a standard deviation.
    assert np.abs(ratio - 1).max() < 4 / np.sqrt(2 * draws)
    off = (found.values.mean(axis=0) - fit.values) / fit.errors
    assert np.abs(off).max() < 4 / np.sqrt(draws)
    scale = np.outer(fit.errors, fit.errors)
    assert np.abs((found.covariance - fit.covariance) / scale).max() < 0.3
    assert "200 simulated fits, 0 failed" in str(found) and "shininess" in repr(found)


def test_equal_keys_give_equal_draws(fit):
    first, again = (fit.bootstrap(2, key=KEY).values for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert np.abs(fit.bootstrap(2, key=jax.random.key(1)).values - first).min() > 0


def test_mask_noise_priors_and_exposures():
    scenes = [SCENE, ball(ambient=0.1)]
    mask = np.zeros((32, 32), bool)
    mask[:, 8:24] = True
    films = pf.Film(bits=8), pf.Film()
    images = [noisy(*one, k) for k, one in enumerate(zip(scenes, films, strict=True))]
    fit = pf.fit(
        scenes,
        images,
        unknowns=("diffuse", "specular", "exposure"),
        known=TRUTH,
        fixed={"exposure[0]": 1.0},
        priors={"specular.red": (0.3, 1e-4)},
        mask=[mask, mask],
        noise=NOISE,
        film=films,
    )
    found = fit.bootstrap(30, key=KEY)
    assert found.labels == fit.labels and found.failed == 0
    ratio = found.errors / fit.errors
    assert 0.5 < ratio.min() < ratio.max() < 1.6
    assert 0.5e-4 < found.errors[fit.labels.index("specular.red")] < 1.6e-4


def test_fits_that_do_not_converge_are_counted(fit):
    few = pf.fit(SCENE, fit.photographs, max_steps=1)
    found = few.bootstrap(2, key=KEY)
    assert found.failed == 2 and found.values.shape == (0, len(fit.labels))
    assert np.isnan(found.errors).all() and np.isnan(found.covariance).all()
    assert "0 simulated fits, 2 failed" in str(found)


@pytest.mark.parametrize(
    "options, words",
    [
        ({"n": 1, "key": KEY}, "n: expected 2 or more, got 1"),
        ({"key": 3.5}, "key: expected a key, such as jax.random.key"),
        ({"key": np.ones(2)}, "key: expected a key, such as jax.random.key"),
    ],
)
def test_wrong_arguments_are_named(fit, options, words):
    with pytest.raises(ValueError, match=words):
        fit.bootstrap(**options)
