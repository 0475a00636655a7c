import numpy as np
import pytest

from experiments.honesty.chance import coverage_limits, fraction, too_many
from experiments.honesty.judge import COVERAGE


@pytest.mark.parametrize("draws, parameters", [(6, 10), (20, 10), (100, 1), (100, 10)])
def test_right_ones_are_not_red(draws, parameters):
    rng = np.random.default_rng(0)
    counted = np.ones((draws, parameters), bool)
    for _ in range(500):
        inside = rng.random(counted.shape) < 0.95
        low, high = coverage_limits(inside, counted, COVERAGE)
        assert low <= fraction(inside) <= high


def test_parameters_that_go_astray_together_count_less():
    """Sixteen that are one are as good as one."""
    rng = np.random.default_rng(1)
    alone = rng.random((100, 1)) < 0.95
    together = np.repeat(alone, 16, axis=1)
    counted = np.ones(together.shape, bool)
    one = coverage_limits(alone, counted[:, :1], COVERAGE)[0]
    assert coverage_limits(together, counted, COVERAGE)[0] == pytest.approx(
        one, abs=0.02
    )
    apart = rng.random(together.shape) < 0.95
    assert coverage_limits(apart, counted, COVERAGE)[0] > one + 0.04


def test_many_draws_are_held_to_the_promise():
    inside = np.random.default_rng(2).random((4000, 10)) < 0.95
    counted = np.ones(inside.shape, bool)
    assert coverage_limits(inside, counted, COVERAGE) == pytest.approx(COVERAGE)
    assert coverage_limits(inside, ~counted, COVERAGE) == (0, 1)


def test_too_many():
    assert not too_many(7, 100, 0.01) and too_many(8, 100, 0.01)
    assert not too_many(110, 10_000, 0.01) and too_many(200, 10_000, 0.01)
    assert not too_many(0, 1, 0.01)


def test_a_share_of_nothing():
    assert np.isnan(fraction(np.ones(3, bool), np.zeros(3, bool)))
    assert fraction(np.array([True, False])) == 0.5
