"""Compiled programs, whatever their arguments hold."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from phongfit.programs import program


class Shape(eqx.Module):
    """As surfaces are: a function among the arrays."""

    function: Callable[[Array], Array]
    size: Array


def test_arguments_may_hold_functions():
    @program()
    def at(shape: Shape, x: Array) -> Array:
        return shape.size * shape.function(x)

    two = jnp.asarray(2.0)
    assert at(Shape(jnp.sin, two), two) == 2 * jnp.sin(two)
    assert at(Shape(jnp.cos, two), two) == 2 * jnp.cos(two)


def test_what_is_static_is_compiled_in():
    @program("count")
    def powers(x: Array, count: int) -> Array:
        # A traced number would have no length.
        return jnp.stack([x**k for k in range(count)])

    np.testing.assert_array_equal(powers(jnp.asarray(2.0), 3), [1, 2, 4])
    np.testing.assert_array_equal(powers(jnp.asarray(2.0), count=2), [1, 2])
    held = program("count")(lambda shape, count: shape.function(shape.size) * count)
    assert held(Shape(jnp.sin, jnp.asarray(1.0)), 3) == 3 * jnp.sin(1.0)


def test_it_is_compiled_once_and_differentiable():
    traced = []

    @program()
    def square(x: Array) -> Array:
        traced.append(x)
        return x**2

    one, two = jnp.asarray(1.0), jnp.asarray(2.0)
    assert square(one) == 1 and square(two) == 4
    assert len(traced) == 1
    assert jax.grad(square)(two) == 4
    np.testing.assert_array_equal(jax.vmap(square)(jnp.arange(3.0)), [0, 1, 4])
