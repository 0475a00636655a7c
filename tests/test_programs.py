"""Compiled programs, whatever their arguments hold."""

from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from phongfit import programs
from phongfit.programs import HURRY, compiler_options, program


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


@pytest.mark.parametrize("pieces, goes", [(10, False), (10**5, True)])
def test_programs_go_before_memory_has_no_place_for_others(monkeypatch, pieces, goes):
    cleared = []
    monkeypatch.setattr(programs, "COUNTED", 2)
    monkeypatch.setattr(programs, "pieces_of_memory", lambda: pieces)
    monkeypatch.setattr(jax, "clear_caches", lambda: cleared.append(True))
    square = program()(lambda x: x**2)
    one = np.ones(3)
    square(one)
    cleared.clear()
    # One more is compiled, and then none: nothing is looked at.
    for array in (one, one, one):
        square(array)
    assert not cleared
    for size in range(4, 7):
        square(np.ones(size))
    assert bool(cleared) == goes
    cleared.clear()
    # What is traced is no program of its own.
    jax.make_jaxpr(square)(one)
    assert not cleared


def test_pieces_of_memory_are_counted():
    maps = Path("/proc/self/maps")
    if not maps.exists():
        pytest.skip("only Linux counts them")
    lines = len(maps.read_text().splitlines())
    assert abs(programs.pieces_of_memory() - lines) < 0.2 * lines


@pytest.fixture
def in_a_hurry(monkeypatch):
    """As users run it: the tests' own `XLA_FLAGS` are not asked."""
    if jax.default_backend() != "cpu":
        pytest.skip("programs are compiled in a hurry on a CPU alone")
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    compiler_options.cache_clear()
    yield
    compiler_options.cache_clear()


def test_what_is_compiled_in_a_hurry_can_be_part_of_other_programs(in_a_hurry):
    assert compiler_options() == HURRY

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


def test_what_the_user_asks_of_xla_stays(in_a_hurry, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=2")
    assert compiler_options() == {"xla_cpu_use_fusion_emitters": False}


def test_options_that_xla_does_not_know_are_left_out(in_a_hurry, monkeypatch):
    monkeypatch.setitem(HURRY, "xla_no_such_option", True)
    assert compiler_options() is None
    assert program()(lambda x: x + 1)(jnp.asarray(1.0)) == 2
