import numpy as np
import pytest

import phongfit as pf
from phongfit.fitting.problem.losses import LOSSES
from phongfit.fitting.uncertainty.misfit import SIGNIFICANT
from tests.fitting.scenes import ball, photograph, truth
from tests.helpers import floats

pytestmark = pytest.mark.extended

TRUTH = truth()

LINEAR = ("ambient", "diffuse", "specular")


def shot_noise(light):
    return np.sqrt(4e-4 * light + 1e-6)


def red_noise(light):
    return np.broadcast_to(0.003 * np.array([3.0, 1.0, 1.0]), light.shape)


def asked(scene, clean, level, *, loss="linear", seed=0):
    """A photograph's fit whose exponent is known: the model is linear."""
    rng = np.random.default_rng(seed)
    image = clean + level * rng.normal(size=clean.shape)
    film = pf.Film(clamp=False)
    return pf.fit(scene, image, unknowns=LINEAR, known=TRUTH, film=film, loss=loss)


def basis(scene):
    """Light of each reflectance of 1 in one channel, (pixels, 3)."""
    kinds = np.eye(3)
    columns = [
        pf.render(
            scene, pf.Material(d, s, TRUTH.shininess, a), film=pf.Film(clamp=False)
        )
        for a, d, s in kinds
    ]
    return np.stack([np.asarray(one, float)[..., 0].ravel() for one in columns], axis=1)


def check_errors(fit, color, expected):
    """Of one channel's reflectances, as well as a line through squares is known."""
    labels = [f"{name}.{color}" for name in LINEAR]
    errors = [fit.errors[fit.labels.index(label)] for label in labels]
    # The correction for leverage makes errors of few pixels slightly too large.
    np.testing.assert_allclose(errors, expected, rtol=0.25)


@pytest.mark.parametrize("level", [shot_noise, red_noise])
def test_errors_where_noise_is_not_the_same_everywhere(level):
    scene = ball()
    clean = np.asarray(photograph(scene, TRUTH), float)
    fit = asked(scene, clean, level(clean))
    assert fit.misfit.unequal > SIGNIFICANT and not fit.warnings
    columns = basis(scene)
    seen = columns.any(axis=1)
    columns, variance = columns[seen], (level(clean) ** 2).reshape(-1, 3)[seen]
    inverse = np.linalg.inv(columns.T @ columns)
    for channel, color in enumerate(("red", "green", "blue")):
        meat = columns.T @ (columns * variance[:, channel, None])
        expected = np.sqrt(np.diag(inverse @ meat @ inverse))
        check_errors(fit, color, expected)


def test_a_noisy_channel_under_a_robust_loss():
    """The loss is less steep there: Huber's sandwich, with a slope of its own."""
    scene = ball()
    clean = np.asarray(photograph(scene, TRUTH), float)
    level = red_noise(clean)
    fit = asked(scene, clean, level, loss="tukey")
    columns = basis(scene)
    inverse = np.linalg.inv(columns.T @ columns)
    drawn = np.random.default_rng(1).normal(size=200_000)
    for channel, color in enumerate(("red", "green", "blue")):
        times = level[0, 0, channel] / fit.noise
        score, slope = map(np.asarray, LOSSES["tukey"].score(floats(times * drawn)))
        deviation = fit.noise * np.sqrt(np.mean(score**2)) / np.mean(slope)
        expected = deviation * np.sqrt(np.diag(inverse))
        check_errors(fit, color, expected)


def test_noise_that_is_the_same_everywhere():
    scene = ball()
    clean = np.asarray(photograph(scene, TRUTH), float)
    flat = np.full(clean.shape, 0.01)
    found = [asked(scene, clean, flat, seed=seed).misfit.unequal for seed in range(40)]
    # Normally distributed, of two that are looked at the larger one.
    assert max(found) < 3.5
    assert -0.5 < np.mean(found) < 1
