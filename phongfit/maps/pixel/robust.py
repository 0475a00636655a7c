"""Weights of residuals under a robust loss, and their effect on standard errors."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from phongfit.fitting.problem.losses import AbstractLoss


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
