"""Numbers with their errors: as many digits as the error leaves."""

import math

import pytest

from phongfit.fitting.uncertainty.numbers import number_with_error


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
