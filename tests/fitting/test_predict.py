"""What a fit could know, before it: against fits of noisy photographs."""

import functools

import numpy as np
import pytest

import phongfit as pf
from phongfit.fitting.predict import Prediction
from tests.fitting import canonical
from tests.fitting.canonical import NOISE
from tests.fitting.scenes import PARAMETERS, as_vector, ball, photograph, truth
from tests.helpers import near

TRUTH = truth()

SCENE = ball()
FRONTAL = pf.Scene(
    pf.Sphere(),
    SCENE.camera,
    [pf.DirectionalLight((0, 0, 1), light) for light in (0.35, 0.25)],
    ambient=0.3,
)
MATTE = canonical.matte()


@functools.cache
def predicted() -> Prediction:
    return pf.predict_errors(SCENE, TRUTH, NOISE)


def test_it_is_what_a_fit_states():
    fit = canonical.two_directional().fit
    assert predicted().labels == fit.labels
    near(predicted().values, as_vector(TRUTH), 1e-5)
    # An error is that of the values found, and of the noise found.
    np.testing.assert_allclose(fit.errors, predicted().errors, rtol=0.15)
    assert predicted().n_samples == fit.n_samples
    assert not predicted().warnings and not predicted().unidentified.any()
    near(predicted().errors ** 2, np.diag(predicted().covariance), 1e-5)
    near(as_vector(predicted().stderr), predicted().errors, 1e-5)


@pytest.mark.extended
def test_it_is_what_happens():
    fits = [
        pf.fit(SCENE, photograph(SCENE, TRUTH, noise=NOISE, seed=seed))
        for seed in range(60)
    ]
    stated = np.mean([fit.errors for fit in fits], axis=0)
    np.testing.assert_allclose(stated, predicted().errors, rtol=0.02)
    spread = np.std([fit.values for fit in fits], axis=0)
    np.testing.assert_allclose(spread, predicted().errors, rtol=0.25)


def test_errors_grow_with_the_noise_and_fall_with_images():
    noisy = pf.predict_errors(SCENE, TRUTH, 3 * NOISE)
    # Near black the clamp takes its share.
    np.testing.assert_allclose(noisy.errors / predicted().errors, 3, rtol=0.05)
    fine = [pf.Film(bits=16)] * 2
    two = pf.predict_errors([SCENE] * 2, TRUTH, NOISE, film=fine)
    ratio = predicted().errors / two.errors
    np.testing.assert_allclose(ratio, 2**0.5, rtol=1e-3)


def test_a_film_for_each_scene():
    coarse, fine = pf.Film(bits=4), pf.Film(bits=12)
    errors = [
        pf.predict_errors([SCENE, SCENE], TRUTH, 1e-3, film=films).errors
        for films in ([fine, fine], [coarse, fine], [coarse, coarse])
    ]
    assert np.all(errors[0] < errors[1]) and np.all(errors[1] < errors[2])
    with pytest.raises(ValueError, match="film: expected 2, one for each scene, got 1"):
        pf.predict_errors([SCENE, SCENE], TRUTH, NOISE, film=[fine])


@pytest.mark.extended
def test_a_reflectance_at_its_bound():
    """Nothing pulls it there: what trades with it is as uncertain as in fits."""
    dark = pf.Material(TRUTH.diffuse, TRUTH.specular, 20.0, 0.0)
    predicted = pf.predict_errors(SCENE, dark, 2 * NOISE)
    off = [
        pf.fit(SCENE, photograph(SCENE, dark, noise=2 * NOISE, seed=seed)).values
        for seed in range(24)
    ] - predicted.values
    spread = np.sqrt(np.mean(np.square(off), axis=0))
    assert predicted.at_bound[:3].all()
    assert np.all(predicted.errors[3:6] > 0.8 * spread[3:6])
    assert np.all(predicted.errors < 2.2 * spread)


@pytest.mark.extended
def test_what_is_not_identifiable_is_named():
    predicted = pf.predict_errors(SCENE, MATTE, NOISE)
    assert predicted.unidentified[9] and np.isinf(predicted.errors[9])
    assert np.isinf(predicted.stderr.shininess)
    assert any("shininess is not identifiable" in words for words in predicted.warnings)
    text = str(predicted)
    assert text.startswith("phongfit: what ")
    assert "! shininess is not identifiable" in text


@pytest.mark.extended
@pytest.mark.parametrize("scene, times", [(FRONTAL, 5.0), (SCENE, 1.3)])
def test_errors_without_a_highlight_hold_for_any_exponent(scene, times):
    """At f = 1 and light from the viewer, a highlight is what Lambert's light is."""
    predicted = pf.predict_errors(scene, MATTE, NOISE)
    assert predicted.unidentified.tolist() == [False] * 9 + [True]
    held = {"shininess": 20.0, "specular": 0.0}
    one = pf.predict_errors(scene, MATTE, NOISE, fixed=held)
    assert np.all(predicted.errors[3:6] > times * one.errors[3:6])
    fits = [
        pf.fit(scene, photograph(scene, MATTE, noise=NOISE, seed=seed), noise=NOISE)
        for seed in range(12)
    ]
    off = np.array([fit.values for fit in fits])[:, :6] - predicted.values[:6]
    # Few fits stray far, where noise looks like a broad highlight.
    assert np.mean(np.abs(off) < 2 * predicted.errors[:6]) > 0.9


def test_options_are_those_of_a_fit():
    free = predicted()
    half = np.zeros((32, 32), bool)
    half[::2] = True
    masked = pf.predict_errors(SCENE, TRUTH, NOISE, mask=half)
    assert masked.n_samples < 0.6 * free.n_samples
    np.testing.assert_allclose(masked.errors / free.errors, 2**0.5, rtol=0.15)


@pytest.mark.extended
def test_fewer_unknowns_are_known_better():
    free = predicted()
    prior = pf.predict_errors(SCENE, TRUTH, NOISE, priors={"shininess": (20, 0.1)})
    expected = 1 / np.sqrt(1 / free.errors[9] ** 2 + 1 / 0.1**2)
    assert prior.errors[9] == pytest.approx(expected, rel=1e-3)
    fewer = pf.predict_errors(SCENE, TRUTH, NOISE, fixed={"diffuse": TRUTH.diffuse})
    assert fewer.labels == tuple(k for k in free.labels if "diffuse" not in k)
    assert np.all(fewer.errors < free.errors[[0, 1, 2, 6, 7, 8, 9]])
    tied = pf.predict_errors(
        SCENE, TRUTH, NOISE, unknowns=PARAMETERS[:2], per_channel=()
    )
    assert tied.labels == ("ambient", "diffuse")


@pytest.mark.parametrize(
    "options, error, words",
    [
        ({"gloss": 1}, TypeError, "'gloss', expected one of scene, material"),
        ({"known": TRUTH}, ValueError, "known: expected none"),
        ({"loss": "tukey"}, ValueError, "loss: expected its default"),
        ({"max_steps": 3}, ValueError, "max_steps: expected none"),
        ({"tolerance": 1e-3}, ValueError, "tolerance: expected none"),
        ({"film": []}, ValueError, "film: expected 1, one for each scene, got 0"),
    ],
)
def test_options_that_are_refused(options, error, words):
    with pytest.raises(error, match=words):
        pf.predict_errors(SCENE, TRUTH, NOISE, **options)


def test_the_specification_of_a_fit():
    asked = pf.Specification(known=pf.Material(), max_steps=3)
    same = pf.predict_errors(SCENE, TRUTH, NOISE, asked)
    np.testing.assert_array_equal(same.errors, predicted().errors)
    fewer = pf.predict_errors(SCENE, TRUTH, NOISE, asked, unknowns=("diffuse",))
    assert len(fewer.labels) == 3
