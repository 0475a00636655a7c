"""Statistical tests of fractions, with limits that allow for the number of draws.

A fraction fails if it is beyond its limit by more than sampling error explains: if the
true fraction were exactly at the limit, one test in `1 / CHANCE` would fail. A campaign
makes nearly a thousand tests, so less than one campaign in a hundred fails by chance.
"""

import numpy as np
from jaxtyping import Bool
from scipy.stats import binom

from experiments.honesty.answers import LEVEL

CHANCE = 1e-5
"""Probability that a test fails by chance."""

Each = Bool[np.ndarray, "draws parameters"]
"""A mark of every number: true or false for each draw and parameter."""


def fraction(holds: np.ndarray, counted: np.ndarray | bool = True) -> float:
    """Fraction of the counted entries where `holds` is true; NaN if none is counted.

    **Arguments:** `counted`: of the shape of `holds`; `True` counts all.
    """
    counted = np.broadcast_to(counted, holds.shape)
    return float((holds & counted).sum() / counted.sum()) if counted.any() else np.nan


def coverage_limits(
    inside: Each, counted: Each, nominal: tuple[float, float]
) -> tuple[float, float]:
    """Smallest and largest coverage that is no fault: `nominal`, widened for few draws.

    Coverage is the fraction of the counted 95 % intervals that contain the truth. The
    limits are widened to the quantiles of a binomial fraction of mean 95 %.

    Parameters of one draw are correlated, so the number of independent intervals is
    estimated from the scatter between draws.

    **Arguments:** `inside`: whether an interval contains the truth; `counted`: whether
    it counts; `nominal`: limits for many draws.

    ??? cite "Source"
        Kish, *Survey sampling*, 1965, on the design effect: the variance of a
        fraction between clusters over a binomial one.
    """
    count = counted.sum()
    if count == 0:
        return 0.0, 1.0
    missed, each = (counted & ~inside).sum(axis=1), counted.sum(axis=1)
    rate = missed.sum() / count
    expected = count * rate * (1 - rate)
    overdispersion = (
        np.sum((missed - rate * each) ** 2) / expected if expected > 0 else 1.0
    )
    n_independent = max(int(count / max(overdispersion, 1.0)), 1)
    low = float(binom.ppf(CHANCE, n_independent, LEVEL)) / n_independent
    high = float(binom.isf(CHANCE, n_independent, LEVEL)) / n_independent
    return min(nominal[0], low), max(nominal[1], high)


def too_many(count: int, draws: int, nominal: float) -> bool:
    """Whether `count` of `draws` is significantly more than the fraction `nominal`."""
    return bool(count > max(nominal * draws, binom.isf(CHANCE, draws, nominal)))
