"""Quantiles, against SciPy's distributions."""

import math

import pytest
from scipy import stats

from phongfit.fitting.uncertainty.quantiles import (
    chi_squared_reach,
    fisher_quantile,
    student_reach,
    two_for_one,
)


@pytest.mark.parametrize("freedom", [1, 4, 100, 10**6])
def test_student_and_fisher(freedom):
    low, high = stats.t.interval(0.9, freedom)
    assert student_reach(0.9, freedom) == pytest.approx(high) == pytest.approx(-low)
    assert fisher_quantile(0.9, 3, freedom) == pytest.approx(
        stats.f.ppf(0.9, 3, freedom)
    )


def test_none_is_fewer_than_one_degree_of_freedom():
    assert student_reach(0.9, 0) == student_reach(0.9, 1)
    assert fisher_quantile(0.9, 2, -3) == fisher_quantile(0.9, 2, 1)


@pytest.mark.parametrize(
    "count, deviations, most",
    [(3, 2, 1.01), (3, 4, 1.05), (3, 6, 1.13), (10, 4, 1.02), (10, 6, 1.05)],
)
def test_as_rare_as_so_many_deviations(count, deviations, most):
    exact = stats.chi2.isf(stats.norm.sf(deviations), count)
    assert 0.99 * exact < chi_squared_reach(deviations, count) < most * exact
    assert chi_squared_reach(deviations, 1) == deviations**2


@pytest.mark.parametrize("level", [1.0, 4.0, 9.0, 400.0])
def test_two_numbers_for_one(level):
    log_chance = math.log(2) + stats.norm.logsf(math.sqrt(level))
    assert two_for_one(level) == pytest.approx(-2 * log_chance, rel=1e-6)


def test_far_out_it_still_is_a_number():
    assert two_for_one(1e4) == 1e4
