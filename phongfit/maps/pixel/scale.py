"""The scale of residuals, their weights under a robust loss, and limits of chance."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from phongfit.fitting.problem.losses import AbstractLoss
from phongfit.fitting.uncertainty.misfit import SIGNIFICANT


def loss_weights(
    loss: AbstractLoss, residual: Float[Array, "*batch"]
) -> Float[Array, "*batch"]:
    r"""Weights $\rho'(z)$ at $z = r^2$ of iteratively reweighted least squares.

    **Arguments:** `residual`: in standard deviations.
    """

    def cost(z: Array) -> Array:
        return z * loss.ratio(z)

    z = jnp.maximum(residual**2, jnp.finfo(residual.dtype).eps)
    _, slope = jax.jvp(cost, (z,), (jnp.ones_like(z),))
    # Rounding can make the weight of a far outlier negative.
    return jnp.maximum(slope, 0)


def widening(
    loss: AbstractLoss,
    residual: Float[Array, "*batch"],
    used: Bool[Array, "*batch"],
    unknowns: int = 0,
) -> Float[Array, ""]:
    r"""Factor on standard errors by a loss: $K \sqrt{E\,\psi^2} / E\,\psi'$.

    For n samples and p unknowns $E\,\psi^2$ is a sum divided by n - p, and
    $K = 1 + \frac pn \operatorname{var} \psi' / (E\,\psi')^2$.

    **Arguments:**

    - `residual`: in standard deviations; `used`: which of them count.
    - `unknowns`: p.

    ??? cite "Source"
        Huber, *Robust statistics*, 1981, section 7.6.
    """
    score, slope = loss.score(residual)
    count = jnp.maximum(jnp.sum(used), 1).astype(residual.dtype)
    freedom = jnp.maximum(count - unknowns, 1)
    square = jnp.sum(jnp.where(used, score**2, 0)) / freedom
    steepness = jnp.sum(jnp.where(used, slope, 0)) / count
    spread = jnp.sum(jnp.where(used, (slope - steepness) ** 2, 0)) / count
    # If nearly all samples are outliers, the loss is flat and the error infinite.
    identified = steepness > 0.01
    steepness = jnp.where(identified, steepness, 1)
    more = 1 + unknowns / count * spread / steepness**2
    return jnp.where(identified, more * jnp.sqrt(square) / steepness, jnp.inf)


# A normal distribution's standard deviation over its median absolute value.
NORMAL = 1.4826
# Halvings in the search for a median: a relative precision of 2⁻¹² is enough.
HALVINGS = 12
# Degrees of freedom at which Student's t is tabulated.
STUDENT = 1, 2, 3, 4, 5, 6, 8, 10, 20, np.inf


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
    from scipy import stats

    known = np.array(STUDENT[::-1])
    table = stats.t.ppf(0.975, known) / stats.norm.ppf(0.975)
    kind = freedom.dtype
    return jnp.interp(1 / freedom, jnp.asarray(1 / known, kind), table.astype(kind))


def most_by_chance(freedom: Array) -> Array:
    """Upper limit of χ² per degree of freedom if the residuals are noise alone.

    ??? cite "Source"
        Wilson and Hilferty, *The distribution of chi-square*, Proc. Natl. Acad. Sci.
        17, 1931.
    """
    spread = 2 / (9 * freedom)
    return (1 - spread + SIGNIFICANT * jnp.sqrt(spread)) ** 3
