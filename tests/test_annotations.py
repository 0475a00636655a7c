"""What is annotated is what happens: the checks of `tests.annotations`."""

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from tests.annotations import Forbidden, checked


@checked
def twice(values: Float[Array, " n"], times: float = 2) -> Float[Array, " n"]:
    if values.ndim == 0:
        raise ValueError("values: expected a vector")
    return times * values[: 2 if times == 3 else None]


def times(factor: float, cut: int | None = None):
    @checked
    def scaled(values: Float[Array, " n"]) -> Float[Array, " n"]:
        return factor * values[:cut]

    return scaled


def test_what_is_annotated_may_be():
    np.testing.assert_array_equal(twice(jnp.ones(3)), [2, 2, 2])


@pytest.mark.parametrize(
    "values, times", [(np.ones(3), 2), (jnp.ones((2, 3)), 2), (jnp.ones(3), 3)]
)
def test_what_is_not_is_found(values, times):
    with pytest.raises(Forbidden):
        twice(values, times)


def test_a_function_may_refuse_it_in_its_own_words():
    with pytest.raises(ValueError, match="values: expected a vector"):
        twice(jnp.ones(()))


def test_a_function_within_a_function_is_checked_each_time_it_is_made():
    np.testing.assert_array_equal(times(2)(jnp.ones(3)), [2, 2, 2])
    np.testing.assert_array_equal(times(3)(jnp.ones(2)), [3, 3])
    with pytest.raises(Forbidden):
        times(3, cut=1)(jnp.ones(3))
    with pytest.raises(Forbidden):
        times(3)(jnp.ones((3, 1)))
