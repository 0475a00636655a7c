import numpy as np
import pytest

import phongfit as pf
from tests.fitting import canonical
from tests.fitting.canonical import NOISE
from tests.fitting.scenes import ball, photograph, truth

TRUTH = truth()

SCENE = ball()
NOISY = photograph(SCENE, TRUTH, noise=NOISE)


def said(fit: pf.Fit, words: str) -> bool:
    assert all(map(pf.warning_code, fit.warnings))
    return any(words in warning for warning in fit.warnings)


@pytest.mark.parametrize("deviation", [1e-3, 0.5])
def test_a_prior_that_contradicts(deviation):
    """Whether it gives way to the images, or they to it."""
    solved, ties = canonical.priors_and_ties(), {"specular": (0.5, "diffuse")}
    priors = {"shininess": (40.0, deviation)}
    fit = pf.fit(SCENE, solved.image, ties=ties, priors=priors)
    assert fit.converged and not solved.fit.warnings
    assert said(fit, "the prior of shininess, 40 ±")


@pytest.mark.parametrize(
    "loss", ["linear", pytest.param("huber", marks=pytest.mark.extended)]
)
def test_noise_given_wrong(loss):
    plain = pf.fit(SCENE, NOISY, loss=loss)
    large = pf.fit(SCENE, NOISY, noise=3 * NOISE, loss=loss)
    assert large.noise == pytest.approx(3 * NOISE)
    assert not said(large, "noise that was given")
    small = pf.fit(SCENE, NOISY, noise=NOISE / 3, loss=loss)
    assert said(small, "3.0 times as large as the noise that was given")
    # Less noise than the image has is not believed.
    near = 0.02 if loss == "linear" else 0.15
    np.testing.assert_allclose(small.errors, plain.errors, rtol=near)
    if loss == "linear":
        np.testing.assert_allclose(large.errors / plain.errors, 3, rtol=0.05)
        assert small.reduced_chi_squared == pytest.approx(9, rel=0.1)


@pytest.mark.extended
def test_noise_given_right_beside_outliers():
    """A loss that bears them does not take them for noise."""
    image = canonical.with_garbage(NOISY, 0.05)
    assert not said(pf.fit(SCENE, image, noise=NOISE, loss="tukey"), "noise that was")


@pytest.mark.extended
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
    assert said(fit, "Without it the estimate would be")
    # Light that is less than none: the model is wrong, and wider bounds are no remedy.
    dark = pf.fit(SCENE, NOISY - 0.1, film=pf.Film(clamp=False))
    assert said(dark, "ambient.blue lies at its lower bound 0")
    assert said(dark, "Look for light that is missing from the image")


@pytest.mark.extended
def test_noise_that_few_samples_know():
    lights = [pf.DirectionalLight((1, 1, 2)), pf.DirectionalLight((0, 0, 1), 0.0)]
    bright = pf.Scene(SCENE.surface, SCENE.camera, lights, ambient=2.2)
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
