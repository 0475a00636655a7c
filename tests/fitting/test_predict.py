"""What a fit could know, before it: against fits of noisy photographs."""

import dataclasses
import functools
from typing import Any

import numpy as np
import pytest

import phongfit as pf
from phongfit.fitting.fit import set_up
from phongfit.fitting.predict import Prediction
from phongfit.fitting.problem.samples import seen_pixels
from phongfit.fitting.problem.specification import Specification
from phongfit.fitting.solve.start import choose_few
from phongfit.fitting.uncertainty import scatter
from tests.fitting import canonical
from tests.fitting.canonical import NOISE
from tests.fitting.scenes import PARAMETERS, as_vector, ball, photograph, truth
from tests.helpers import known, near

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
def test_what_is_not_identifiable_is_named(few_draws):
    predicted = pf.predict_errors(SCENE, MATTE, NOISE)
    assert predicted.unidentified[9] and np.isinf(predicted.errors[9])
    assert np.isinf(predicted.stderr.shininess)
    assert any("shininess is not identifiable" in words for words in predicted.warnings)
    assert any("those of 60 drawn fits" in words for words in predicted.warnings)
    near(predicted.errors[:6] ** 2, np.diag(predicted.covariance)[:6], 1e-5)
    text = str(predicted)
    assert text.startswith("phongfit: what ")
    assert "! shininess is not identifiable" in text


@pytest.fixture
def few_draws(monkeypatch):
    monkeypatch.setattr(scatter, "DRAWS", 60)


def check_like_fits(
    scene: pf.Scene, material: pf.Material, count: int, noise: float | None = None
) -> None:
    """What is predicted of ρ_a and ρ_d is what so many fits are off by."""
    predicted = pf.predict_errors(scene, material, NOISE)
    assert predicted.unidentified.tolist() == [False] * 9 + [True]
    off = []
    for seed in range(count):
        image = photograph(scene, material, noise=NOISE, seed=seed)
        off.append(pf.fit(scene, image, noise=noise).values - predicted.values)
    spread = np.sqrt(np.mean(np.square(off), axis=0))
    # Some fits stray far, and how many is chance. At one exponent errors are up to 20
    # times too small.
    np.testing.assert_allclose(predicted.errors[:6], spread[:6], rtol=0.6)


@pytest.mark.slow
@pytest.mark.parametrize("scene", [FRONTAL, SCENE])
@pytest.mark.parametrize("specular", [0.0, 0.002])
def test_without_a_highlight_errors_are_those_that_fits_make(scene, specular):
    material = dataclasses.replace(MATTE, specular=np.full(3, specular))
    check_like_fits(scene, material, 200, NOISE)


@pytest.mark.extended
def test_so_they_are_in_a_few_draws(few_draws):
    check_like_fits(SCENE, MATTE, 40)


@pytest.mark.extended
@pytest.mark.parametrize("scene, times", [(FRONTAL, 5.0), (SCENE, 1.3)])
def test_errors_at_one_exponent_are_too_small(few_draws, scene, times):
    """At f = 1 and light from the viewer, a highlight is what Lambert's light is."""
    open_end = pf.predict_errors(scene, MATTE, NOISE)
    held = {"shininess": 20.0, "specular": 0.0}
    one = pf.predict_errors(scene, MATTE, NOISE, fixed=held)
    assert np.all(open_end.errors[3:6] > times * one.errors[3:6])
    assert any("those of 60 drawn fits" in words for words in open_end.warnings)
    near(open_end.errors[:6] ** 2, np.diag(open_end.covariance)[:6], 1e-5)


def test_of_many_pixels_a_few_stand_for_all():
    scene = ball(size=64)
    (source,) = set_up(Specification(), scene, photograph(scene, MATTE)).sources
    (seen,) = seen_pixels([source])
    (few,) = known(choose_few([source], [seen]))
    weight = np.asarray(scatter._stands_for(source, seen, few).weight).reshape(-1, 1)
    used = np.unique(few)
    assert len(used) < 0.5 * len(seen)
    near(weight[used].sum(axis=0), len(seen), 1e-5)
    # In each part of the image as in all of it.
    upper = seen // 64 < 32
    top = weight[used[used // 64 < 32]].sum(axis=0)
    np.testing.assert_allclose(top, upper.sum(), rtol=0.05)


@pytest.mark.slow
def test_their_errors_are_those_of_all():
    """The same light, on four times the pixels: half the errors."""
    small, large = (
        pf.predict_errors(ball(size=size), MATTE, NOISE).errors[:6] for size in (40, 80)
    )
    np.testing.assert_allclose(small / large, 2, rtol=0.25)


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


@pytest.mark.parametrize("name", ["loss", "max_steps", "gloss", "known"])
def test_options_that_are_none(name):
    options: dict[str, Any] = {name: 1}
    with pytest.raises(TypeError, match=name):
        pf.predict_errors(SCENE, TRUTH, NOISE, **options)
