"""Photographs that were JPEG files: right errors, and a word where nobody said so."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from tests.fitting import canonical
from tests.fitting.canonical import jpeg_film, jpeg_photograph
from tests.fitting.scenes import as_vector, ball, truth

TRUTH = truth()

NOISE, DRAWS = canonical.JPEG_NOISE, 6
SCENE = ball(size=canonical.JPEG_SIZE)


@functools.cache
def fits():
    known = jpeg_film(95)
    return [
        pf.fit(SCENE, jpeg_photograph(seed, 95, SCENE), film=known)
        for seed in range(DRAWS)
    ]


def about(words, fit):
    return any(words in warning for warning in fit.warnings)


@pytest.mark.extended
def test_a_file_that_is_known():
    fit = canonical.jpeg().fit
    assert np.all(np.abs(canonical.jpeg().pulls()) < 4) and not fit.warnings
    assert fit.film == "clamped, 8-bit srgb JPEG 4:2:0"
    assert fit.noise == pytest.approx(NOISE, rel=0.4)


@pytest.mark.extended
def test_errors_are_right_where_the_file_is_known():
    pulls = [canonical.pulls(fit, TRUTH) for fit in fits()]
    assert 0.7 < np.sqrt(np.mean(np.square(pulls))) < 1.4
    noises = [fit.noise for fit in fits()]
    assert np.mean(noises) == pytest.approx(NOISE, rel=0.4)
    assert not any(about("residuals", fit) for fit in fits())


@pytest.mark.extended
def test_an_array_that_was_a_jpeg_file_is_noticed():
    for seed in range(DRAWS):
        assert about("read_film", pf.fit(SCENE, jpeg_photograph(seed, 85, SCENE)))
        assert not pf.fit(SCENE, jpeg_photograph(seed, None, SCENE)).warnings


@pytest.mark.extended
def test_a_wrong_model_is_still_seen():
    lamp = pf.DirectionalLight((-1, -1, 1), 0.02)
    more = dataclasses.replace(SCENE, lights=[*SCENE.lights, lamp])
    image = jpeg_photograph(0, 95, more)
    assert about("residuals are", pf.fit(SCENE, image, film=jpeg_film(95)))


@pytest.mark.slow
def test_an_exponent_that_is_off_by_a_tenth_is_seen():
    lamp = pf.DirectionalLight((1, 1, 2))
    scene = dataclasses.replace(SCENE, lights=[lamp])
    held = {"shininess": 1.1 * float(TRUTH.shininess)}
    image = jpeg_photograph(0, 95, scene)
    fit = pf.fit(scene, image, film=jpeg_film(95), fixed=held)
    assert about("residuals are", fit)


@pytest.mark.slow
def test_images_have_films_of_their_own():
    images = (
        jpeg_photograph(0, 95, SCENE),
        jpeg_photograph(1, None, SCENE),
    )
    films = jpeg_film(95), pf.Film(encoding="srgb", bits=8)
    both = pf.fit([SCENE, SCENE], images, film=films)
    assert both.film == "clamped, 8-bit srgb JPEG 4:2:0 / clamped, 8-bit srgb"
    off = (both.values - as_vector(TRUTH)) / both.errors
    assert np.abs(off).max() < 4
    # The one without losses tells more than the one with.
    assert np.all(both.errors < fits()[0].errors)
    with pytest.raises(ValueError, match="film: expected 2, one for each image, got 1"):
        pf.fit([SCENE, SCENE], images, film=films[:1])
    with pytest.raises(ValueError, match="film: expected one clamp"):
        pf.fit([SCENE, SCENE], images, film=[films[0], pf.Film(clamp=False)])


@pytest.mark.extended
def test_draws_of_several_images_compile_nothing_anew():
    """Programs of each draw fill the memory of a process that fits many captures."""
    scenes = [ball(size=size) for size in (24, 32)]
    images = [jpeg_photograph(k, 95, scene) for k, scene in enumerate(scenes)]
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, *_, **__: compiled.append(event) if "backend" in event else None
    )
    options: dict[str, Any] = {
        "film": jpeg_film(95),
        "unknowns": ("ambient", "diffuse", "specular", "shininess", "exposure"),
        "fixed": {"exposure[0]": 1.0},
    }
    pf.fit(scenes, images, **options)
    first = len(compiled)
    pf.fit(scenes, images, **options)
    assert first and len(compiled) == first


@pytest.mark.slow
def test_a_refit_of_the_same_photograph_is_the_fit():
    fit = fits()[0]
    again = pf.refit(fit, SCENE, fit.photographs)
    np.testing.assert_allclose(as_vector(again), fit.values, rtol=1e-4)


@pytest.mark.extended
def test_errors_are_foreseen():
    foreseen = pf.predict_errors(SCENE, TRUTH, NOISE, film=jpeg_film(95))
    np.testing.assert_allclose(foreseen.errors, canonical.jpeg().fit.errors, rtol=0.5)
    bits = pf.Film(encoding="srgb", bits=8)
    plain = pf.predict_errors(SCENE, TRUTH, NOISE, film=bits)
    assert np.all(foreseen.errors > plain.errors)


def test_maps_do_not_take_the_sensors_noise_for_all_of_it():
    image = np.full((canonical.JPEG_SIZE, canonical.JPEG_SIZE, 3), 0.5)
    with pytest.raises(ValueError, match="noise: expected none with films of JPEG"):
        pf.fit_maps([SCENE], [image], film=jpeg_film(95), noise=NOISE)


@pytest.mark.extended
def test_errors_under_uncertain_lamps_are_foreseen():
    """Lamps that may all be brighter by one share, which no photograph tells."""
    scene, known, share = SCENE, jpeg_film(95), 0.03
    names = tuple(f"scene.lights[{k}].intensity" for k in (0, 1))
    lit = [light.illuminate(jnp.zeros(3)) for light in scene.lights]
    strengths = np.concatenate([np.asarray(light.intensity) for light in lit])
    uncertain = {names: share**2 * np.outer(strengths, strengths)}
    options: dict[str, Any] = {"uncertain": uncertain}
    plain = pf.predict_errors(scene, TRUTH, NOISE, film=known)
    foreseen = pf.predict_errors(scene, TRUTH, NOISE, film=known, **options)
    fit = pf.fit(scene, canonical.jpeg().image, film=known, uncertain=uncertain)
    np.testing.assert_allclose(foreseen.errors, fit.errors, rtol=0.5)
    # The material is darker by as much; ambient light is no lamp's.
    darker = [label.startswith(("diffuse", "specular")) for label in fit.labels]
    darker = np.where(darker, share * as_vector(TRUTH), 0)
    expected = np.hypot(plain.errors, darker)
    np.testing.assert_allclose(foreseen.errors, expected, rtol=0.05)
    assert foreseen.errors[3] > 2 * plain.errors[3]


@pytest.mark.extended
@pytest.mark.parametrize("quality", [30, 50])
def test_a_coarse_file_is_named(quality):
    """At quality 30 four of five intervals of 95 % held ρ_s, without a warning."""
    image = jpeg_photograph(0, quality, SCENE)
    fit = pf.fit(SCENE, image, film=jpeg_film(quality))
    foreseen = pf.predict_errors(SCENE, TRUTH, NOISE, film=jpeg_film(quality))
    for found in (fit, foreseen):
        assert about("[coarse-jpeg]", found) == (quality == 30)
