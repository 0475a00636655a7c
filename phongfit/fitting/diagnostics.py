"""Is it noise, or is it there? Residuals that the model leaves; a faint highlight."""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

# A highlight counts as seen from so many standard errors on. Its exponent is the one
# that fits best: chance reaches further than 3.
SEEN = 4.0


class Neighbours(NamedTuple):
    """Sums over residuals, and over pairs of adjacent pixels."""

    products: float
    pairs: int
    squares: float
    samples: int


def compare_neighbours(
    residual: Float[np.ndarray, "height width 3"],
    used: Bool[np.ndarray, "height width channels"],
) -> Neighbours:
    """What [`neighbour_correlation`][] asks of one image.

    **Arguments:**

    - `residual`: image − model; 0 where a sample is left out.
    - `used`: true where a sample takes part; of one channel, if all take part alike.
    """
    across = _product(residual[:, 1:], residual[:, :-1])
    down = _product(residual[1:], residual[:-1])
    pairs = np.count_nonzero(used[:, 1:] & used[:, :-1])
    pairs += np.count_nonzero(used[1:] & used[:-1])
    alike = residual.shape[-1] // used.shape[-1]
    return Neighbours(
        across + down,
        alike * pairs,
        _product(residual, residual),
        alike * np.count_nonzero(used),
    )


def _product(one: np.ndarray, other: np.ndarray) -> float:
    """Sum of products; row by row, which keeps digits."""
    return float(np.einsum("hwc,hwc->h", one, other).sum(dtype=float))


def all_neighbours(images: Iterable[Neighbours]) -> Neighbours:
    """Those of several images together."""
    return Neighbours(*map(sum, zip(*images, strict=True)))


def neighbour_correlation(sums: Neighbours) -> float:
    """Correlation of the residuals of adjacent pixels: 0 for independent noise.

    **Returns:** a number in [−1, 1]; 0 where it is no more than chance.
    """
    correlation = correlation_of(sums)
    chance = 5 / math.sqrt(max(sums.pairs, 1))
    return correlation if abs(correlation) > chance else 0.0


def correlation_of(sums: Neighbours) -> float:
    """The same, with what is chance alone."""
    products, pairs, squares, count = sums
    if pairs == 0 or squares == 0:
        return 0.0
    return min(max(products / pairs * count / squares, -1.0), 1.0)


class Expected(NamedTuple):
    """How neighbours' residuals correlate where the model is right, and how surely."""

    correlation: float
    deviation: float


def correlation_beyond(sums: Neighbours, expected: Expected) -> float:
    """How much more they correlate than expected; 0 where that is chance."""
    beyond = correlation_of(sums) - expected.correlation
    chance = 5 * math.hypot(expected.deviation, 1 / math.sqrt(max(sums.pairs, 1)))
    return min(beyond, 1.0) if beyond > chance else 0.0


def variance_inflation(correlation: float) -> float:
    r"""Factor on variances if neighbours correlate: $(\frac{1+c}{1-c})^2$, at least 1.

    Pixels that repeat one another are fewer independent ones. The factor is that of a
    first-order autoregressive process along each image axis.

    ??? cite "Source"
        Bayley and Hammersley, *The effective number of independent observations in an
        autocorrelated time series*, J. R. Stat. Soc. Suppl. 8(2), 1946.
    """
    c = min(max(correlation, 0.0), 0.99)
    return ((1 + c) / (1 - c)) ** 2
