"""Garbage, shadows and priors: what must move a fit, and what must not."""

from typing import Any

import numpy as np
import pytest

import phongfit as pf
from tests.fitting import canonical
from tests.fitting.canonical import NOISE
from tests.fitting.scenes import as_vector, ball, photograph, truth

TRUTH = truth()

SCENE = ball()
NOISY = photograph(SCENE, TRUTH, noise=NOISE)


def shadow() -> np.ndarray:
    """A block of pixels that no light reaches, unknown to the model."""
    image = NOISY.copy()
    image[10:20, 4:14] *= 0.2
    return image


# Without a fifth of the pixels a fit moves by about a standard error, 2 % of its value.
# A shadow errs to one side only. Tukey's loss forgets it; to Huber's and its smooth
# form every pixel of it goes on pulling, and the limits bound that bias.
@pytest.mark.parametrize(
    "loss, garbage_limit, shadow_limit",
    [
        ("tukey", 0.04, 0.02),
        pytest.param("huber", 0.12, 0.25, marks=pytest.mark.extended),
        pytest.param("cauchy", 0.04, 0.05, marks=pytest.mark.extended),
        pytest.param("soft_l1", 0.12, 0.35, marks=pytest.mark.extended),
    ],
)
def test_what_is_not_of_the_model_hardly_moves_a_fit(loss, garbage_limit, shadow_limit):
    clean = pf.fit(SCENE, NOISY, loss=loss)
    assert np.all(np.abs(clean.values - as_vector(TRUTH)) < 4.5 * clean.errors)
    # Without any garbage, next to nothing is lost.
    free = canonical.two_directional().fit
    assert np.all(np.abs(clean.errors / free.errors - 1) < 0.15)
    for image, limit in (
        (canonical.with_garbage(NOISY), garbage_limit),
        (shadow(), shadow_limit),
    ):
        fit = pf.fit(SCENE, image, loss=loss)
        assert fit.converged and fit.loss.lower() == loss.replace("_", "")
        assert fit.noise < 2 * NOISE
        moved = np.abs(fit.values / clean.values - 1)
        assert np.all(moved < limit), dict(zip(fit.labels, moved, strict=True))
        # Least squares are moved, so the test says something.
        plain = pf.fit(SCENE, image)
        assert np.max(np.abs(plain.values / clean.values - 1)) > 0.15


def test_least_squares_take_garbage_for_noise():
    fit = pf.fit(SCENE, canonical.with_garbage(NOISY))
    assert np.max(np.abs(fit.values / as_vector(TRUTH) - 1)) > 0.3
    assert fit.noise > 10 * NOISE


def test_a_prior_counts_as_one_more_measurement():
    """A linear problem of two unknowns: Gaussians multiply."""
    names = ("ambient", "diffuse")
    options: dict[str, Any] = dict(
        known=TRUTH, unknowns=names, per_channel=(), noise=0.01
    )
    truth = pf.Material(0.4, TRUTH.specular, TRUTH.shininess, 0.5)
    image = photograph(SCENE, truth, noise=0.01, film=pf.Film(clamp=False))
    mean, deviation = 0.41, 0.002
    # As good as no prior, but compiled like one.
    free, held = (
        pf.fit(
            SCENE,
            image,
            film=pf.Film(clamp=False),
            priors={"diffuse": (mean, known)},
            **options,
        )
        for known in (1e6, deviation)
    )
    known = np.diag([0, deviation**-2])
    precision = np.linalg.inv(free.covariance) + known
    covariance = np.linalg.inv(precision)
    shift = covariance @ known @ (np.array([0, mean]) - free.values)
    np.testing.assert_allclose(held.covariance, covariance, rtol=2e-3)
    np.testing.assert_allclose(held.values, free.values + shift, rtol=1e-4)
    assert held.degrees_of_freedom == held.n_samples - 2 + 1
    pull = (held.values[1] - mean) / deviation
    lost = shift @ np.linalg.solve(free.covariance, shift)
    assert held.chi_squared - free.chi_squared == pytest.approx(
        pull**2 + lost, rel=0.01, abs=0.05
    )


@pytest.mark.extended
def test_a_prior_tells_what_the_image_does_not():
    """Exposure and reflectances are one scale, until one of them is known."""
    matte = pf.Material(TRUTH.diffuse, 0.0, 20.0, TRUTH.ambient)
    predicted = pf.predict_errors(
        SCENE,
        matte,
        0.01,
        unknowns=("diffuse", "ambient", "exposure"),
        priors={"exposure": (1.0, 0.05)},
    )
    assert not predicted.unidentified.any() and not predicted.warnings
    np.testing.assert_allclose(predicted.errors[-1], 0.05, rtol=1e-3)
    relative = predicted.errors[3:6] / np.asarray(TRUTH.diffuse)
    assert np.all((relative > 0.05) & (relative < 0.06))


def test_parts_of_a_result():
    fit = canonical.two_directional().fit
    leaf, one = fit["diffuse"], fit["diffuse.red"]
    assert leaf.value.shape == leaf.error.shape == (3,)
    np.testing.assert_array_equal(leaf.value, fit.values[3:6])
    assert (one.value, one.error) == (fit.values[3], fit.errors[3])
    assert not one.at_bound and not one.unidentified
    assert fit["shininess"].value == fit.values[9]
    for name in ("gloss", "diff", "diffuse.", "diffuse.red.x", ""):
        with pytest.raises(KeyError, match="expected one of ambient.red, "):
            fit[name]
    low, high = fit.intervals(0.6827).T
    np.testing.assert_allclose(high - low, 2 * fit.errors, rtol=1e-3)
    low, high = fit.intervals().T
    np.testing.assert_allclose(high - low, 2 * 1.96 * fit.errors, rtol=1e-3)
    for level in (0.0, 1.0, 95, np.nan):
        with pytest.raises(ValueError, match="level: "):
            fit.intervals(level)


@pytest.mark.extended
def test_a_shadow_over_the_highlight_leaves_the_search_global():
    """Half of the samples that a search began with lay in it: f was 105, ρ_s 0."""
    scene = pf.Scene(
        pf.Sphere(),
        pf.OrthographicCamera(96, 96),
        pf.DirectionalLight((-0.4, 0.5, 1.2), 0.8),
        ambient=0.2,
    )
    truth = pf.Material((0.3, 0.5, 0.4), (0.5, 0.4, 0.3), 4.0, (0.4, 0.6, 0.7))
    image = photograph(scene, truth, noise=0.002)
    rows, columns, _ = np.unravel_index(np.argmax(image), image.shape)
    image[rows - 15 : rows + 15, columns - 12 : columns + 13] *= 0.2
    fit = pf.fit(scene, image, loss="huber")
    assert fit["shininess"].value == pytest.approx(4.0, rel=0.2)
