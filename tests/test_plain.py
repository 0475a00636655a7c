"""What JSON gets: numbers in the digits of their own precision, nothing it lacks."""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from phongfit.plain import plain


def test_a_number_has_the_digits_of_its_own_precision():
    assert plain(np.float32(0.1)) == 0.1
    assert plain(jnp.asarray([0.1, 0.2], jnp.float32)) == [0.1, 0.2]
    third = plain(np.array(1 / 3))
    assert third == 1 / 3 and isinstance(third, float)


def test_what_json_does_not_know_is_null():
    value = {"a": np.array([1.0, np.nan]), 2: (np.inf, None, True, np.int64(3))}
    assert plain(value) == {"a": [1.0, None], "2": [None, None, True, 3]}
    json.dumps(plain(value), allow_nan=False)


def test_paths_are_text_and_shapes_stay():
    assert plain(Path("a") / "b") == str(Path("a/b"))
    assert plain(np.zeros((2, 0))) == [[], []]
    assert plain(np.array([[True, False]])) == [[True, False]]


def test_what_has_no_place_is_named():
    with pytest.raises(TypeError, match="set cannot be written as JSON"):
        plain({"a": {1, 2}})
