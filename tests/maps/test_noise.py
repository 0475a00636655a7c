"""Noise that is not the same in every sample: weights, errors, χ²."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import phongfit as pf
from phongfit.maps.pixel.scale import students_t
from tests.maps.synthetic import (
    FREE,
    Stack,
    dtype,
    make_stack,
    noisy,
    pulls,
    same,
    shown,
    spread,
)

MATTE: dict[str, Any] = {
    "unknowns": ("ambient", "diffuse"),
    "film": FREE,
    "tile_pixels": 512,
}


@pytest.fixture(scope="module")
def clean() -> Stack:
    return make_stack(24, 32, 16, noise=0.0)


def matte(clean: Stack) -> np.ndarray:
    """What the stack would show if nothing shone."""
    truth = pf.Material(clean.truth.diffuse, 0.0, 32.0, clean.truth.ambient)
    return shown(clean.scenes, truth)


def drawn(images: np.ndarray, noise: float | np.ndarray) -> np.ndarray:
    return noisy(images, noise, np.random.default_rng(3))


@pytest.mark.slow
def test_shot_noise(clean):
    """Of all unknowns: pulls of spread 1, and χ² near 1 pixel by pixel."""
    noise = np.sqrt(0.002**2 + 4e-4 * clean.images)
    assert noise.max() > 3 * noise.min()
    images = drawn(clean.images, noise)
    maps = pf.fit_maps(clean.scenes, images, noise=list(noise), film=FREE)
    chi_squared = maps.chi_squared[maps.identified]
    assert chi_squared.size > 700
    freedom = 3 * 16 - 10
    assert chi_squared.mean() == pytest.approx(1, abs=4 * np.sqrt(2 / freedom / 700))
    assert chi_squared.std() == pytest.approx(np.sqrt(2 / freedom), rel=0.15)
    for name in ("ambient", "diffuse", "specular"):
        assert 0.9 < spread(pulls(maps, clean.truth, name)) < 1.1, name
    assert isinstance(maps.noise_given, np.ndarray)
    np.testing.assert_allclose(
        maps.noise_given, np.sqrt((noise**2).mean(axis=(0, 3))), rtol=1e-4
    )


@pytest.mark.extended
def test_noisy_images_count_for_less(clean):
    """A number for each image: the better ones decide, and errors say how well."""
    levels = np.where(np.arange(16) % 2, 0.003, 0.06)
    images = drawn(matte(clean), levels[:, None, None, None])
    weighted, plain = (
        pf.fit_maps(clean.scenes, images, noise=noise, **MATTE)
        for noise in (levels, 0.0425)
    )
    off = [
        np.std(maps.diffuse - np.asarray(clean.truth.diffuse))
        for maps in (weighted, plain)
    ]
    assert off[0] < 0.3 * off[1]
    pull = pulls(weighted, clean.truth, "diffuse")
    assert np.mean(pull**2) == pytest.approx(1, abs=0.1)
    assert weighted.chi_squared[weighted.identified].mean() == pytest.approx(
        1, abs=0.05
    )


@pytest.mark.extended
def test_the_same_noise_everywhere(clean, tmp_path):
    """A map of one number says what the number says, and is kept with the maps."""
    images = drawn(matte(clean), 0.01)
    number = pf.fit_maps(clean.scenes, images, noise=0.01, **MATTE)
    level = np.full((24, 32), 0.01)
    for noise in (level, [level[..., None] * np.ones(3)] * 16):
        maps = pf.fit_maps(clean.scenes, images, noise=noise, **MATTE)
        for name in ("ambient", "diffuse"):
            for a, b in ((maps, number), (maps.stderr, number.stderr)):
                np.testing.assert_allclose(
                    getattr(a, name), getattr(b, name), rtol=2e-3, atol=1e-5
                )
        np.testing.assert_allclose(maps.noise, number.noise, rtol=1e-3)
        np.testing.assert_array_equal(maps.flags, number.flags)
    assert number.noise_given == 0.01
    maps.save(tmp_path / "maps.npz")
    read = pf.load_maps(tmp_path / "maps.npz")
    same(read, maps)
    np.testing.assert_array_equal(read.noise_given, maps.noise_given)
    np.testing.assert_array_equal(read.chi_squared, maps.chi_squared)


@pytest.mark.extended
def test_errors_under_three_lamps_contain_how_badly_noise_is_known():
    """Nine samples know the noise badly: 1.96 errors held 90 % of the truths."""
    stack = make_stack(30, 30, 3, ambient=0)
    truth = np.asarray(stack.truth.diffuse)
    matte = pf.Material(truth, 0.0, 10.0, 0.0)
    images = noisy(shown(stack.scenes, matte), 0.01, np.random.default_rng(0))
    maps = pf.fit_maps(stack.scenes, images, unknowns=("diffuse",))
    pull = np.abs(maps.diffuse - truth) / maps.stderr.diffuse
    assert 0.935 < np.mean(pull < 1.96) < 0.965


def test_factors_of_student():
    for freedom in (1, 2, 3, 6, 7, 9, 15, 30, 100):
        expected = scipy.stats.t.ppf(0.975, freedom) / scipy.stats.norm.ppf(0.975)
        found = float(students_t(jnp.asarray(freedom, dtype())))
        assert found == pytest.approx(expected, rel=0.01), freedom
