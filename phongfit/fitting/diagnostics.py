"""Is it noise, or is it there? Residuals that the model leaves; a faint highlight."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

# A highlight counts as seen from so many standard errors on. Its exponent is the one
# that fits best: chance reaches further than 3.
SEEN = 4.0


class Neighbours(NamedTuple):
    """Sums over an image's residuals, and over pairs of adjacent pixels."""

    products: Any
    pairs: Any
    squares: Any
    samples: Any


def compare_neighbours(
    residual: Float[Array, "height width 3"],
    used: Bool[Array | np.ndarray, "height width 3"],
) -> Neighbours:
    """What [`neighbour_correlation`][] asks of one image.

    **Arguments:** `residual`: model − image. `used`: true where a sample takes part.
    """
    value = jnp.where(used, residual, 0)
    counted = jnp.asarray(used, value.dtype)

    def beside(image: Array) -> Array:
        across = jnp.sum(image[:, :-1] * image[:, 1:])
        return across + jnp.sum(image[:-1] * image[1:])

    return Neighbours(
        beside(value), beside(counted), jnp.sum(value**2), jnp.sum(counted)
    )


def neighbour_correlation(images: Iterable[Neighbours]) -> float:
    """Correlation of the residuals of adjacent pixels: 0 for independent noise.

    **Returns:** a number in [−1, 1]; 0 where it is no more than chance.
    """
    sums = np.sum([np.array(one, float) for one in images], axis=0)
    products, pairs, squares, count = sums.tolist()
    if pairs == 0 or squares == 0:
        return 0.0
    correlation = float(np.clip(products / pairs * count / squares, -1, 1))
    return correlation if abs(correlation) > 5 / np.sqrt(pairs) else 0.0


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
