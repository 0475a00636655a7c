"""Robust estimates of the scale of residuals."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from phongfit.fitting.problem.losses import AbstractLoss
from phongfit.maps.pixel.robust import loss_weights

# A normal distribution's standard deviation over its median absolute value.
NORMAL = 1.4826
# Halvings in the search for a median: a relative precision of 2⁻¹² is enough.
HALVINGS = 12


def count_used(
    share: Float[Array, "images channels pixels"],
) -> Float[Array, " pixels"]:
    """Number of samples in use of each pixel, as floats: sums of booleans are slow."""
    return jnp.sum((share > 0).astype(share.dtype), axis=(0, 1))


def median_scale(
    residual: Float[Array, "images channels pixels"],
    share: Float[Array, "images channels pixels"],
    unknowns: int,
) -> Float[Array, " pixels"]:
    """Standard deviations of pixels from the medians of their absolute residuals.

    Medians are found by halving an interval for all pixels at once, which is faster
    than sorting.

    **Arguments:**

    - `residual`: 0 for unused samples, whose `share` is 0.
    - `unknowns`: number of unknowns of a pixel, subtracted from its degrees of freedom.
    """
    size = jnp.abs(residual)
    used, dtype = share > 0, residual.dtype
    count = count_used(share)

    def halve(_: Array, between: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = between
        middle = (low + high) / 2
        below = used & (size <= middle[None, None])
        enough = jnp.sum(below.astype(dtype), axis=(0, 1)) >= count / 2
        return jnp.where(enough, low, middle), jnp.where(enough, middle, high)

    highest = jnp.max(size, axis=(0, 1))
    between = (jnp.zeros_like(highest), highest)
    low, high = jax.lax.fori_loop(0, HALVINGS, halve, between)
    freedom = jnp.maximum(count - unknowns, 1)
    return NORMAL * (low + high) / 2 * jnp.sqrt(count / freedom)


def weighed_scale(
    residual: Float[Array, "images channels pixels"],
    share: Float[Array, "images channels pixels"],
    scale: Float[Array, " pixels"],
    loss: AbstractLoss,
    unknowns: int,
) -> Float[Array, " pixels"]:
    r"""Standard deviations from the loss's weights, more efficient than a median.

    $\hat\sigma^2 = \frac{1}{c} \frac{n}{n - p} \sum w r^2 / \sum w$ with the weights at
    `scale`, and $c$ such that normal residuals give their variance.

    **Arguments:** `scale`: from [`median_scale`][], which documents the others.
    """
    used = share > 0
    weight = jnp.where(used, loss_weights(loss, residual / scale[None, None]), 0)
    count = count_used(share)
    total = jnp.sum(weight, axis=(0, 1))
    square = jnp.sum(weight * residual**2, axis=(0, 1))
    square = square / jnp.where(total > 0, total, 1) / _of_normal(loss)
    return jnp.sqrt(square * count / jnp.maximum(count - unknowns, 1))


def _of_normal(loss: AbstractLoss) -> Float[Array, ""]:
    """Ratio of the mean of w r² to the mean of w, for normal residuals."""
    r = jnp.linspace(-8, 8, 401)
    weight = loss_weights(loss, r) * jnp.exp(-(r**2) / 2)
    return jnp.sum(weight * r**2) / jnp.sum(weight)
