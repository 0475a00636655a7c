"""Made-up photographs: what was asked for, and well posed."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from data_synth import make_dataset, make_lights
from data_synth.lights import PEAK, WIDEST, brightest_intensity, spread_directions
from phongfit.files.dataset import Dataset

MATTE = pf.Material(0.6, 0.0, 1.0, 0.5)
EXTENDED = pytest.mark.extended


def _make(material: pf.Material = MATTE, seed: int = 0, **options: Any) -> Dataset:
    options = {"camera": pf.OrthographicCamera(24, 20)} | options
    return make_dataset(material, key=jax.random.key(seed), **options)


def test_without_noise_it_is_the_render():
    made = _make(bits=None)
    for scene, image in zip(made.scenes, made.images, strict=True):
        np.testing.assert_allclose(image, pf.render(scene, MATTE), atol=1e-6)
    assert made.truth is MATTE and all(film.bits is None for film in made.films)


@pytest.mark.parametrize("bits, encoding", [(8, "srgb"), (16, "linear")])
def test_rounded_as_in_a_file(bits, encoding):
    made = _make(bits=bits, encoding=encoding)
    film = pf.Film(encoding=encoding, bits=bits)
    assert made.film == film
    levels = np.asarray(film.expose(jnp.asarray(made.images[0]))) * (2**bits - 1)
    np.testing.assert_allclose(levels, np.round(levels), atol=0.01)
    exact = pf.Film(encoding=encoding).expose(pf.render(made.scenes[0], MATTE))
    exact = np.asarray(exact) * (2**bits - 1)
    np.testing.assert_allclose(levels, exact, atol=0.51)


def test_lights_are_dealt_out():
    lights = make_lights(5, intensity=0.3)
    made = _make(lights=lights, images=2)
    assert [scene.lights for scene in made.scenes] == [lights[::2], lights[1::2]]
    assert len(_make(lights=lights).scenes) == 5
    assert len(_make(lights=lights, images=1).scenes[0].lights) == 5


def test_noise_has_the_size_it_should_have():
    grey = pf.Material(0.0, 0.0, 1.0, 0.0, emission=0.5)
    surface = pf.NormalMap(np.broadcast_to([0.0, 0.0, 1.0], (60, 60, 3)))
    camera = pf.OrthographicCamera(60, 60)
    made = _make(
        grey,
        surface=surface,
        camera=camera,
        lights=make_lights(2),
        noise=0.02,
        encoding="linear",
    )
    noise = np.stack(made.images) - 0.5
    # 21600 draws: the spread is known to 0.5 %, the mean to 0.0002.
    assert abs(noise.std() / 0.02 - 1) < 0.02 and abs(noise.mean()) < 6e-4
    assert abs(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1]) < 0.05


def test_the_seed_decides():
    one, same, other = _make(noise=0.1), _make(noise=0.1), _make(noise=0.1, seed=1)
    assert np.array_equal(one.images, same.images)
    assert not np.array_equal(one.images, other.images)


@pytest.mark.parametrize("name", ["brass", "chrome", "black_rubber", "white_plastic"])
def test_default_exposure_cuts_nothing_off(name):
    made = _make(pf.preset(name))
    highest = max(image.max() for image in made.images)
    assert PEAK - 0.02 < highest < 1


KINDS = [pytest.param(n, marks=EXTENDED) for n in ("directional", "point", "spot")]


@pytest.mark.parametrize("kind", ["mixed", *KINDS])
def test_default_lights_show_highlight_and_shadow(kind):
    shiny = pf.Material(0.0, 1.0, 50.0, 0.0)
    for lights in make_lights(6, kind):
        made = _make(shiny, lights=[lights], ambient=0.0, bits=None)
        scene, image = made.scenes[0], made.images[0]
        assert image.max() > 0.5
        diffuse = pf.terms(
            scene, pf.geometry.trace(scene.surface, scene.camera)
        ).diffuse
        assert 0 < np.mean(np.asarray(diffuse)[..., 0] == 0) < 0.7


def test_directions_are_spread():
    for count in (1, 2, 7, 96):
        directions = spread_directions(count)
        np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
        assert directions[:, 2].min() >= np.cos(WIDEST)
    # 96 lights: each has a cap of its own, about 12° wide.
    cosines = directions @ directions.T - 2 * np.eye(96)
    assert np.degrees(np.arccos(cosines.max())) > 8


@pytest.mark.parametrize(
    "options, message",
    [
        ({"noise": -0.1}, "noise: expected .*, got -0.1"),
        ({"noise": np.nan}, "noise: expected .*, got nan"),
        ({"images": 0}, "images: expected 1 … 4.*got 0"),
        ({"images": 5}, "images: expected 1 … 4.*got 5"),
        ({"lights": []}, "images: expected .*, got 0"),
        ({"bits": 12}, "bits: expected .*, got 12"),
        ({"encoding": "gamma"}, "encoding: expected .*, got 'gamma'"),
        ({"ambient": -1}, "ambient: "),
    ],
)
def test_wrong_options(options, message):
    with pytest.raises(ValueError, match=message):
        _make(**options)


def test_wrong_lights():
    with pytest.raises(ValueError, match="lights: expected .*, got 0"):
        make_lights(0)
    camera = pf.OrthographicCamera(8, 8)
    scene = pf.Scene(pf.Sphere(), camera, make_lights(1), ambient=2.0)
    with pytest.raises(ValueError, match="ambient_light: .* nearly white by itself"):
        brightest_intensity((scene,), MATTE)
