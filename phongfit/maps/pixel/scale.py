"""The scale of residuals, and limits of what chance makes of it."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.fitting.problem.losses import AbstractLoss
from phongfit.fitting.uncertainty.misfit import SIGNIFICANT
from phongfit.maps.pixel.robust import loss_weights

# A normal distribution's standard deviation over its median absolute value.
NORMAL = 1.4826
# Halvings in the search for a median: a relative precision of 2⁻¹² is enough.
HALVINGS = 12
# Degrees of freedom, and the t of Student that 95 % of the draws do not exceed.
STUDENT = {
    np.inf: 1.95996,
    20: 2.08596,
    10: 2.22814,
    8: 2.30600,
    6: 2.44691,
    5: 2.57058,
    4: 2.77645,
    3: 3.18245,
    2: 4.30265,
    1: 12.7062,
}


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


def final_scale(
    residual: Float[Array, "images channels pixels"],
    share: Float[Array, "images channels pixels"],
    scale: Float[Array, " pixels"],
    loss: AbstractLoss,
    unknowns: int,
) -> Float[Array, " pixels"]:
    r"""Standard deviations of pixels from the residuals of a fit.

    Root mean squares per degree of freedom for least squares. For a robust loss they
    follow from its weights, which is more efficient than a median:
    $\hat\sigma^2 = \frac{1}{c} \frac{n}{n - p} \sum w r^2 / \sum w$ with the weights at
    `scale`, and $c$ such that normal residuals give their variance.

    **Arguments:** `scale`: from [`median_scale`][], which documents the others.
    """
    if not loss.robust:
        freedom = jnp.maximum(count_used(share) - unknowns, 1)
        return jnp.sqrt(jnp.sum(residual**2, axis=(0, 1)) / freedom)
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


def students_t(freedom: Array) -> Array:
    """Factor on 95 % intervals if the noise is estimated from the residuals.

    Student's t over the 1.96 of a normal distribution, interpolated between the entries
    of the table, where it is nearly linear in the inverse of the degrees of freedom.
    """
    known = [1 / n for n in STUDENT]
    factors = [t / STUDENT[np.inf] for t in STUDENT.values()]
    kind = freedom.dtype
    return jnp.interp(1 / freedom, jnp.asarray(known, kind), jnp.asarray(factors, kind))


def most_by_chance(freedom: Array) -> Array:
    """Upper limit of χ² per degree of freedom if the residuals are noise alone.

    ??? cite "Source"
        Wilson and Hilferty, *The distribution of chi-square*, Proc. Natl. Acad. Sci.
        17, 1931.
    """
    spread = 2 / (9 * freedom)
    return (1 - spread + SIGNIFICANT * jnp.sqrt(spread)) ** 3
