"""Compiled programs: static arguments, nesting, options."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from phongfit.programs import QUICK_COMPILATION, compiler_options, program


def test_what_is_static_is_compiled_in():
    @program("count")
    def powers(x: Array, count: int) -> Array:
        # A traced number would have no length.
        return jnp.stack([x**k for k in range(count)])

    np.testing.assert_array_equal(powers(jnp.asarray(2.0), 3), [1, 2, 4])
    np.testing.assert_array_equal(powers(jnp.asarray(2.0), count=2), [1, 2])


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


@pytest.fixture
def on_a_cpu(monkeypatch):
    """Without the `XLA_FLAGS` of the tests, as users run it."""
    if jax.default_backend() != "cpu":
        pytest.skip("the options are for a CPU alone")
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    compiler_options.cache_clear()
    yield
    compiler_options.cache_clear()


def test_what_is_compiled_on_a_cpu_can_be_part_of_other_programs(on_a_cpu):
    assert compiler_options() == QUICK_COMPILATION

    @program()
    def square(x: Array) -> Array:
        return x**2

    @program()
    def fourth(x: Array) -> Array:
        return square(square(x))

    three = jnp.asarray(3.0)
    assert square(three) == 9 and fourth(three) == 81
    assert jax.jit(lambda x: 1 + square(x))(three) == 10
    assert jax.grad(fourth)(three) == 108
    assert jax.jit(jax.grad(jax.grad(square)))(three) == 2
    np.testing.assert_array_equal(jax.vmap(fourth)(jnp.arange(3.0)), [0, 1, 16])
    # First asked for in a trace, it is later compiled whole.
    cube = program()(lambda x: x**3)
    assert jax.jit(cube)(three) == 27 and cube(three) == 27


def test_what_the_user_asks_of_xla_stays(on_a_cpu, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=2")
    assert compiler_options() == {"xla_cpu_use_fusion_emitters": False}


def test_options_that_xla_does_not_know_are_left_out(on_a_cpu, monkeypatch):
    monkeypatch.setitem(QUICK_COMPILATION, "xla_no_such_option", True)
    assert compiler_options() is None
    assert program()(lambda x: x + 1)(jnp.asarray(1.0)) == 2
