"""The parametric bootstrap: its spread is what the errors state."""

import jax
import numpy as np
import pytest

import phongfit as pf
from phongfit.rendering.film import decode
from tests.fitting.scenes import ball, photograph, truth

SCENE, TRUTH, NOISE = ball(), truth(), 0.01
KEY = jax.random.key(0)


def noisy(scene: pf.Scene, film: pf.Film, seed: int = 0) -> np.ndarray:
    """A photograph with noise."""
    light = np.asarray(photograph(scene, TRUTH))
    noise = np.random.default_rng(seed).normal(size=light.shape)
    return np.asarray(film.expose(np.asarray(light + NOISE * noise, np.float32)))


@pytest.fixture(scope="module")
def fit() -> pf.Fit:
    return pf.fit(SCENE, noisy(SCENE, pf.Film()))


def test_the_spread_is_that_of_the_errors(fit):
    draws = 200
    found = fit.bootstrap(draws, key=KEY)
    assert found.labels == fit.labels and found.failed == 0
    assert found.values.shape == (draws, len(fit.labels))
    ratio = found.errors / fit.errors
    # Four standard errors of a standard deviation.
    assert np.abs(ratio - 1).max() < 4 / np.sqrt(2 * draws)
    off = (found.values.mean(axis=0) - fit.values) / fit.errors
    assert np.abs(off).max() < 4 / np.sqrt(draws)
    scale = np.outer(fit.errors, fit.errors)
    assert np.abs((found.covariance - fit.covariance) / scale).max() < 0.3
    assert "200 simulated fits, 0 failed" in str(found) and "shininess" in repr(found)


def test_equal_keys_give_equal_draws(fit):
    first, again = (fit.bootstrap(2, key=KEY).values for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert np.abs(fit.bootstrap(2, key=jax.random.key(1)).values - first).min() > 0


def test_mask_noise_priors_and_exposures():
    scenes = [SCENE, ball(ambient=0.1)]
    mask = np.zeros((32, 32), bool)
    mask[:, 8:24] = True
    films = pf.Film(bits=8), pf.Film()
    images = [noisy(*one, k) for k, one in enumerate(zip(scenes, films, strict=True))]
    fit = pf.fit(
        scenes,
        images,
        unknowns=("diffuse", "specular", "exposure"),
        known=TRUTH,
        fixed={"exposure[0]": 1.0},
        priors={"specular.red": (0.3, 1e-4)},
        mask=[mask, mask],
        noise=NOISE,
        film=films,
    )
    found = fit.bootstrap(30, key=KEY)
    assert found.labels == fit.labels and found.failed == 0
    ratio = found.errors / fit.errors
    assert 0.5 < ratio.min() < ratio.max() < 1.6
    assert 0.5e-4 < found.errors[fit.labels.index("specular.red")] < 1.6e-4


ROTATION = "scene.camera.rotation"


@pytest.fixture(scope="module")
def turned() -> tuple[pf.Scene, np.ndarray]:
    """A view of a ball to the side, and a photograph from a camera turned by 2°."""
    aim = pf.geometry.look_at((0.2, 0.1, 3.0), (0, 0, 0))
    cosine, sine = np.cos(np.deg2rad(2)), np.sin(np.deg2rad(2))
    turn = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])

    def scene(rotation: np.ndarray) -> pf.Scene:
        camera = pf.PinholeCamera(
            32, 32, fx=34.0, fy=34.0, position=(0.2, 0.1, 3.0), rotation=rotation
        )
        return pf.Scene(pf.Sphere(), camera, SCENE.lights, ambient=0.2)

    there = scene(np.asarray(aim) @ turn)
    return scene(np.asarray(aim)), noisy(there, pf.Film(clamp=False))


@pytest.mark.extended
@pytest.mark.parametrize(
    "options",
    [
        {"unknowns": ("diffuse", ROTATION)},
        {"unknowns": ("diffuse",), "uncertain": {ROTATION: 3.0}},
        {"unknowns": ("diffuse", ROTATION), "fixed": {f"{ROTATION}.y": 2.0}},
    ],
)
def test_angles_count_from_the_given_rotation(turned, options):
    scene, image = turned
    film = pf.Film(clamp=False)
    fit = pf.fit(scene, image, known=TRUTH, film=film, **options)
    found = fit.bootstrap(4, key=KEY)
    assert found.labels == fit.labels and found.failed == 0
    off = np.abs(found.values.mean(axis=0) - fit.values) / fit.errors
    assert off.max() < 4


def test_negative_values_beside_white():
    image = np.clip(noisy(SCENE, pf.Film()), 0, 0.9)
    image[5:8, 5] = 1
    image[0, 0, 0] = -0.01
    fit = pf.fit(SCENE, image)
    assert fit.films[0].clamp and fit.bootstrap(2, key=KEY).failed == 0


def test_an_image_without_any_sample(fit):
    none = np.zeros((32, 32), bool)
    none[0, 0] = True  # which sees no surface
    masks = [np.ones_like(none), none]
    two = pf.fit([SCENE, SCENE], [fit.photographs] * 2, mask=masks)
    assert two.bootstrap(2, key=KEY).failed == 0


@pytest.mark.extended
def test_a_robust_loss_a_jpeg_and_no_highlight(fit):
    matte = pf.Material(0.3, 0.0, 20.0, 0.3)
    light = np.asarray(pf.render(SCENE, matte))
    noise = NOISE * np.random.default_rng(1).normal(size=light.shape)
    jpeg = pf.Film(
        encoding="srgb", bits=8, jpeg=pf.rendering.JpegCompression.at_quality(90)
    )
    image = np.asarray(decode(noisy(SCENE, jpeg), "srgb"))
    fits = (
        pf.fit(SCENE, fit.photographs, loss="cauchy"),
        pf.fit(SCENE, np.float32(light + noise)),
        pf.fit(SCENE, image, film=jpeg),
    )
    for one in fits:
        found = one.bootstrap(3, key=KEY)
        off = (found.values.mean(axis=0) - one.values) / one.errors
        assert found.failed == 0 and np.abs(off).max() < 4
    assert fits[1].unidentified[-1]


def test_fits_that_do_not_converge_are_counted(fit):
    few = pf.fit(SCENE, fit.photographs, max_steps=1)
    found = few.bootstrap(2, key=KEY)
    assert found.failed == 2 and found.values.shape == (0, len(fit.labels))
    assert np.isnan(found.errors).all() and np.isnan(found.covariance).all()
    assert "0 simulated fits, 2 failed" in str(found)


@pytest.mark.parametrize(
    "options, words",
    [
        ({"n": 1, "key": KEY}, "n: expected 2 or more, got 1"),
        ({"key": 3.5}, "key: expected a key, such as jax.random.key"),
        ({"key": np.ones(2)}, "key: expected a key, such as jax.random.key"),
    ],
)
def test_wrong_arguments_are_named(fit, options, words):
    with pytest.raises(ValueError, match=words):
        fit.bootstrap(**options)
