"""Heights of highlights, and their derivatives."""

from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from phongfit.maps.pixel.small import optimization_barrier
from phongfit.reflectance import AbstractSpecular

# Logarithm below which the power of a lobe is set to 0: products of smaller ones are
# denormal in single precision, and those are slow.
FAINTEST = -36.0

Lobe: TypeAlias = Callable[
    [PyTree[Array], list[PyTree[Array]]], tuple[Array, tuple[Array, ...], Array]
]
"""Function from a model's cosine and its derivatives, (pixels,) each, to the height of
the lobe, its derivatives in the same directions, and that in log f."""


def power_lobe(model: AbstractSpecular, t: Float[Array, " pixels"]) -> Lobe:
    """A lobe that is its peak times a power of one cosine, at exponents e^t.

    The derivatives are written out, since XLA would otherwise compute a power for each.
    """
    one = jnp.ones_like(t)
    peak, rise = jax.jvp(lambda t: model.lobe(one, jnp.exp(t)), (t,), (one,))
    exponent, peak, rise = optimization_barrier((jnp.exp(t), peak, rise / peak))

    def lobe(
        cosine: Array, turned: list[Array]
    ) -> tuple[Array, tuple[Array, ...], Array]:
        shiny = cosine > 0
        base = jnp.where(shiny, cosine, 1)
        power = exponent * jnp.log(base)
        visible = shiny & (power > FAINTEST)
        height = jnp.where(visible, peak * jnp.exp(power), 0)
        steep = exponent * height / base
        return height, tuple(steep * c for c in turned), (power + rise) * height

    return lobe


def any_lobe(model: AbstractSpecular, t: Float[Array, " pixels"]) -> Lobe:
    """A lobe of any form at exponents e^t, with automatic derivatives."""

    def height(cosine: PyTree[Array], t: Array) -> Array:
        return model.lobe(cosine, jnp.exp(t))

    def lobe(
        cosine: PyTree[Array], turned: list[PyTree[Array]]
    ) -> tuple[Array, tuple[Array, ...], Array]:
        here, rise = jax.jvp(lambda t: height(cosine, t), (t,), (jnp.ones_like(t),))
        steep = [jax.jvp(lambda c: height(c, t), (cosine,), (c,))[1] for c in turned]
        return here, tuple(steep), rise

    return lobe


def is_power(model: AbstractSpecular) -> bool:
    """True if a model's lobe is a power of one cosine, times any height."""
    dtype = jnp.result_type(float)
    vector = np.array([0, 0, 1], dtype)
    taken = jax.eval_shape(model.cosine, vector, vector, vector)
    if not isinstance(taken, jax.ShapeDtypeStruct):
        return False
    cosine, exponent = np.array([0.3, 0.9, 1, 1], dtype), np.array([1.7, 23] * 2, dtype)
    # Jitted, since without it JAX compiles each operation separately.
    height = np.broadcast_to(jax.jit(model.lobe)(cosine, exponent), cosine.shape)
    power = height[2:] * (cosine**exponent)[:2]
    return np.allclose(height[:2], power, rtol=1e-3, atol=0)


def in_numbers(model: AbstractSpecular) -> AbstractSpecular:
    """Model with its floats as Python numbers, so that they are compiled in.

    **Raises:** `ValueError` for a model that has arrays.
    """

    def number(leaf: Any) -> Any:
        if not eqx.is_inexact_array(leaf):
            return leaf
        if leaf.shape:
            raise ValueError(
                f"scenes: expected a specular model whose own numbers are single ones, "
                f"got one of shape {leaf.shape} in {type(model).__name__}"
            )
        return float(leaf)

    return jax.tree.map(number, model)
