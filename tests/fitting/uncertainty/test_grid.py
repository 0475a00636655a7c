import jax
import numpy as np
import pytest

from phongfit.fitting.uncertainty.grid import (
    SIGNIFICANT,
    grid_significance,
    sum_at_places,
)

summed = jax.jit(sum_at_places)


def significance(residual, used=None):
    used = np.ones(residual.shape, bool) if used is None else used
    return grid_significance([np.asarray(summed(residual, used))])


def residuals(kind, seed=0):
    """Noise, and what images may leave that were never cut into blocks."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(64, 64, 3))
    y, x = np.mgrid[:64, :64][:, :, :, None]
    if kind == "trend":
        return noise * (1 + x / 16)
    if kind == "edge":
        return noise + 3 * (x >= 24)
    if kind == "stripes":
        return noise + 3 * (x // 8 % 2)
    if kind == "squares":
        return noise + 3 * ((x // 5 + y // 5) % 2)
    return noise


@pytest.mark.parametrize("kind", ["noise", "trend", "edge", "stripes", "squares"])
def test_images_that_were_never_cut_into_blocks(kind):
    assert max(significance(residuals(kind, seed)) for seed in range(20)) < SIGNIFICANT


@pytest.mark.parametrize("cut", [0, 3])
@pytest.mark.parametrize("channels", [1, 3])
def test_blocks_show_wherever_they_begin(cut, channels):
    rng = np.random.default_rng(0)
    steps = rng.normal(size=(8, 8, channels)).repeat(8, axis=0).repeat(8, axis=1)
    image = steps + 0.2 * rng.normal(size=(64, 64, 3))
    assert significance(image[cut:, cut:]) > SIGNIFICANT


def test_too_little_says_nothing():
    used = np.zeros((64, 64, 3), bool)
    used[20:32, 20:32] = True
    assert significance(residuals("noise"), used) == 0
    assert significance(residuals("noise")[:10, :10]) == 0
