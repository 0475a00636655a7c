"""Samples that one channel has and another has not: the exponent uses them all."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import phongfit as pf
from tests.maps.synthetic import Stack, dtype, make_stack, noisy, pulls, same, shown

pytestmark = pytest.mark.extended

LIGHTS, NOISE = 24, 0.01
PARAMETERS = ("ambient", "diffuse", "specular", "shininess")
EVERY = np.ones((20, 20, 3), bool)


@pytest.fixture(scope="module")
def stack() -> Stack:
    return make_stack(20, 20, LIGHTS, noise=NOISE)


def fitted(stack: Stack, mask: list[np.ndarray], images: Any = None) -> pf.Maps:
    """Of one kind, so that all maps here share what is compiled."""
    images = stack.images if images is None else images
    return pf.fit_maps(stack.scenes, images, noise=NOISE, mask=mask)


def coverage(maps: pf.Maps, truth: pf.Material, name: str) -> float:
    """Share of the intervals of 95 % that hold the truth, cut at the bounds."""
    error = np.asarray(getattr(maps.stderr, name), float)
    value = np.asarray(getattr(maps, name), float)
    true = np.broadcast_to(np.asarray(getattr(truth, name), float), value.shape)
    inside = np.abs(value - true) <= 1.96 * error
    return float(inside[np.isfinite(error)].mean())


def mosaic() -> list[np.ndarray]:
    """A Bayer filter that moved between the photographs."""
    rng = np.random.default_rng(1)
    channel = rng.choice(3, size=(LIGHTS, 20, 20), p=(0.25, 0.5, 0.25))
    return list(channel[..., None] == np.arange(3))


def test_a_mosaic(stack):
    maps = fitted(stack, mosaic())
    assert np.all(maps.samples == LIGHTS)
    for name in PARAMETERS:
        found = coverage(maps, stack.truth, name)
        # Exponents near the end of what the data tell have wide, one-sided errors.
        assert 0.92 < found < (0.995 if name == "shininess" else 0.98), name
        assert np.mean(np.isfinite(getattr(maps.stderr, name))) > 0.85, name
    # Of 14 degrees of freedom 1.4 % lie above 2.
    assert np.mean(maps.chi_squared > 2) < 0.04
    far = scipy.stats.chi2.sf(14 * maps.chi_squared, 14) < 1e-4
    assert np.mean(far) < 0.01


def test_a_mosaic_that_leaves_two_samples_more_than_unknowns():
    """Their noise came out too small by chance, and 5 exponents of 343 far too sure."""
    few = make_stack(20, 20, LIGHTS // 2, noise=NOISE)
    maps = pf.fit_maps(few.scenes, few.images, mask=mosaic()[: LIGHTS // 2])
    error = maps.stderr.shininess
    identified = np.isfinite(error)
    off = np.abs(maps.shininess - np.asarray(few.truth.shininess))[identified]
    assert identified.sum() > 150
    assert np.all(off < 5 * error[identified])
    assert np.mean(off < 1.96 * error[identified]) > 0.92


def test_a_saturated_channel():
    usual = make_stack(20, 20, LIGHTS, noise=NOISE)
    diffuse, specular = (
        np.array(leaf) for leaf in (usual.truth.diffuse, usual.truth.specular)
    )
    rng = np.random.default_rng(2)
    diffuse[..., 0] = rng.uniform(0.85, 0.95, (20, 20))
    specular[..., 0] = rng.uniform(0.6, 0.9, (20, 20))
    truth = pf.Material(
        jnp.asarray(diffuse),
        jnp.asarray(specular),
        usual.truth.shininess,
        usual.truth.ambient,
    )
    images = np.minimum(noisy(shown(usual.scenes, truth), NOISE, rng), 1)
    assert np.mean(images[..., 0] == 1) > 0.25 and np.all(images[..., 1:] < 1)
    maps = fitted(usual, [EVERY] * LIGHTS, images)
    for name in PARAMETERS:
        assert 0.92 < coverage(maps, truth, name) < 0.98, name
    assert np.mean(maps.chi_squared > 1.8) < 0.01


def test_a_masked_channel(stack):
    """Green and blue tell the exponent, though of red nothing is known."""
    maps = fitted(stack, [EVERY & [False, True, True]] * LIGHTS)
    assert np.mean(np.isfinite(maps.stderr.shininess)) > 0.9
    assert 0.92 < coverage(maps, stack.truth, "shininess") < 0.99
    assert np.isinf(maps.stderr.specular[..., 0]).all()


def test_pixels_at_a_bound(stack):
    """What lies at its bound takes nothing from the errors of the others."""
    rng = np.random.default_rng(3)
    truth = pf.Material(
        np.where(rng.random((20, 20, 3)) < 1 / 3, 0, np.asarray(stack.truth.diffuse)),
        stack.truth.specular,
        stack.truth.shininess,
        np.where(rng.random((20, 20, 3)) < 1 / 3, 0, np.asarray(stack.truth.ambient)),
    )
    images = noisy(shown(stack.scenes, truth), NOISE, rng)
    # Of a mosaic: what few samples tell is more correlated.
    maps = fitted(stack, mosaic(), images)
    bound = maps.flagged(pf.Flag.AT_BOUND)
    assert 0.5 < bound.mean() < 0.95
    for name in PARAMETERS:
        error = getattr(maps.stderr, name)[bound]
        off = np.abs(getattr(maps, name) - np.asarray(getattr(truth, name)))[bound]
        identified = np.isfinite(error)
        assert np.mean(off[identified] > 5 * error[identified]) < 0.002, name
        assert 0.92 < np.mean(off[identified] < 1.96 * error[identified]), name


def test_lamps_of_several_colours():
    """The sum of the channels says nothing of the exponent there."""
    stack = make_stack(20, 20, LIGHTS, noise=0.0)
    colours = np.array([(1, 0.15, 0.1), (0.15, 1, 0.1), (0.1, 0.2, 1)])
    rng = np.random.default_rng(4)
    lamps = [scene.lights[0] for scene in stack.scenes]
    scenes = tuple(
        pf.Scene(
            scene.surface,
            scene.camera,
            pf.DirectionalLight(lamps[k].direction, tuple(colours[k % 3])),
            0.3,
        )
        for scene, k in zip(stack.scenes, rng.permutation(LIGHTS), strict=True)
    )
    truth = pf.Material(
        rng.uniform(0.05, 0.5, (20, 20, 3)),
        rng.uniform(0.05, 0.4, (20, 20, 3)),
        stack.truth.shininess,
        stack.truth.ambient,
    )
    images = noisy(shown(scenes, truth), NOISE, rng)
    maps = fitted(Stack(scenes, images, truth), [EVERY] * LIGHTS)
    assert np.mean(maps.chi_squared > 1.8) < 0.005
    assert np.mean(np.abs(pulls(maps, truth, "shininess")) > 5) == 0


def test_a_wrong_model_is_said_and_widens_errors(stack, tmp_path):
    """A shadow that no scene knows of, over half of the picture."""
    shadow = stack.images.copy()
    shadow[:4, :, :10] *= dtype().type(0.5)
    right, wrong = (
        fitted(stack, [EVERY] * LIGHTS, images) for images in (stack.images, shadow)
    )
    assert not right.flagged(pf.Flag.MISFIT).any()
    misfit = wrong.flagged(pf.Flag.MISFIT)
    assert misfit[:, :10].mean() > 0.98 and not misfit[:, 10:].any()
    ratio = wrong.stderr.ambient[misfit] / right.stderr.ambient[misfit]
    expected = np.sqrt(wrong.chi_squared[misfit])
    # Ambient light is what the exponent says least of.
    assert np.median(ratio[..., 0] / expected) == pytest.approx(1, abs=0.2)
    wrong.save(tmp_path / "maps.npz")
    same(pf.load_maps(tmp_path / "maps.npz"), wrong)
    assert "misfit" in str(wrong)
