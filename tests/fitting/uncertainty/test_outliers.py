"""Samples that are not of the model: a warning where they pull, silence where not."""

import numpy as np
import pytest

import phongfit as pf
from tests.fitting import canonical
from tests.fitting.canonical import with_garbage
from tests.fitting.scenes import ball, photograph, truth

TRUTH = truth()

SCENE = ball()
NOISY = photograph(SCENE, TRUTH, noise=0.01)


def blackened(share: float) -> np.ndarray:
    """Some pixels replaced by black."""
    hit = np.random.default_rng(0).random((*NOISY.shape[:2], 1)) < share
    return np.where(hit, 0.0, NOISY)


def outlier_warnings(image: np.ndarray, loss: str = "linear") -> list[str]:
    fit = pf.fit(SCENE, image, loss=loss)
    return [words for words in fit.warnings if words.startswith("outliers: ")]


# Many outliers hide behind one another: least squares go where they are.
@pytest.mark.parametrize(
    "image", [with_garbage(NOISY, 0.02), with_garbage(NOISY), blackened(0.2)]
)
def test_least_squares_say_that_outliers_pull(image):
    (words,) = outlier_warnings(image)
    assert 'loss="cauchy"' in words and "mask" in words


@pytest.mark.extended
def test_a_loss_that_goes_on_listening_says_so():
    (words,) = outlier_warnings(with_garbage(NOISY), "huber")
    assert 'try loss="tukey"' in words


@pytest.mark.parametrize(
    "loss",
    [
        "linear",
        pytest.param("tukey", marks=pytest.mark.extended),
        pytest.param("huber", marks=pytest.mark.extended),
    ],
)
def test_noise_is_no_outlier(loss):
    assert not outlier_warnings(NOISY, loss)


@pytest.mark.extended
def test_what_the_loss_rejects_pulls_no_more():
    assert not canonical.robust().fit.warnings


@pytest.mark.parametrize("kind", ["uniform", "poisson", "clipped"])
def test_noise_of_other_kinds_is_no_outlier(kind):
    rng = np.random.default_rng(1)
    light = photograph(SCENE, TRUTH)
    if kind == "uniform":
        image = light + 0.02 * (rng.random(light.shape) - 0.5)
    elif kind == "poisson":
        image = light + 0.02 * np.sqrt(light) * rng.normal(size=light.shape)
    else:
        image = np.clip(light + 0.1 * rng.normal(size=light.shape), 0, 1)
    assert not outlier_warnings(image)
