"""Heights of one pixel's highlights, whatever the exponent, light by light."""

import abc
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from phongfit.maps.pixel.columns import Lights
from phongfit.maps.pixel.small import optimization_barrier
from phongfit.reflectance import AbstractSpecular

# Logarithm of the least height of a lobe that counts: products of smaller ones leave
# the normal numbers of single precision, and those are slow.
FAINTEST = -36.0
DARK = -1e4
"""Stands for log 0: its exponential is 0 for every exponent from 1 on."""

Angles: TypeAlias = tuple[PyTree[Float[Array, "..."]], ...]
"""What a lobe takes of the geometry, for each light of an image, most often one."""


class AbstractLobes(eqx.Module):
    """The lobes of a specular model."""

    model: eqx.AbstractVar[AbstractSpecular]

    @abc.abstractmethod
    def angles(
        self, cosine: PyTree[Float[Array, "..."]]
    ) -> PyTree[Float[Array, "..."]]:
        """What is kept of the model's cosine."""

    @abc.abstractmethod
    def at(self, angles: Angles, t: Float[Array, ""]) -> tuple[Lights, Lights]:
        """Heights at exponent e^t, and their slopes in t."""

    @abc.abstractmethod
    def alone(
        self, angles: Angles, exponent: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Lights]:
        """Heights at one exponent, as a number that multiplies all, and the rest."""

    @abc.abstractmethod
    def doubling(
        self, angles: Angles, exponent: Float[Array, ""], count: int
    ) -> list[tuple[Float[Array, ""], Lights]]:
        """The same at several, each twice the one before."""


class PowerLobes(AbstractLobes):
    r"""Powers of one cosine, of any height: one exponential serves all of a scan.

    $\cos^{2f} = (\cos^f)^2$.
    """

    model: AbstractSpecular

    def angles(self, cosine: Float[Array, "..."]) -> Float[Array, "..."]:
        """Its logarithm, [`DARK`][] where it is not positive."""
        positive = cosine > 0
        # Rounding can make a cosine larger than 1.
        logarithm = jnp.log(jnp.where(positive, cosine, 1))
        return jnp.where(positive, jnp.minimum(logarithm, 0), DARK)

    def at(self, angles: Lights, t: Float[Array, ""]) -> tuple[Lights, Lights]:
        one = jnp.ones((), t.dtype)

        def height_at(t: Array) -> Array:
            return self.model.lobe(one, jnp.exp(t))

        height, rise = jax.jvp(height_at, (t,), (one,))
        tops, slopes = [], []
        for logarithm in angles:
            power = jnp.exp(t) * logarithm
            lobe = height * jnp.where(power > FAINTEST, jnp.exp(power), 0)
            tops.append(lobe)
            slopes.append(lobe * (power + rise / height))
        return optimization_barrier((tuple(tops), tuple(slopes)))

    def alone(
        self, angles: Lights, exponent: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Lights]:
        powers = (exponent * logarithm for logarithm in angles)
        shape = tuple(
            jnp.where(power > FAINTEST, jnp.exp(power), 0) for power in powers
        )
        return self._height(exponent), shape

    def doubling(
        self, angles: Lights, exponent: Float[Array, ""], count: int
    ) -> list[tuple[Float[Array, ""], Lights]]:
        _, powers = self.alone(angles, exponent)
        found = []
        for k in range(count):
            powers = optimization_barrier(_squares(powers) if k else powers)
            found.append((self._height(exponent * 2**k), powers))
        return found

    def _height(self, exponent: Float[Array, ""]) -> Float[Array, ""]:
        return self.model.lobe(jnp.ones((), exponent.dtype), exponent)


def _squares(powers: Lights) -> Lights:
    least = np.exp(FAINTEST / 2).item()
    return tuple(jnp.where(power > least, power * power, 0) for power in powers)


class AnyLobes(AbstractLobes):
    """Lobes of any form; their slopes are JAX's."""

    model: AbstractSpecular

    def angles(
        self, cosine: PyTree[Float[Array, "..."]]
    ) -> PyTree[Float[Array, "..."]]:
        return cosine

    def at(self, angles: Angles, t: Float[Array, ""]) -> tuple[Lights, Lights]:
        def heights(t: Array) -> Lights:
            return self._heights(angles, jnp.exp(t))

        return optimization_barrier(jax.jvp(heights, (t,), (jnp.ones_like(t),)))

    def alone(
        self, angles: Angles, exponent: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Lights]:
        return jnp.ones_like(exponent), self._heights(angles, exponent)

    def doubling(
        self, angles: Angles, exponent: Float[Array, ""], count: int
    ) -> list[tuple[Float[Array, ""], Lights]]:
        # A loop: compiled once, however many there are.
        exponents = exponent * 2.0 ** jnp.arange(count, dtype=exponent.dtype)
        found = jax.lax.map(lambda one: self._heights(angles, one), exponents)
        one = jnp.ones_like(exponent)
        return [(one, tuple(each[k] for each in found)) for k in range(count)]

    def _heights(self, angles: Angles, exponent: Float[Array, ""]) -> Lights:
        return tuple(self.model.lobe(cosine, exponent) for cosine in angles)


def lobes_of(model: AbstractSpecular) -> AbstractLobes:
    """The lobes of a model, as powers where they are that."""
    return PowerLobes(model) if is_power(model) else AnyLobes(model)


def is_power(model: AbstractSpecular) -> bool:
    """Whether its lobe is a power of one cosine, whatever its height."""
    dtype = jnp.result_type(float)
    vector = jnp.array([0.0, 0.0, 1.0], dtype)
    taken = jax.eval_shape(model.cosine, vector, vector, vector)
    if not isinstance(taken, jax.ShapeDtypeStruct):
        return False
    cosine, exponent = jnp.array([0.3, 0.9], dtype), jnp.array([1.7, 23.0], dtype)
    top = model.lobe(jnp.ones_like(cosine), exponent)
    lobe = model.lobe(cosine, exponent)
    return np.allclose(lobe, top * cosine**exponent, rtol=1e-3, atol=0)


def in_numbers(model: AbstractSpecular) -> AbstractSpecular:
    """A model with its own floats as Python's, so that programs are made for them.

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
