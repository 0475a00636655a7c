"""A file that fits the model better in the other encoding is doubted."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import phongfit as pf
from phongfit.codes import warning_code
from phongfit.fitting.encodings import encoding_words, reread
from phongfit.rendering.film import decode, encode
from tests.fitting.scenes import ball, photograph, truth
from tests.helpers import near

RNG = np.random.default_rng(0)
LIGHT = np.linspace(0.02, 0.7, 30 * 20 * 3).reshape(30, 20, 3)
NOISE_OF_FILES = 0.003
NOISE = 0.01 * RNG.normal(size=LIGHT.shape)


def read_as(encoding: Any, numbers: np.ndarray) -> Any:
    """A fit of light that is known up to scale and offset to a file's numbers."""
    image = np.asarray(decode(numbers, encoding))
    columns = np.column_stack([LIGHT.ravel(), np.ones(LIGHT.size)])
    solution, *_ = np.linalg.lstsq(columns, image.ravel(), rcond=None)
    fitted = (columns @ solution).reshape(image.shape)
    return SimpleNamespace(photographs=image, residuals=image - fitted)


@pytest.mark.parametrize("right, wrong", [("linear", "srgb"), ("srgb", "linear")])
def test_the_wrong_encoding_is_named(right, wrong):
    numbers = np.asarray(encode(np.clip(LIGHT + NOISE, 0, 1), right))
    good, bad = read_as(right, numbers), read_as(wrong, numbers)
    assert encoding_words(good, bad, right) == ()
    (warning,) = encoding_words(bad, good, wrong)
    assert warning_code(warning) == "encoding-doubtful"
    assert f"Read it with encoding={right}" in warning


def twice(one: Any) -> Any:
    photographs, residuals = [one.photographs] * 2, [one.residuals] * 2
    return SimpleNamespace(photographs=photographs, residuals=residuals)


def test_several_photographs_count_together():
    numbers = np.clip(LIGHT + NOISE, 0, 1)
    good, bad = read_as("linear", numbers), read_as("srgb", numbers)
    words = encoding_words(bad, good, "srgb")
    assert encoding_words(twice(bad), twice(good), "srgb") == words


def test_reread_is_its_own_inverse():
    image = LIGHT.astype(np.float32)
    again = reread(image, "srgb")
    assert again.dtype == np.float32 and np.all(again > image)
    near(reread(again, "linear"), image, 1e-6)


def encodings_named(image: np.ndarray, film: pf.Film | None = None) -> list[str]:
    """Encodings that the warnings of a fit of the usual ball recommend."""
    warnings = pf.fit(ball(), image, film=film).warnings
    doubts = [one for one in warnings if warning_code(one) == "encoding-doubtful"]
    return [one.rpartition("encoding=")[2].split()[0] for one in doubts]


@pytest.mark.extended
@pytest.mark.parametrize("right, wrong", [("linear", "srgb"), ("srgb", "linear")])
def test_a_fit_names_the_encoding_of_a_file(right, wrong):
    """The rounding of 8 bits shows in which encoding the file was read."""
    film = pf.Film(encoding=right, bits=8)
    image = photograph(ball(), truth(), noise=NOISE_OF_FILES, film=film)
    misread = np.asarray(decode(encode(image, right), wrong))
    assert encodings_named(misread) == [right]
    assert encodings_named(image) == []


def test_a_film_states_the_encoding_where_no_rounding_shows_it():
    image = photograph(ball(), truth(), noise=NOISE_OF_FILES, film=pf.Film())
    misread = np.asarray(decode(image, "srgb"))
    assert encodings_named(misread, pf.Film(encoding="srgb")) == ["linear"]
    # Nothing states the encoding of plain arrays.
    assert encodings_named(misread) == []
