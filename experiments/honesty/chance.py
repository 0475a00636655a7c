"""Tests of fractions of few draws.

A fraction fails if it is beyond its limit and if sampling error would explain this, for
a fraction exactly at the limit, only once in `1 / CHANCE` judgements. A campaign makes
some hundred of them for each precision, nearly a thousand in all, so that less than one
campaign in a hundred fails by chance.
"""

import numpy as np
from jaxtyping import Bool
from scipy.stats import binom

from experiments.honesty.answers import LEVEL

CHANCE = 1e-5

Each = Bool[np.ndarray, "draws parameters"]


def share(held: np.ndarray, counted: np.ndarray | bool = True) -> float:
    """Fraction of the counted entries that hold; NaN if none is counted."""
    counted = np.broadcast_to(counted, held.shape)
    return float((held & counted).sum() / counted.sum()) if counted.any() else np.nan


def limits(
    inside: Each, counted: Each, promised: tuple[float, float]
) -> tuple[float, float]:
    """Range of the fraction of intervals with the truth, in which there is no fault.

    Parameters of one draw are correlated. The number of independent intervals is
    estimated from the scatter between draws.

    ??? cite "Source"
        Kish, *Survey sampling*, 1965, on the design effect: the variance of a share
        between clusters over a binomial one.
    """
    count = counted.sum()
    if count == 0:
        return 0.0, 1.0
    missed, each = (counted & ~inside).sum(axis=1), counted.sum(axis=1)
    rate = missed.sum() / count
    expected = count * rate * (1 - rate)
    together = np.sum((missed - rate * each) ** 2) / expected if expected > 0 else 1.0
    alone = max(int(count / max(together, 1.0)), 1)
    low = float(binom.ppf(CHANCE, alone, LEVEL)) / alone
    high = float(binom.isf(CHANCE, alone, LEVEL)) / alone
    return min(promised[0], low), max(promised[1], high)


def too_many(found: int, draws: int, promised: float) -> bool:
    """Whether so many draws are significantly more than the fraction `promised`."""
    return bool(found > max(promised * draws, binom.isf(CHANCE, draws, promised)))
