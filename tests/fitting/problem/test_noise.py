import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

import phongfit as pf
from phongfit.fitting.problem import noise
from phongfit.fitting.problem.noise import find_film, find_plateau, rounding_steps
from tests.fitting.scenes import developed
from tests.helpers import eps, floats, near

clipped_mean, clipped_moments, shared_rounding_variance = map(
    jax.jit,
    (noise.clipped_mean, noise.clipped_moments, noise.shared_rounding_variance),
)
# Normal numbers, one for every 1/200000 of the chance: a simulation without its noise.
NORMAL = norm.ppf((np.arange(200_000) + 0.5) / 200_000)
LIGHTS = np.array([-3.0, -0.3, -0.01, 0, 0.01, 0.2, 0.5, 0.97, 1, 1.002, 1.3, 5.0])


@pytest.mark.usefixtures("precision")
@pytest.mark.parametrize("sigma", [0.3, 0.05, 0.005])
def test_mean_and_variance_against_simulation(sigma):
    seen = np.clip(LIGHTS[:, None] + sigma * NORMAL, 0, 1)
    near(clipped_mean(floats(LIGHTS), floats(sigma)), seen.mean(axis=1), 1e-5)
    share = clipped_moments(floats(LIGHTS), floats(sigma)).variance_share
    near(share, seen.var(axis=1) / sigma**2, 1e-3)


def test_noise_of_each_sample_its_own():
    sigmas = np.linspace(0.001, 0.4, len(LIGHTS))
    seen = np.clip(LIGHTS[:, None] + sigmas[:, None] * NORMAL, 0, 1)
    near(clipped_mean(floats(LIGHTS), floats(sigmas)), seen.mean(axis=1), 1e-5)
    share = clipped_moments(floats(LIGHTS), floats(sigmas)).variance_share
    near(share, seen.var(axis=1) / sigmas**2, 1e-3)


@pytest.mark.usefixtures("precision")
@pytest.mark.parametrize("sigma", [0.0, 1e-30, 1e-12, 1e-6])
def test_without_noise_it_is_the_clamp(sigma):
    near(clipped_mean(floats(LIGHTS), floats(sigma)), np.clip(LIGHTS, 0, 1), 4e-7)
    inside = (LIGHTS > 0) & (LIGHTS < 1)
    outside = (LIGHTS < 0) | (LIGHTS > 1)
    share = clipped_moments(floats(LIGHTS), floats(sigma)).variance_share
    near(np.asarray(share)[inside], 1)
    near(np.asarray(share)[outside], 0)


@jax.jit
@functools.partial(jax.vmap, in_axes=(0, None))
def derivatives(light, sigma):
    """The first and the second, in the light."""
    slope = jax.grad(noise.clipped_mean)
    return slope(light, sigma), jax.grad(slope)(light, sigma)


@pytest.mark.usefixtures("precision")
@pytest.mark.parametrize("sigma", [0.0, 1e-12, 1e-3, 0.1])
def test_derivatives(sigma):
    slope, bend = map(np.asarray, derivatives(floats(LIGHTS), floats(sigma)))
    assert np.all(np.isfinite(slope)) and np.all(np.isfinite(bend))
    # The slope is the chance that a pixel is neither black nor white.
    scale = max(sigma, 1e-9)
    chance = norm.cdf((1 - LIGHTS) / scale) - norm.cdf(-LIGHTS / scale)
    plain = ~np.isin(LIGHTS, (0, 1))
    near(np.asarray(slope)[plain], chance[plain], 1e-5)


def test_derivative_in_the_noise():
    slope = jax.grad(noise.clipped_mean, argnums=1)
    slopes = jax.jit(jax.vmap(slope, in_axes=(0, None)))
    for sigma in (1e-9, 1e-3, 0.1):
        found = np.asarray(slopes(floats(LIGHTS), floats(sigma)))
        assert np.all(np.isfinite(found))
    # Black lifts the mean, white lowers it.
    expected = norm.pdf(LIGHTS / sigma) - norm.pdf((1 - LIGHTS) / sigma)
    near(found, expected, 1e-5)


def srgb(code: float) -> float:
    """Linear light of an encoded value on the standard's curved piece."""
    return ((code + 0.055) / 1.055) ** 2.4


@pytest.mark.parametrize(
    "film, light, width",
    [
        (pf.Film(bits=8), 100 / 255, 1 / 255),
        (pf.Film(bits=16), 100 / 65535, 1 / 65535),
        (pf.Film(bits=8), 0.0, 0.5 / 255),  # nothing rounds to black from below
        (pf.Film(bits=8), 1.0, 0.5 / 255),
        # Below level 10 or so the curve is a line of slope 1 / 12.92.
        (pf.Film(encoding="srgb", bits=8), 5 / 255 / 12.92, 1 / 255 / 12.92),
        (
            pf.Film(encoding="srgb", bits=8),
            srgb(188 / 255),
            srgb(188.5 / 255) - srgb(187.5 / 255),
        ),
        (pf.Film(), 0.5, 0.0),
        (pf.Film(clamp=False), 3.0, 0.0),
    ],
)
def test_rounding_steps(film, light, width):
    image = np.asarray(floats(np.full((2, 3), light)))
    steps = rounding_steps(image, film)
    assert steps.shape == image.shape and steps.dtype == image.dtype
    np.testing.assert_allclose(steps, width, rtol=2e-4)


@pytest.mark.parametrize(
    "film",
    [
        pf.Film(bits=8),
        pf.Film(bits=16),
        pf.Film(encoding="srgb", bits=8),
        pf.Film(encoding="srgb", bits=16),
        pf.Film(),
        pf.Film(clamp=False),
    ],
    ids=lambda film: f"{film.encoding}-{film.bits}-{film.clamp}",
)
def test_find_film(film):
    rng = np.random.default_rng(1)
    # A little above white, and never black: a clamp must show in its absence.
    images = [
        np.asarray(floats(developed(rng.uniform(0.001, 1.2, (16, 16, 3)), film)))
        for _ in range(2)
    ]
    assert find_film(images) == film


def test_find_film_of_several_images_is_what_fits_all():
    rng = np.random.default_rng(2)
    light = rng.random((8, 8, 3))
    eight = np.asarray(floats(developed(light, pf.Film(bits=8))))
    smooth = np.asarray(floats(light))
    assert find_film([eight, smooth]) == pf.Film()
    assert find_film([eight, smooth - 0.5]) == pf.Film(clamp=False)
    assert find_film([eight, eight[:2]]) == pf.Film(bits=8)
    # Cut off at white alone, where one value of 1 may be chance.
    cut = np.minimum(smooth - 0.5, 0.3) + 0.7
    below = np.concatenate([cut.ravel(), [-0.1]])
    assert find_film([below]) == pf.Film()
    assert find_film([np.array([-0.1, 0.5, 1.0])]) == pf.Film(clamp=False)


def test_find_plateau():
    """Where many samples lie at the top, and few just below it."""
    x = np.linspace(-1, 1, 40)
    peak = 0.1 * np.exp(-4 * ((x[:, None] - 0.03) ** 2 + (x - 0.017) ** 2))
    assert find_plateau([peak]) is None
    cut = np.minimum(peak, 0.06)
    assert find_plateau([peak / 4, cut]) == (0.06, np.count_nonzero(cut == 0.06))
    # White is white; and what has one brightness need not have been cut off.
    assert find_plateau([cut / 0.06]) is None
    assert find_plateau([np.where(peak > 0.06, 0.5, 0.2)]) is None
    rounded = np.round(255 * (0.8 * np.minimum(peak / 0.1, 0.9))) / 255
    noisy = np.round(255 * 0.7 + np.random.default_rng(0).normal(0, 0.3, (40, 40)))
    assert find_plateau([np.round(peak * 2550) / 2550]) is None
    assert find_plateau([noisy / 255]) is None
    assert find_plateau([rounded]) is not None
    assert find_plateau([np.zeros(0)]) is None


@pytest.mark.usefixtures("precision")
@pytest.mark.parametrize("ratio", [0.0, 0.05, 0.1, 0.2, 0.35, 0.6])
def test_shared_rounding_against_simulation(ratio):
    """Equal pixels with noise, rounded: what the mean of many is still off."""
    step = 0.02
    light = step * (np.arange(400) + 0.5) / 400
    noisy = light[:, None] + ratio * step * NORMAL[::50]
    off = (np.round(noisy / step) * step).mean(axis=1) - light
    shared = shared_rounding_variance(floats(step), floats(ratio * step))
    near(np.asarray(shared) / step**2, np.mean(off**2) / step**2, 1e-3)


def test_shared_rounding_never_exceeds_all_of_it():
    ratios = np.linspace(0, 3, 301)
    shared = np.asarray(shared_rounding_variance(floats(np.ones(301)), floats(ratios)))
    near(shared[0], 1 / 12)
    assert np.all(np.diff(shared) <= 1e-3 / 12)
    assert np.all(shared <= (1 + eps()) / 12) and shared[-1] == pytest.approx(0)
    # What was never rounded shares nothing, noise or not.
    assert not np.any(shared_rounding_variance(floats([0, 0]), floats([0.0, 0.1])))


@pytest.mark.usefixtures("precision")
def test_precision_of_the_run():
    assert clipped_mean(floats(0.5), floats(0.1)).dtype == jnp.result_type(float)
    near(clipped_mean(floats(0.5), floats(0.01)), 0.5, 2 * eps())
