"""Heights of highlights as functions of the exponent, for each light."""

import abc
from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from phongfit.reflectance import AbstractSpecular

# Logarithm below which the power of a lobe is set to 0: products of smaller ones are
# denormal in single precision, and those are slow.
FAINTEST = -36.0
DARK = -1e30
"""Stands for log 0: its exponential is 0 for every exponent."""

Angles: TypeAlias = PyTree[Float[Array, "images lobes pixels"]]
"""Arguments of the lobes from the geometry, for each light of an image."""

Angle: TypeAlias = PyTree[Float[Array, "..."]]
"""Argument of one light's lobe from the geometry, with as many axes as t."""

Heights: TypeAlias = Callable[[Angle], tuple[Array, Array]]
"""Function from a light's angles to its lobe's heights and their slopes in log f."""


class AbstractLobes(eqx.Module):
    """The lobes of a specular model."""

    model: eqx.AbstractVar[AbstractSpecular]

    @abc.abstractmethod
    def angles(
        self, cosine: PyTree[Float[Array, "..."]]
    ) -> PyTree[Float[Array, "..."]]:
        """Arguments of the lobes, computed once from the model's cosine."""

    @abc.abstractmethod
    def at(self, t: Float[Array, "*candidates groups #pixels"]) -> Heights:
        """Function that gives heights at exponents e^t, to be called light by light."""


class PowerLobes(AbstractLobes):
    """Lobes that are powers of one cosine, times any height."""

    model: AbstractSpecular

    def angles(self, cosine: Float[Array, "..."]) -> Float[Array, "..."]:
        """Logarithm of the cosine; [`DARK`][] where it is not positive."""
        positive = cosine > 0
        # Rounding can make a cosine larger than 1.
        logarithm = jnp.log(jnp.where(positive, cosine, 1))
        return jnp.where(positive, jnp.minimum(logarithm, 0), DARK)

    def at(self, t: Float[Array, "*candidates groups #pixels"]) -> Heights:
        one = jnp.ones_like(t)

        def height_at(t: Array) -> Array:
            return self.model.lobe(one, jnp.exp(t))

        height, rise = jax.jvp(height_at, (t,), (one,))
        exponent, bend = jnp.exp(t), rise / height

        def heights(logarithm: Angle) -> tuple[Array, Array]:
            power = exponent * logarithm
            lobe = height * jnp.where(power > FAINTEST, jnp.exp(power), 0)
            return lobe, lobe * (power + bend)

        return heights


class AnyLobes(AbstractLobes):
    """Lobes of any form, with slopes by automatic differentiation."""

    model: AbstractSpecular

    def angles(
        self, cosine: PyTree[Float[Array, "..."]]
    ) -> PyTree[Float[Array, "..."]]:
        return cosine

    def at(self, t: Float[Array, "*candidates groups #pixels"]) -> Heights:
        def heights(cosine: Angle) -> tuple[Array, Array]:
            def lobe(t: Array) -> Array:
                return self.model.lobe(cosine, jnp.exp(t))

            return jax.jvp(lobe, (t,), (jnp.ones_like(t),))

        return heights


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
