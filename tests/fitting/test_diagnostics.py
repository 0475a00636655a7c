import numpy as np
import pytest

from phongfit.fitting.diagnostics import (
    all_neighbours,
    compare_neighbours,
    neighbour_correlation,
    variance_inflation,
)


def noise(shape=(60, 60, 3), seed=0):
    return np.random.default_rng(seed).normal(size=shape)


def correlation_of(residuals, used):
    """Of residuals (H, W, 3) each, where they are used."""
    images = [
        compare_neighbours(np.where(mask, one, 0), mask)
        for one, mask in zip(residuals, used, strict=True)
    ]
    return neighbour_correlation(all_neighbours(images))


def test_independent_noise():
    everywhere = np.ones((60, 60, 3), bool)
    for seed in range(10):
        assert abs(correlation_of([noise(seed=seed)], [everywhere])) == 0


def test_mean_of_neighbours_correlates():
    white = noise((61, 61, 3))
    # A 2 × 2 mean shares half of its pixels with the one beside it.
    smooth = (white[1:, 1:] + white[:-1, 1:] + white[1:, :-1] + white[:-1, :-1]) / 4
    correlation = correlation_of([smooth], [np.ones_like(smooth, bool)])
    assert correlation == pytest.approx(0.5, abs=0.03)


def test_checkerboard_is_negative():
    board = np.indices((20, 20)).sum(axis=0) % 2 * 2.0 - 1
    board = np.repeat(board[..., None], 3, axis=-1)
    assert correlation_of([board], [np.ones_like(board, bool)]) == -1


def test_only_pairs_inside_the_mask_count():
    # A constant in every second column: no pixel there has a neighbour to its side.
    residual = np.ones((30, 30, 3))
    used = np.zeros_like(residual, bool)
    used[:, ::2] = True
    rows = np.where(np.arange(30) % 2, 1.0, -1.0)[:, None, None] * residual
    assert correlation_of([rows], [used]) == -1
    used[::2] = False
    assert correlation_of([residual], [used]) == 0


def test_several_images_count_together():
    flat, white = np.ones((40, 40, 3)), noise((40, 40, 3))
    both = [np.ones_like(flat, bool)] * 2
    assert correlation_of([flat, white], both) == pytest.approx(0.5, abs=0.05)


def test_nothing_left():
    nothing = [np.zeros((5, 5, 3))]
    assert correlation_of(nothing, [np.ones((5, 5, 3), bool)]) == 0
    assert correlation_of(nothing, [np.zeros((5, 5, 3), bool)]) == 0


@pytest.mark.parametrize(
    "correlation, factor", [(-0.5, 1), (0, 1), (0.5, 9), (1 / 3, 4), (1, 199**2)]
)
def test_inflation(correlation, factor):
    assert variance_inflation(correlation) == pytest.approx(factor)


def test_inflation_is_that_of_an_autoregressive_image():
    """The variance of the mean of correlated pixels, against independent ones."""
    rng = np.random.default_rng(3)
    c, size, means = 0.5, 60, []
    for _ in range(400):
        image = rng.normal(size=(size + 20, size + 20)) * (1 - c**2)
        for k in range(1, size + 20):
            image[k] += c * image[k - 1]
        for k in range(1, size + 20):
            image[:, k] += c * image[:, k - 1]
        means.append(image[20:, 20:].mean())
    variance = np.var(means) * size**2
    assert variance == pytest.approx(variance_inflation(c), rel=0.25)
