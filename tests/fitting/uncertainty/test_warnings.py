import numpy as np
import pytest

import phongfit as pf
from tests.fitting.scenes import ball, photograph, truth

TRUTH = truth()

SCENE = ball()
NOISE = 0.01
NOISY = photograph(SCENE, TRUTH, noise=NOISE)
# Of the size of `test_rejected`, whose losses are compiled anyway.
LARGE = ball(size=64)
LARGER = photograph(LARGE, TRUTH, noise=NOISE)


def said(fit: pf.Fit, words: str) -> bool:
    assert all(map(pf.warning_code, fit.warnings))
    return any(words in warning for warning in fit.warnings)


def test_priors_that_agree_say_nothing():
    fit = pf.fit(SCENE, NOISY, priors={"shininess": (20.5, 0.5)})
    assert not fit.warnings


@pytest.mark.parametrize("deviation", [1e-3, 0.5])
def test_a_prior_that_contradicts(deviation):
    """Whether it gives way to the images, or they to it."""
    fit = pf.fit(SCENE, NOISY, priors={"shininess": (40.0, deviation)})
    assert fit.converged
    assert said(fit, "the prior of shininess, 40 ±")


@pytest.mark.parametrize("noise", [NOISE / 3, 3 * NOISE])
@pytest.mark.parametrize(
    "scene, image, loss", [(SCENE, NOISY, "linear"), (LARGE, LARGER, "huber")]
)
def test_noise_given_wrong(scene, image, loss, noise):
    fit = pf.fit(scene, image, noise=noise, loss=loss)
    assert said(fit, "times as large as the noise that was given") == (noise < NOISE)
    if noise < NOISE:
        plain = pf.fit(scene, image, loss=loss)
        np.testing.assert_allclose(fit.errors, plain.errors, rtol=0.15)


def test_noise_given_right_beside_outliers():
    """A loss that bears them does not take them for noise."""
    rng = np.random.default_rng(0)
    hit = rng.random(NOISY.shape[:2]) < 0.05
    image = np.where(hit[..., None], rng.random(NOISY.shape), NOISY)
    assert not said(pf.fit(SCENE, image, noise=NOISE, loss="tukey"), "noise that was")


def test_images_that_were_cut_off_below_white():
    cut = np.minimum(NOISY, 0.6 * NOISY.max())
    fit = pf.fit(SCENE, np.round(cut * 65535) / 65535)
    value = round(0.6 * NOISY.max() * 65535)
    assert said(fit, f"(the number {value} of 65535), and few lie just below it")
    assert "low-white" in map(pf.warning_code, fit.warnings)
    assert not said(pf.fit(SCENE, np.round(NOISY * 65535) / 65535), "largest value")


def test_a_bound_that_decides():
    fit = pf.fit(SCENE, NOISY, bounds={"shininess": (1, 15)})
    assert said(fit, "shininess lies at its upper bound 15: its error is one-sided")
    assert said(fit, "bounds={'shininess': (1, 75)}")
    assert said(fit, "The bound decides")
    # Light that is less than none: the model is wrong, and wider bounds are no remedy.
    dark = pf.fit(SCENE, NOISY - 0.1, film=pf.Film(clamp=False))
    assert said(dark, "ambient.blue lies at its lower bound 0")
    assert said(dark, "Look for light that is missing from the image")


def test_a_bound_that_chance_touches():
    """Reflectances that are 0 end there half of the time; then all else is right."""
    material = pf.Material(TRUTH.diffuse, TRUTH.specular, TRUTH.shininess, 0.0)
    light = np.asarray(pf.render(SCENE, material, film=pf.Film(clamp=False)))
    rng = np.random.default_rng(1)
    fits = [pf.fit(SCENE, light + NOISE * rng.normal(size=light.shape)) for _ in "12"]
    assert any(said(fit, "lies at its lower bound 0") for fit in fits)
    assert not any(said(fit, "decides") for fit in fits)


def test_noise_that_few_samples_know():
    light = pf.DirectionalLight((1, 1, 2))
    bright = pf.Scene(SCENE.surface, SCENE.camera, light, ambient=2.2)
    truth = pf.Material((0.6, 0.5, 0.4), 0.3, 10.0, 0.5)
    image = photograph(bright, truth, noise=0.1)
    assert np.mean(image[8:24, 8:24] == 1) > 0.9
    few = np.zeros(NOISY.shape[:2], bool)
    few[13:17, 14:17] = True
    assert said(pf.fit(bright, image), "samples are clipped: the noise is estimated")
    assert not said(pf.fit(bright, image, noise=0.1), "samples are clipped")
    # Few samples, of which none is clipped.
    assert not said(pf.fit(SCENE, NOISY, mask=few), "samples are clipped")
    # Where all is white another warning says so.
    assert not said(pf.fit(bright, np.ones_like(image)), "samples are clipped")


def test_a_white_image_is_said_to_be_white():
    fit = pf.fit(SCENE, np.ones_like(NOISY))
    assert fit.unidentified.all()
    assert said(fit, "all samples that are used are white")
    assert not said(fit, "no ambient light")
