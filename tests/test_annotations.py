"""What is annotated is what happens: the checks of `tests.annotations`."""

import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from tests.annotations import Forbidden, checked

ROOT = Path(__file__).parents[1]
# A file or two that compile little, of each part of the package.
PARTS = """
    test_lights test_scene geometry/test_surfaces rendering/test_render
    fitting/problem/test_layout fitting/solve/test_box fitting/texels/test_lit
    fitting/uncertainty/test_sandwich calibration/test_response files/test_scenes
    maps/pixel/test_block report/test_page lab/test_settings commands/test_scene
    data_synth/test_writing
"""


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


@pytest.mark.extended
def test_the_package_does_what_it_annotates():
    files = [f"tests/{name}.py" for name in PARTS.split()]
    words = ["-p", "tests.annotations", "-n", "0", "-p", "no:cacheprovider", *files]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *words],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout[-5000:]
