"""Numbers with their errors: as many digits as the error leaves."""

import math

import numpy as np
import pytest

from phongfit.fitting.uncertainty.numbers import number_with_error, parameter_rows


@pytest.mark.parametrize(
    "value, error, words",
    [
        (59.8712, 0.34, "59.87"),
        (0.60012, 0.0004, "0.60012"),
        (1234.5, 56.0, "1234"),
        (0.123456789, math.inf, "0.12346"),
        (0.5, 0.0, "0.5"),
    ],
)
def test_digits_end_one_after_the_error_begins(value, error, words):
    assert number_with_error(value, error) == words


def test_a_line_says_what_there_is_to_say():
    rows = parameter_rows(
        ("diffuse", "specular", "shininess"),
        np.array([0.6, 0.0, 30.0]),
        np.array([0.01, 0.02, np.inf]),
        np.array([False, True, False]),
        np.array([False, False, True]),
    )
    heading, diffuse, specular, shininess = rows
    assert "value" in heading and "std. error" in heading
    assert diffuse.split() == ["diffuse", "0.600", "±", "0.01", "1.7"]
    assert specular.endswith("at its bound") and "–" in specular
    assert shininess.endswith("± ∞  not identifiable")
