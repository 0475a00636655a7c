"""Response curves: encodings given by samples."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.files.images import from_levels, to_levels
from phongfit.rendering.film import decode, encode
from tests.helpers import near

NUMBERS = np.linspace(0, 1, 257)
GAMMA = pf.ResponseCurve(NUMBERS**1.8)


def test_light_of_numbers_and_back():
    light = [0, 0.25**1.8, 0.5**1.8, 1]
    near(decode(jnp.array([0.0, 0.25, 0.5, 1.0]), GAMMA), light)
    greys = jnp.linspace(0, 1, 37)
    near(encode(decode(greys, GAMMA), GAMMA), greys, 1e-5)
    # Of NumPy's arrays it gives NumPy's, in their precision.
    found = decode(np.array([0.5], np.float32), GAMMA)
    assert isinstance(found, np.ndarray) and found.dtype == np.float32


@pytest.mark.parametrize("bits, kind", [(8, np.uint8), (16, np.uint16)])
def test_every_level_of_a_file_comes_back(bits, kind):
    levels = np.arange(2**bits).astype(kind).reshape(-1, 1)
    with jax.enable_x64(True):
        assert (to_levels(from_levels(levels, GAMMA), GAMMA, bits) == levels).all()


def test_a_film_rounds_on_the_curve():
    film = pf.Film(encoding=GAMMA, bits=8)
    shown = film.expose(jnp.array([-1.0, 0.2, 3.0]))
    near(shown, [0, np.round(0.2 ** (1 / 1.8) * 255) / 255, 1])
    same = pf.Film(encoding=pf.ResponseCurve((NUMBERS**1.8).tolist()), bits=8)
    assert eqx.tree_equal(film, same) and hash(film) == hash(same)


def test_slopes_are_those_of_the_curve():
    slope = jax.grad(lambda light: encode(light, GAMMA))(0.3)
    assert float(slope) == pytest.approx(0.3 ** (1 / 1.8 - 1) / 1.8, rel=0.01)


@pytest.mark.parametrize(
    "light, words",
    [
        ([0.0], "2 … 65536 numbers that rise from 0 to 1, got shape"),
        ([0.0, 0.5], "got 0 … 0.5"),
        ([0.1, 1.0], "got 0.1 … 1"),
        ([0.0, 0.6, 0.5, 1.0], "got 0.6 and then 0.5"),
        ([0.0, float("nan"), 1.0], "light: expected"),
        ([0.0, 1e-320, 1.0], "light: expected 2 … 65536 numbers that rise"),
        ("curve", "light: expected a list"),
    ],
)
def test_what_is_no_curve(light, words):
    with pytest.raises(ValueError, match="light") as caught:
        pf.ResponseCurve(light)
    assert words in str(caught.value)


def test_images_are_read_and_written_by_it(tmp_path):
    image = np.random.default_rng(0).uniform(0, 1, (5, 7, 3))
    path = tmp_path / "a.png"
    pf.write_image(path, image, GAMMA, bits=16)
    assert pf.read_image(path, GAMMA) == pytest.approx(image, abs=1e-4)
    as_srgb = pf.read_image(path, "srgb")
    assert np.abs(as_srgb - image).max() > 0.03
    assert pf.read_film(path, GAMMA) == pf.Film(encoding=GAMMA, bits=16)


@pytest.mark.extended
def test_a_fit_knows_the_curve(tmp_path):
    scene = pf.Scene(
        pf.Sphere(), pf.OrthographicCamera(24, 24), pf.DirectionalLight((1, 1, 2)), 0.3
    )
    truth = pf.Material((0.6, 0.3, 0.2), 0.2, 20.0, 0.5)
    film = pf.Film(encoding=GAMMA, bits=8)
    image = np.asarray(decode(film.expose(pf.render(scene, truth)), GAMMA))
    found = pf.fit(scene, image, film=film)
    assert "8-bit response curve" in str(found)
    pull = (np.asarray(found.material.diffuse) - [0.6, 0.3, 0.2]) / np.asarray(
        found.stderr.diffuse
    )
    assert np.abs(pull).max() < 4
    found.save(tmp_path / "fit.npz")
    assert pf.load_fit(tmp_path / "fit.npz").specification.film == film


def test_what_jpeg_loses_of_a_curve(tmp_path):
    path, rows = tmp_path / "a.jpg", np.linspace(0.1, 0.9, 16)
    light = np.stack([np.outer(rows, rows[::-1])] * 3, axis=-1)
    pf.write_image(path, light, GAMMA)
    film = pf.read_film(path, GAMMA)
    assert film.encoding == GAMMA and film.jpeg is not None
    stored = np.asarray(encode(pf.read_image(path, GAMMA), GAMMA)) * 255
    shown = np.asarray(film.expose(jnp.asarray(light))) * 255
    # But for what lies in the middle of two levels.
    assert np.abs(shown - stored).max() < 1.1
    assert np.mean(np.abs(shown - stored) > 0.5) < 0.2
