"""What a fit could know, before it: against fits of noisy photographs."""

from typing import Any

import numpy as np
import pytest

import phongfit as pf
from tests.fitting.scenes import LEAVES, TRUTH, as_vector, ball, photograph
from tests.helpers import near

SCENE = ball()
NOISE = 0.01


def test_it_is_what_fits_state_and_what_happens():
    predicted = pf.predict_errors(SCENE, TRUTH, NOISE)
    fits = [
        pf.fit(SCENE, photograph(SCENE, TRUTH, noise=NOISE, seed=seed))
        for seed in range(60)
    ]
    assert predicted.labels == fits[0].labels
    near(predicted.values, as_vector(TRUTH), 1e-5)
    # An error is that of the values found, and of the noise found.
    np.testing.assert_allclose(fits[0].errors, predicted.errors, rtol=0.15)
    stated = np.mean([fit.errors for fit in fits], axis=0)
    np.testing.assert_allclose(stated, predicted.errors, rtol=0.02)
    spread = np.std([fit.values for fit in fits], axis=0)
    np.testing.assert_allclose(spread, predicted.errors, rtol=0.25)
    assert predicted.samples == fits[0].samples
    assert not predicted.warnings and not predicted.untold.any()
    near(predicted.errors**2, np.diag(predicted.covariance), 1e-5)
    near(as_vector(predicted.stderr), predicted.errors, 1e-5)


def test_errors_grow_with_the_noise_and_fall_with_images():
    one = pf.predict_errors(SCENE, TRUTH, NOISE)
    noisy = pf.predict_errors(SCENE, TRUTH, 3 * NOISE)
    # Near black the clamp takes its share.
    np.testing.assert_allclose(noisy.errors / one.errors, 3, rtol=0.05)
    four = pf.predict_errors([SCENE] * 4, TRUTH, NOISE)
    np.testing.assert_allclose(one.errors / four.errors, 2, rtol=1e-3)


def test_what_could_not_be_told_is_named():
    matte = pf.Material(TRUTH.diffuse, 0.0, 20.0, TRUTH.ambient)
    predicted = pf.predict_errors(SCENE, matte, NOISE)
    assert predicted.untold[9] and np.isinf(predicted.errors[9])
    assert np.isinf(predicted.stderr.shininess)
    assert any("shininess cannot be told" in words for words in predicted.warnings)
    text = str(predicted)
    assert text.startswith("phongfit: what ") and "! shininess cannot" in text


def test_options_are_those_of_a_fit():
    free = pf.predict_errors(SCENE, TRUTH, NOISE)
    known = pf.predict_errors(SCENE, TRUTH, NOISE, fixed={"diffuse": TRUTH.diffuse})
    assert known.labels == tuple(k for k in free.labels if "diffuse" not in k)
    assert np.all(known.errors < free.errors[[0, 1, 2, 6, 7, 8, 9]])
    told = pf.predict_errors(SCENE, TRUTH, NOISE, priors={"shininess": (20, 0.1)})
    expected = 1 / np.sqrt(1 / free.errors[9] ** 2 + 1 / 0.1**2)
    assert told.errors[9] == pytest.approx(expected, rel=1e-3)
    half = np.zeros((32, 32), bool)
    half[::2] = True
    masked = pf.predict_errors(SCENE, TRUTH, NOISE, mask=half)
    assert masked.samples < 0.6 * free.samples
    np.testing.assert_allclose(masked.errors / free.errors, 2**0.5, rtol=0.15)
    tied = pf.predict_errors(SCENE, TRUTH, NOISE, unknowns=LEAVES[:2], per_channel=())
    assert tied.labels == ("ambient", "diffuse")


@pytest.mark.parametrize("name", ["loss", "max_steps", "gloss", "known"])
def test_options_that_are_none(name):
    options: dict[str, Any] = {name: 1}
    with pytest.raises(TypeError, match=name):
        pf.predict_errors(SCENE, TRUTH, NOISE, **options)
