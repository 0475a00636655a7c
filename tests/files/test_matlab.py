"""Arrays from MATLAB's files: what SciPy writes, and what is broken."""

import io

import numpy as np
import pytest
import scipy.io

from phongfit.files.matlab import read_matrix

NUMBERS = np.arange(30.0).reshape(2, 5, 3)


def stored(compressed=False, **arrays) -> bytes:
    file = io.BytesIO()
    scipy.io.savemat(file, arrays, do_compression=compressed)
    return file.getvalue()


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("kind", ["f8", "f4", "u1", "i4"])
def test_one_array_among_others(compressed, kind):
    arrays = {"before": np.zeros(7), "cells": np.empty((0, 0), object)}
    arrays |= {"n": NUMBERS.astype(kind), "words": "abc"}
    data = stored(compressed, **arrays)
    np.testing.assert_array_equal(read_matrix(data, "n", (2, 5, 3)), NUMBERS)


@pytest.mark.parametrize(
    "array, message",
    [
        (NUMBERS[:1], r"n: expected numbers of shape \(2, 5, 3\), got \(1, 5, 3\)"),
        (NUMBERS * 1j, "n: expected .* got no real numbers"),
        ({"a": 1.0}, "n: expected .* got no real numbers"),
    ],
)
def test_other_arrays_are_refused(array, message):
    with pytest.raises(ValueError, match=message):
        read_matrix(stored(n=array), "n", (2, 5, 3))


def test_what_is_missing_or_broken_is_said():
    data = stored(m=NUMBERS)
    with pytest.raises(ValueError, match="n: expected .* got none"):
        read_matrix(data, "n", (2, 5, 3))
    with pytest.raises(ValueError, match="no MATLAB file"):
        read_matrix(b"junk", "m", (2, 5, 3))
    for first in range(128, len(data)):
        for length in (1, 4, 8):
            broken = data[:first] + data[first + length :]
            try:
                found = read_matrix(broken, "m", (2, 5, 3))
            except ValueError:
                continue
            assert found.shape == (2, 5, 3)
