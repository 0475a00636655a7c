"""No finite error for what the image does not identify, and the reason in words."""

import numpy as np
import pytest

import phongfit as pf
from phongfit.codes import coded
from tests.fitting import canonical
from tests.fitting.scenes import SIZE, as_vector, ball, photograph, truth
from tests.helpers import near

TRUTH = truth()

NOISES = pytest.mark.parametrize("noise", [0.0, 0.01])
PLATE = canonical.plate_scene()
BALL = ball()
COLOURS = ("red", "green", "blue")


def check_unidentified(fit: pf.Fit, names: tuple[str, ...], words: str) -> None:
    """Exactly the parameters of these names have no finite error, for this reason."""
    unidentified = [label for label in fit.labels if label.split(".")[0] in names]
    assert np.array(fit.labels)[fit.unidentified].tolist() == unidentified
    assert np.array_equal(np.isinf(fit.errors), fit.unidentified)
    assert np.array_equal(np.isinf(np.diag(fit.covariance)), fit.unidentified)
    reasons = [warning for warning in fit.warnings if words in warning]
    assert reasons, fit.warnings
    assert all(any(label in reason for reason in reasons) for label in unidentified)
    for name in names:
        assert np.all(np.isinf(getattr(fit.stderr, name)))
    assert str(fit).count("not identifiable") >= len(unidentified)


@NOISES
def test_a_flat_plate(noise):
    """Parallel light, seen from far: one colour everywhere, ten unknowns."""
    fit = pf.fit(PLATE, photograph(PLATE, TRUTH, noise=noise))
    assert fit.converged
    names = ("ambient", "diffuse", "specular", "shininess")
    check_unidentified(
        fit, names, "are degenerate: they change the image in the same way"
    )
    assert np.abs(np.mean(fit.residuals)) < 1e-3


@pytest.mark.extended
def test_a_flat_plate_with_one_unknown():
    """What is left of it is identifiable, where the rest is known."""
    image = photograph(PLATE, TRUTH, noise=0.01)
    fit = pf.fit(PLATE, image, unknowns=("diffuse",), known=TRUTH)
    assert np.all(np.abs(fit.values - TRUTH.diffuse) < 4 * fit.errors)
    assert np.all(fit.errors < 1e-3) and not fit.warnings


@NOISES
def test_no_highlight(noise):
    fit = pf.fit(BALL, photograph(BALL, canonical.matte(), noise=noise))
    assert fit.converged
    check_unidentified(fit, ("shininess",), "shininess is not identifiable: ")
    assert np.all(fit.values[6:9] <= 4 * fit.errors[6:9])
    assert any("specular is 0" in warning for warning in fit.warnings)


@NOISES
def test_no_ambient_light(noise):
    scene = ball(ambient=0.0)
    fit = pf.fit(scene, photograph(scene, TRUTH, noise=noise))
    assert fit.converged
    check_unidentified(
        fit, ("ambient",), "no ambient light falls on a pixel that is used"
    )
    others = np.abs(fit.values - as_vector(TRUTH))[3:]
    assert np.all(others < np.maximum(4.5 * fit.errors[3:], 1e-4))


@pytest.mark.extended
@NOISES
def test_a_highlight_that_is_masked(noise):
    """Whatever f is, if it is large: ρ_s may be anything."""
    shiny = pf.Material(TRUTH.diffuse, TRUTH.specular, 300.0, TRUTH.ambient)
    mirror = pf.Material(0.0, 1.0, 300.0, 0.0)
    seen = np.asarray(pf.render(ball(ambient=0.0), mirror)).max(axis=-1) > 1e-7
    assert 10 < seen.sum() < 300
    fit = pf.fit(BALL, photograph(BALL, shiny, noise=noise), mask=~seen)
    check_unidentified(fit, ("specular", "shininess"), "not identifiable")


def test_an_image_in_other_units():
    """A millionth of white: nothing is as bright as its numbers could be."""
    image = photograph(ball(), TRUTH, noise=0.01, film=pf.Film(clamp=False))
    fit, dark = pf.fit(BALL, image), pf.fit(BALL, 1e-6 * image)
    assert not dark.warnings and not dark.unidentified.any()
    scale = np.where(np.arange(10) < 9, 1e-6, 1)
    near(dark.values / scale, fit.values, 3e-3)
    near(dark.errors / scale, fit.errors, 3e-3)


def test_everything_is_black():
    fit = pf.fit(BALL, np.zeros((SIZE, SIZE, 3)), film=pf.Film())
    assert fit.converged
    assert fit.at_bound[:9].all() and fit.unidentified[9]
    assert np.all(fit.values[:9] == 0)
    assert np.all(fit.errors[:9] < 0.01)


def test_everything_is_white():
    """Light may be white, or any amount brighter."""
    fit = pf.fit(BALL, np.ones((SIZE, SIZE, 3)), film=pf.Film())
    assert fit.unidentified.all() and np.all(np.isinf(fit.errors))
    (warning,) = fit.warnings
    assert "all samples that are used are white" in warning


@pytest.mark.extended
def test_nearly_everything_is_white():
    """A few pixels below white tell little, and no more than that is stated."""
    bright = pf.Material((0.9, 0.8, 0.7), 0.5, 20.0, 1.0)
    lights = [pf.DirectionalLight((1, 1, 2), 3.0), pf.DirectionalLight((-1, 0, 1), 2.0)]
    scene = pf.Scene(pf.Sphere(), BALL.camera, lights, ambient=0.9)
    image = photograph(scene, bright, noise=0.01)
    assert 0 < np.mean(image[np.asarray(scene.trace().mask)] < 1) < 0.1
    fit = pf.fit(scene, image)
    assert fit.unidentified[6:].all() and np.array_equal(
        np.isinf(fit.errors), fit.unidentified
    )
    truth = np.array([1.0, 1.0, 1.0, 0.9, 0.8, 0.7, 0.5, 0.5, 0.5, 20.0])
    identified = ~fit.unidentified & ~fit.at_bound
    assert np.all(np.abs(fit.values - truth)[identified] < 4.5 * fit.errors[identified])


@pytest.mark.extended
def test_ambient_and_emission_under_different_ambient_light():
    """One constant in one image, two in two."""
    truth = pf.Material(TRUTH.diffuse, TRUTH.specular, 20.0, 0.5, (0.05, 0.1, 0.15))
    scenes = [ball(ambient=ambient) for ambient in (0.1, 0.4)]
    images = [
        photograph(scene, truth, noise=0.01, seed=k) for k, scene in enumerate(scenes)
    ]
    fit = pf.fit(
        scenes,
        images,
        unknowns=("ambient", "diffuse", "specular", "shininess", "emission"),
        per_channel=("diffuse", "specular", "emission"),
    )
    assert fit.converged and not fit.unidentified.any()
    off = np.asarray(fit.material.emission) - np.asarray(truth.emission)
    assert np.all(np.abs(off) < 4 * np.asarray(fit.stderr.emission))
    assert abs(float(fit.material.ambient) - 0.5) < 4 * float(fit.stderr.ambient)


def test_a_bound_that_binds_is_marked():
    truth = pf.Material((0.6, 0.3, 0.0), TRUTH.specular, 20.0, TRUTH.ambient)
    offs, bound = [], []
    for seed in range(24):
        fit = pf.fit(BALL, photograph(BALL, truth, noise=0.01, seed=seed))
        assert fit.converged and not fit.unidentified.any()
        assert not np.delete(fit.at_bound, 5).any()
        bound.append(bool(fit.at_bound[5]))
        offs.append((fit.values - as_vector(truth)) / fit.errors)
        words = "diffuse.blue lies at its lower bound 0: its error is one-sided"
        words = coded("at-bound", words)
        assert (words in fit.warnings) == bound[-1]
        assert not any("decides" in warning for warning in fit.warnings)
        if bound[-1]:
            assert fit.values[5] == 0
            assert np.all(np.isnan(fit.covariance[5]))
            assert "at its bound" in str(fit)
            assert 0.0005 < fit.errors[5] < 0.01
    # Noise pulls it below 0 every second time.
    assert 4 < sum(bound) < 20
    assert np.all(np.abs(offs) < 4.5)


def test_the_upper_bound_too():
    truth = pf.Material(TRUTH.diffuse, (1.0, 0.8, 0.9), 20.0, TRUTH.ambient)
    fit = pf.fit(BALL, photograph(BALL, truth))
    assert np.flatnonzero(fit.at_bound).tolist() in ([6], [])
    tight = pf.fit(BALL, photograph(BALL, truth), bounds={"specular": (0, 0.85)})
    assert np.flatnonzero(tight.at_bound).tolist() == [6, 8]
    assert tight.values[6] == tight.values[8] == np.float32(0.85) or (
        tight.values[6] == tight.values[8] == 0.85
    )


@pytest.mark.parametrize("colour", range(3))
def test_one_channel_without_light(colour):
    """A light that lacks a colour says nothing of the reflectance there."""
    intensity = np.full(3, 0.5)
    intensity[colour] = 0
    lights = [pf.DirectionalLight(at, intensity) for at in ((1, 1, 2), (-1, 0.3, 1))]
    scene = pf.Scene(pf.Sphere(), BALL.camera, lights, 0.3)
    fit = pf.fit(scene, photograph(scene, TRUTH, noise=0.01))
    expected = [f"{name}.{COLOURS[colour]}" for name in ("diffuse", "specular")]
    assert np.array(fit.labels)[fit.unidentified].tolist() == expected
