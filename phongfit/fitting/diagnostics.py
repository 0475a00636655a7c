"""Is it noise, or is it there? Residuals that the model leaves; a faint highlight."""

import math
from collections.abc import Iterable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

# A highlight counts as seen from so many standard errors on. Its exponent is the one
# that fits best: chance reaches further than 3.
SEEN = 4.0


class Neighbours(NamedTuple):
    """Sums over residuals, and over pairs of adjacent pixels."""

    products: float
    pairs: float
    squares: float
    samples: float


def compare_neighbours(
    residual: Float[Array, "height width 3"],
    used: Bool[Array | np.ndarray, "height width channels"],
) -> Float[Array, "4"]:
    """[`Neighbours`][] of one image, in an array.

    **Arguments:** `residual`: model − image. `used`: true where a sample takes part;
    of one channel, if all take part alike.
    """
    value = jnp.where(used, residual, 0)
    counted = jnp.asarray(used, value.dtype)

    def beside(image: Array) -> Array:
        across = jnp.sum(image[:, :-1] * image[:, 1:])
        return across + jnp.sum(image[:-1] * image[1:])

    alike = residual.shape[-1] // counted.shape[-1]
    pairs, samples = alike * beside(counted), alike * jnp.sum(counted)
    return jnp.stack([beside(value), pairs, jnp.sum(value**2), samples])


def all_neighbours(images: Iterable[Array]) -> Neighbours:
    """Those of several images together."""
    return Neighbours(*map(sum, zip(*(one.tolist() for one in images), strict=True)))


def neighbour_correlation(sums: Neighbours) -> float:
    """Correlation of the residuals of adjacent pixels: 0 for independent noise.

    **Returns:** a number in [−1, 1]; 0 where it is no more than chance.
    """
    products, pairs, squares, count = sums
    if pairs == 0 or squares == 0:
        return 0.0
    correlation = min(max(products / pairs * count / squares, -1.0), 1.0)
    return correlation if abs(correlation) > 5 / math.sqrt(pairs) else 0.0


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
