"""Losses as weights: what an outlier still counts, and what that does to errors."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from phongfit.fitting.losses import AbstractLoss


def loss_weights(
    loss: AbstractLoss, residual: Float[Array, "*batch"]
) -> Float[Array, "*batch"]:
    r"""$\rho'(z)$ at $z = r^2$: the weight that makes least squares of a loss.

    **Arguments:** `residual`: in standard deviations.
    """

    def cost(z: Array) -> Array:
        return z * loss.ratio(z)

    z = jnp.maximum(residual**2, jnp.finfo(residual.dtype).eps)
    _, slope = jax.jvp(cost, (z,), (jnp.ones_like(z),))
    # Rounding can push the weight of a far outlier below its 0.
    return jnp.maximum(slope, 0)


def widening(
    loss: AbstractLoss, residual: Float[Array, "*batch"], used: Bool[Array, "*batch"]
) -> Float[Array, ""]:
    r"""By how much a loss widens errors: $\sqrt{E\,\psi^2} / E\,\psi'$.

    ??? cite "Source"
        Huber, *Robust statistics*, 1981, section 7.6.
    """

    def psi(r: Array) -> Array:
        return r * loss_weights(loss, r)

    score, slope = jax.jvp(psi, (residual,), (jnp.ones_like(residual),))
    count = jnp.maximum(jnp.sum(used), 1).astype(residual.dtype)
    square = jnp.sum(jnp.where(used, score**2, 0)) / count
    steepness = jnp.sum(jnp.where(used, slope, 0)) / count
    # Where nearly all samples are outliers, the loss has no slope and tells nothing.
    told = steepness > 0.01
    return jnp.where(told, jnp.sqrt(square) / jnp.where(told, steepness, 1), jnp.inf)
