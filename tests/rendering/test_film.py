import jax
import jax.numpy as jnp
import numpy as np
import pytest

from phongfit.rendering.film import ENCODINGS, Film, decode, encode
from phongfit.testing import check_gradients
from tests.helpers import floats, near

GREYS = np.linspace(0, 1, 257)


# Linear light and sRGB, from the standard's two formulas: 12.92 x up to 0.0031308,
# 1.055 x^(1/2.4) - 0.055 above; 118 and 188 are the familiar 8-bit middle greys.
@pytest.mark.parametrize(
    "linear, srgb, tolerance",
    [
        (0.0, 0.0, 1e-6),
        (0.001, 0.01292, 1e-6),
        (0.0031308, 0.0404499, 1e-6),
        (0.18, 118 / 255, 2e-3),
        (0.5, 188 / 255, 2e-3),
        (0.2140411, 0.5, 1e-6),
        (1.0, 1.0, 1e-6),
    ],
)
def test_srgb(linear, srgb, tolerance):
    near(encode(floats(linear), "srgb"), srgb, tolerance)
    near(decode(floats(srgb), "srgb"), linear, tolerance)
    near(encode(floats(linear), "linear"), linear)
    near(decode(floats(srgb), "linear"), srgb)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_round_trip(encoding):
    greys = floats(GREYS)
    # The two pieces of the standard meet to 1e-8 or so, not exactly.
    near(decode(encode(greys, encoding), encoding), greys, 1e-6)
    near(encode(decode(greys, encoding), encoding), greys, 1e-6)
    assert np.all(np.diff(encode(greys, encoding)) > 0)


def test_clamp():
    light = floats([-0.5, 0.0, 0.25, 1.0, 3.0])
    near(Film().expose(light), [0, 0, 0.25, 1, 1])
    near(Film(clamp=False).expose(light), light)
    near(Film(encoding="srgb").expose(light)[jnp.array([0, 3, 4])], [0, 1, 1])


@pytest.mark.parametrize(
    "bits, light, stored",
    [
        (1, 0.49, 0.0),
        (1, 0.51, 1.0),
        (8, 0.5, 128 / 255),  # 127.5 rounds to even
        (8, 0.25, 64 / 255),
        (8, 2.0, 1.0),
        (16, 0.25, 16384 / 65535),
    ],
)
def test_bits(bits, light, stored):
    near(Film(bits=bits).expose(floats(light)), stored)


def test_every_level_of_8_bits_survives():
    levels = floats(np.arange(256) / 255)
    for encoding in ENCODINGS:
        film = Film(encoding=encoding, bits=8)
        near(film.expose(decode(levels, encoding)), levels)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_gradients(encoding):
    film = Film(encoding=encoding)
    # Within each piece; at 0, 1 and the standard's seam there are kinks.
    check_gradients(film.expose, np.array([-0.2, 0.002, 0.1, 0.7, 0.999, 1.001, 2.0]))
    kinks = np.array([0.0, 0.0031308, 1.0])
    check_gradients(film.expose, kinks, finite_differences=False)
    check_gradients(
        lambda encoded: decode(encoded, encoding), np.array([0.0, 0.02, 0.1, 0.5, 1.0])
    )


def test_beyond_white_there_is_no_pull():
    slopes = jax.vmap(jax.grad(Film().expose))(floats([-1.0, 0.5, 2.0]))
    assert np.array_equal(slopes, [0, 1, 0])
