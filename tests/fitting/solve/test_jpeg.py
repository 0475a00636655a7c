"""Photographs that were JPEG files: right errors, and a word where nobody said so."""

import dataclasses
import functools

import imageio.v3 as iio
import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.files.images import from_levels, to_levels
from tests.fitting.scenes import as_vector, ball, truth

TRUTH = truth()

SIZE, NOISE, DRAWS = 64, 0.003, 6


def photograph(seed, quality, scene=None):
    """As it is read from a file; from one without losses where `quality` is `None`."""
    scene = ball(size=SIZE) if scene is None else scene
    light = np.asarray(pf.render(scene, TRUTH, film=pf.Film(clamp=False)), float)
    light = light + NOISE * np.random.default_rng(seed).normal(size=light.shape)
    levels = to_levels(light, "srgb", 8)
    if quality is None:
        return from_levels(levels, "srgb")
    options = {"quality": quality, "subsampling": 2}
    data = iio.imwrite("<bytes>", levels, extension=".jpg", plugin="pillow", **options)
    return from_levels(iio.imread(data, extension=".jpg"), "srgb")


def film(quality):
    return pf.Film(encoding="srgb", jpeg=pf.JpegCompression.at_quality(quality))


@functools.cache
def fits():
    scene, known = ball(size=SIZE), film(95)
    return [pf.fit(scene, photograph(seed, 95), film=known) for seed in range(DRAWS)]


def pulls(found):
    return np.array([(fit.values - as_vector(TRUTH)) / fit.errors for fit in found])


def about(words, fit):
    return any(words in warning for warning in fit.warnings)


def test_errors_are_right_where_the_file_is_known():
    assert 0.7 < np.sqrt(np.mean(pulls(fits()) ** 2)) < 1.4
    noises = [fit.noise for fit in fits()]
    assert np.mean(noises) == pytest.approx(NOISE, rel=0.4)
    assert not any(about("residuals", fit) for fit in fits())
    assert {fit.film for fit in fits()} == {"clamped, 8-bit srgb JPEG 4:2:0"}


def test_an_array_that_was_a_jpeg_file_is_noticed():
    scene = ball(size=SIZE)
    for seed in range(DRAWS):
        assert about("read_film", pf.fit(scene, photograph(seed, 85)))
        assert not pf.fit(scene, photograph(seed, None)).warnings


def test_a_wrong_model_is_still_seen():
    lamp = pf.DirectionalLight((-1, -1, 1), 0.02)
    more = dataclasses.replace(ball(size=SIZE), lights=[*ball().lights, lamp])
    image = photograph(0, 95, scene=more)
    assert about("residuals are", pf.fit(ball(size=SIZE), image, film=film(95)))


@pytest.mark.slow
def test_an_exponent_that_is_off_by_a_tenth_is_seen():
    lamp = pf.DirectionalLight((1, 1, 2))
    scene = dataclasses.replace(ball(size=SIZE), lights=[lamp])
    held = {"shininess": 1.1 * float(TRUTH.shininess)}
    image = photograph(0, 95, scene=scene)
    fit = pf.fit(scene, image, film=film(95), fixed=held)
    assert about("residuals are", fit)


@pytest.mark.slow
def test_images_have_films_of_their_own():
    scene = ball(size=SIZE)
    images = photograph(0, 95), photograph(1, None)
    films = film(95), pf.Film(encoding="srgb", bits=8)
    both = pf.fit([scene, scene], images, film=films)
    assert both.film == "clamped, 8-bit srgb JPEG 4:2:0 / clamped, 8-bit srgb"
    off = (both.values - as_vector(TRUTH)) / both.errors
    assert np.abs(off).max() < 4
    # The one without losses tells more than the one with.
    assert np.all(both.errors < fits()[0].errors)
    with pytest.raises(ValueError, match="film: expected 2, one an image, got 1"):
        pf.fit([scene, scene], images, film=films[:1])
    with pytest.raises(ValueError, match="film: expected one clamp"):
        pf.fit([scene, scene], images, film=[films[0], pf.Film(clamp=False)])


@pytest.mark.slow
def test_a_refit_of_the_same_photograph_is_the_fit():
    fit = fits()[0]
    again = pf.refit(fit, ball(size=SIZE), fit.photographs)
    np.testing.assert_allclose(as_vector(again), fit.values, rtol=1e-4)


def test_errors_are_foreseen():
    foreseen = pf.predict_errors(ball(size=SIZE), TRUTH, NOISE, film=film(95))
    stated = np.median([fit.errors for fit in fits()], axis=0)
    np.testing.assert_allclose(foreseen.errors, stated, rtol=0.5)
    bits = pf.Film(encoding="srgb", bits=8)
    plain = pf.predict_errors(ball(size=SIZE), TRUTH, NOISE, film=bits)
    assert np.all(foreseen.errors > plain.errors)


def test_maps_do_not_take_the_sensors_noise_for_all_of_it():
    scene = ball(size=SIZE)
    with pytest.raises(ValueError, match="noise: expected none with films of JPEG"):
        pf.fit_maps([scene], [photograph(0, 95)], film=film(95), noise=NOISE)


def test_errors_under_uncertain_lamps_are_foreseen():
    """Lamps that may all be brighter by one share, which no photograph tells."""
    scene, known, share = ball(size=SIZE), film(95), 0.03
    names = tuple(f"scene.lights[{k}].intensity" for k in (0, 1))
    lit = [light.illuminate(jnp.zeros(3)) for light in scene.lights]
    strengths = np.concatenate([np.asarray(light.intensity) for light in lit])
    uncertain = {names: share**2 * np.outer(strengths, strengths)}
    plain, foreseen = (
        pf.predict_errors(scene, TRUTH, NOISE, film=known, **options)
        for options in ({}, {"uncertain": uncertain})
    )
    fit = pf.fit(scene, photograph(0, 95), film=known, uncertain=uncertain)
    np.testing.assert_allclose(foreseen.errors, fit.errors, rtol=0.5)
    # The material is darker by as much; ambient light is no lamp's.
    darker = [label.startswith(("diffuse", "specular")) for label in fit.labels]
    darker = np.where(darker, share * as_vector(TRUTH), 0)
    expected = np.hypot(plain.errors, darker)
    np.testing.assert_allclose(foreseen.errors, expected, rtol=0.05)
    assert foreseen.errors[3] > 2 * plain.errors[3]
