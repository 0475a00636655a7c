"""Maps: the truth within its errors, and what a pixel does not identify is said."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import phongfit as pf
from phongfit.maps.pixel.settings import Flag
from phongfit.maps.tiles import Team, tile_size
from tests.maps.synthetic import (
    FREE,
    Stack,
    dtype,
    make_stack,
    noisy,
    pulls,
    shown,
    spread,
)

PARAMETERS = ("ambient", "diffuse", "specular", "shininess")


@pytest.fixture(scope="module")
def stack() -> Stack:
    return make_stack()


@pytest.fixture(scope="module")
def maps(stack: Stack) -> pf.Maps:
    return pf.fit_maps(stack.scenes, stack.images, film=FREE)


def test_truth_lies_within_the_errors(stack, maps):
    assert maps.identified.mean() > 0.95
    for name in PARAMETERS:
        pull = pulls(maps, stack.truth, name)
        assert abs(pull.mean()) < 6 / np.sqrt(pull.size) + 0.03, name
        assert 0.9 < spread(pull) < 1.1, name
    assert np.median(maps.noise) == pytest.approx(0.01, rel=0.05)
    assert np.median(maps.chi_squared) == pytest.approx(1, rel=0.05)


def test_a_specification_and_what_maps_have_no_use_for(stack, maps):
    asked = pf.Specification(film=FREE)
    again = pf.fit_maps(stack.scenes, stack.images, asked, tile_pixels=4096)
    np.testing.assert_array_equal(again.diffuse, maps.diffuse)
    with pytest.raises(ValueError, match="fixed: expected its default in fit_maps"):
        pf.fit_maps(stack.scenes, stack.images, asked, fixed={"diffuse": 0.5})
    with pytest.raises(TypeError, match="'unknown', expected one of scenes, images"):
        pf.fit_maps(stack.scenes, stack.images, unknown=())  # pyright: ignore


@pytest.mark.extended
def test_under_a_sky_as_well(stack):
    """Known light from all around: it makes no sample lit, and no normal known."""
    sky = pf.HarmonicLight([0.4, 0.2, 0.1, 0, 0, 0.05, 0.1, 0, 0])
    scenes = [
        dataclasses.replace(scene, lights=(*scene.lights, sky))
        for scene in stack.scenes
    ]
    alone = dataclasses.replace(scenes[0], lights=sky, ambient=0.0)
    white = pf.Material(1.0, 0.0, 10.0, 0.0)
    around = np.asarray(pf.render(alone, white, film=FREE))
    images = stack.images + np.asarray(stack.truth.diffuse) * around
    found = pf.fit_maps(scenes, images.astype(dtype()), film=FREE)
    pull = pulls(found, stack.truth, "diffuse")
    assert abs(pull.mean()) < 6 / np.sqrt(pull.size) + 0.03
    assert 0.9 < spread(pull) < 1.1
    with pytest.raises(ValueError, match="lights with a direction where normals"):
        pf.fit_maps(scenes, images, film=FREE, normals="fit")


def test_material_renders_what_was_seen(stack, maps):
    off = shown(stack.scenes[:3], maps.material) - stack.images[:3]
    assert np.sqrt(np.mean(off**2)) < 0.0115


def test_bad_pixels_are_marked_and_disturb_none(stack, maps):
    images = stack.images.copy()
    images[:, 3, 4] = 0
    images[2, 5, 6, 1] = np.nan
    images[:, 7, 8] = np.inf
    images[4:, 9, 10] = np.nan
    mask = np.ones((16, 24), bool)
    mask[0, 0] = False
    found = pf.fit_maps(stack.scenes, images, film=FREE, mask=mask)
    assert found.flagged(pf.Flag.BLACK)[3, 4]
    assert found.flagged(pf.Flag.NOT_FINITE)[[5, 7, 9], [6, 8, 10]].all()
    assert found.flagged(pf.Flag.TOO_FEW)[7, 8]
    assert found.flagged(pf.Flag.OUTSIDE)[0, 0]
    assert found.flags[0, 0] == pf.Flag.OUTSIDE and found.samples[0, 0] == 0
    assert found.samples[5, 6] == 47 and found.identified[5, 6]
    for y, x in ((3, 4), (7, 8), (0, 0)):
        assert not found.identified[y, x]
        for name in PARAMETERS:
            assert np.isinf(getattr(found.stderr, name)[y, x]).all()
    touched = np.zeros((16, 24), bool)
    touched[[3, 5, 7, 9, 0], [4, 6, 8, 10, 0]] = True
    for name in PARAMETERS:
        values, before = getattr(found, name), getattr(maps, name)
        assert np.isfinite(values).all()
        np.testing.assert_allclose(values[~touched], before[~touched], rtol=1e-3)
        assert not np.isnan(getattr(found.stderr, name)).any()


@pytest.mark.extended
def test_saturated_samples_are_left_out(stack):
    """Clamped at 1, a sample says too little: a known film leaves it out."""
    flat = pf.Material(0.0, 0.6, 5.0, 0.4)
    shiny = pf.Material(stack.truth.diffuse, 0.6, 5.0, 0.4)
    clamped = shown(stack.scenes, shiny, pf.Film())
    assert np.mean(clamped == 1) > 0.01
    honest, given, wrong = (
        pf.fit_maps(stack.scenes, clamped, unknowns=("diffuse",), known=flat, film=film)
        for film in (None, pf.Film(), FREE)
    )
    assert honest.samples.sum() < wrong.samples.sum()
    for found in (honest, given):
        np.testing.assert_allclose(found.diffuse, stack.truth.diffuse, atol=1e-5)
    assert np.abs(wrong.diffuse - np.asarray(stack.truth.diffuse)).max() > 0.01


@pytest.mark.extended
def test_no_highlight_and_no_light_are_told(stack):
    """A matte pixel has no exponent; one without ambient light has no ρ_a."""
    matte = make_stack(ambient=0.0)
    truth = pf.Material(matte.truth.diffuse, 0.0, 32.0, 0.0)
    images = noisy(shown(matte.scenes, truth), 0.01, np.random.default_rng(1))
    found = pf.fit_maps(matte.scenes, images, film=FREE, noise=0.01)
    dim = found.flagged(pf.Flag.NO_HIGHLIGHT)
    assert dim.mean() > 0.9
    assert np.isinf(found.stderr.shininess[dim]).all()
    assert np.isinf(found.stderr.ambient).all() and not found.ambient.any()
    assert "ambient" not in found.unknowns
    pull = (found.diffuse - np.asarray(truth.diffuse)) / found.stderr.diffuse
    assert np.median(np.abs(pull[dim])) < 1
    assert found.noise_given == 0.01


@pytest.mark.usefixtures("precision")
def test_some_leaves_may_be_known():
    """With the lights and unknowns of tests of tiles, whose program it shares."""
    stack = make_stack(lights=4, ambient=0.0)
    known = stack.truth
    flat = pf.Material(0.0, 0.3, 15.0, 0.4)
    with pytest.raises(ValueError, match="known: expected parameters of shape"):
        pf.fit_maps(stack.scenes, stack.images, unknowns=("diffuse",), known=known)
    painted = pf.Material(known.diffuse, 0.3, 15.0, 0.0)
    images = shown(stack.scenes, painted)
    found = pf.fit_maps(
        stack.scenes, images, unknowns=("diffuse",), known=flat, film=FREE
    )
    lit = found.identified
    assert lit.mean() > 0.9
    np.testing.assert_allclose(found.diffuse[lit], known.diffuse[lit], atol=1e-5)
    assert not found.stderr.specular.any() and (found.shininess == 15).all()


def test_dark_surfaces_under_bright_lamps_without_noise():
    """Residuals are far below the rounding of the images' squares."""
    stack = make_stack(lights=4, ambient=0.0, color=(20.0, 18.0, 16.0))
    dark = pf.Material(stack.truth.diffuse / 20, 0.015, 15.0, 0.0)
    images = shown(stack.scenes, dark)
    flat = pf.Material(0.0, 0.015, 15.0, 0.4)
    found = pf.fit_maps(
        stack.scenes, images, unknowns=("diffuse",), known=flat, film=FREE
    )
    lit = found.identified
    assert lit.mean() > 0.9
    np.testing.assert_allclose(found.diffuse[lit], dark.diffuse[lit], rtol=1e-4)


TUKEY: dict[str, Any] = {"loss": "tukey", "noise": 0.01}


@pytest.mark.extended
def test_an_outlier_in_the_highlight():
    """It may draw the first solution after it; starts without it find the truth."""
    stack = make_stack(30, 40, 16, noise=0.01)
    rng = np.random.default_rng(5)
    hit = rng.random(stack.images.shape) < 0.1
    spoilt = np.where(hit, rng.random(stack.images.shape), stack.images).astype(dtype())
    maps = pf.fit_maps(stack.scenes, spoilt, tile_pixels=512, **TUKEY)
    trusted = maps.identified & ~maps.flagged(Flag.MISFIT)
    assert trusted.mean() > 0.95
    for name, most in (("shininess", 0.005), ("specular", 0.012)):
        off = np.abs(getattr(maps, name) - np.asarray(getattr(stack.truth, name)))
        far = np.any(off > 5 * getattr(maps.stderr, name), axis=-1)
        assert far[trusted].mean() < most, name


@pytest.mark.extended
def test_a_robust_loss_says_misfit():
    """Where most samples are not as the model has them, a loss cannot reject them."""
    stack = make_stack(8, 10, 16, noise=0.01)
    wrong = stack.images.copy()
    wrong[::2, :4] *= dtype().type(0.5)
    maps = pf.fit_maps(stack.scenes, wrong, **TUKEY)
    misfit = maps.flagged(Flag.MISFIT)
    assert misfit[:4].mean() > 0.8 and not misfit[4:].any()


@pytest.mark.slow
def test_robust_loss_ignores_outliers():
    stack = make_stack(16, 24, 40, ambient=0.0)
    rng = np.random.default_rng(5)
    # One image in eight lies in a cast shadow that no scene knows of.
    dark = rng.random(stack.images.shape[:3]) < 1 / 8
    images = np.where(dark[..., None], 0.02, stack.images).astype(dtype())
    plain, robust = (
        pf.fit_maps(stack.scenes, images, film=FREE, loss=loss)
        for loss in ("linear", "cauchy")
    )
    for name in ("diffuse", "specular"):
        true = np.asarray(getattr(stack.truth, name))
        off = [
            np.median(np.abs(np.asarray(getattr(m, name)) - true))
            for m in (robust, plain)
        ]
        assert off[0] < 0.4 * off[1], name
    assert np.median(robust.noise) < 0.02
    moving = robust.flagged(Flag.NOT_CONVERGED)
    assert moving.mean() < 0.02 and not (robust.identified & moving).any()
    # Errors rest on the samples that the loss accepts, and count the unknowns.
    for name in ("diffuse", "specular", "shininess"):
        pull = pulls(robust, stack.truth, name)
        assert 0.91 < np.mean(np.abs(pull) < 1.96) < 0.98, name
        assert np.mean(np.abs(pull) > 5) < 0.01, name


def test_what_has_not_converged_is_never_identified(maps):
    assert maps.identified[0, 0]
    flags = maps.flags.copy()
    flags[0, 0] |= Flag.NOT_CONVERGED
    assert not dataclasses.replace(maps, flags=flags).identified[0, 0]


@pytest.mark.extended
def test_it_converges_though_the_model_is_wrong():
    """As on photographs: a surface that is not Lambert's, and a narrow highlight."""
    stack = make_stack(16, 24, 40, ambient=0.0)
    matte, glint = pf.Material((0.5, 0.3, 0.2), 0.0), pf.Material(0.0, 0.1, 800.0)
    images = 0.5 * shown(stack.scenes, matte) ** 1.3 + shown(stack.scenes, glint)
    found = pf.fit_maps(stack.scenes, images, film=FREE)
    assert np.median(found.noise) > 0.004
    # Steps of Gauss and Newton alone leave 16 % behind.
    assert np.mean(found.flagged(Flag.NOT_CONVERGED)) < 0.03


@pytest.mark.extended
def test_an_exponent_for_each_channel(stack):
    leaves = ("ambient", "diffuse", "specular", "shininess")
    first = pf.Material(shininess=15.0)
    found = pf.fit_maps(
        stack.scenes, stack.images, film=FREE, per_channel=leaves, start=first
    )
    assert found.shininess.shape == (16, 24, 3)
    true = np.broadcast_to(np.asarray(stack.truth.shininess), (16, 24, 3))
    pull = ((found.shininess - true) / found.stderr.shininess)[found.identified]
    assert found.identified.mean() > 0.95
    # Where an exponent is vague its error is that of the profile, which is wide.
    assert 0.8 < spread(pull) < 1.1


@pytest.mark.slow
def test_sixteen_thousand_pixels():
    """χ² of the parameters, pixel by pixel, on 16 000 pixels and 96 lights."""
    stack = make_stack(128, 125, 96)
    maps = pf.fit_maps(stack.scenes, stack.images, film=FREE)
    assert maps.identified.mean() > 0.99
    for name in PARAMETERS:
        pull = pulls(maps, stack.truth, name)
        assert np.mean(pull**2) == pytest.approx(1, abs=0.08), name
        assert np.mean(np.abs(pull) < 1.96) == pytest.approx(0.95, abs=0.01), name


@pytest.mark.parametrize(("cores", "most"), [(2, 2**25), (64, 2**28)])
def test_the_tiles_of_all_cores_fit_into_memory(cores, most):
    team = Team([SimpleNamespace(platform="cpu")], cores)
    light = cores * tile_size(10**8, 30, None, team) * 30 * 12
    assert 0.9 * most < light < 1.1 * most
