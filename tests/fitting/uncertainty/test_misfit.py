import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.fitting.problem.losses import LOSSES
from phongfit.fitting.problem.posing import tile_side
from phongfit.fitting.uncertainty.misfit import (
    SIGNIFICANT,
    find_misfit,
    variance_inflation,
)
from phongfit.fitting.uncertainty.tiles import Measured, sum_over_tiles
from tests.fitting.scenes import ball, photograph, truth

TRUTH = truth()

SIDE = 2
SIZE = 64
# As a fit calls it.
summed = eqx.filter_jit(sum_over_tiles)


def looked_at(residual, *, used=None, loss="linear", step=None, sigma=1.0):
    """What is found in residuals (H, W, 3) of standard deviation 1."""
    height, width, _ = residual.shape
    grey = np.full(residual.shape, 0.5)
    y, x = np.indices((height, width)) / max(height, width)
    ramp = np.repeat((x + 0.1 * y)[..., None], 3, axis=-1)
    weight = np.ones((height, width, 1)) if used is None else used
    found = summed(
        Measured(
            jnp.asarray(grey + residual),
            jnp.asarray(weight, float),
            None if step is None else jnp.asarray(np.full(residual.shape, step)),
            jnp.asarray(sigma),
        ),
        jnp.asarray(grey),
        jnp.asarray(ramp),
        jnp.asarray(np.exp(-20 * ramp)),
        LOSSES[loss],
        False,
        SIDE,
    )
    return find_misfit([found], SIDE)


def noise(seed=0, size=SIZE):
    return np.random.default_rng(seed).normal(size=(size, size, 3))


def ring(height):
    """A ring as a highlight of the wrong width leaves it, at its highest `height`."""
    y, x = np.indices((SIZE, SIZE)) - SIZE / 2
    radius = np.hypot(x, y) / 12
    return height * (np.exp(-(radius**2)) - 0.4 * np.exp(-((radius / 1.6) ** 2)))


def test_noise_is_noise():
    found = [looked_at(noise(seed)) for seed in range(30)]
    assert max(one.significance for one in found) < SIGNIFICANT
    assert {one.inflation for one in found} == {1.0}
    assert all(one.neighbour_correlation == 0 for one in found)
    ratios = [one.over_repeatability for one in found]
    np.testing.assert_allclose(ratios, 1, atol=0.02)


@pytest.mark.parametrize(
    "kind", ["unequal", "heavy tails", "gaps", "levels", "rounded", "robust"]
)
def test_what_is_independent_raises_no_alarm(kind):
    """Whatever its distribution."""
    for seed in range(8):
        residual, options = noise(seed), {}
        rng = np.random.default_rng(100 + seed)
        if kind == "unequal":
            residual = residual * np.linspace(0.2, 3, SIZE)[:, None, None]
        if kind == "heavy tails":
            residual = rng.standard_t(2.2, residual.shape)
        if kind == "gaps":
            options["used"] = rng.random((SIZE, SIZE, 3)) < 0.3
        if kind == "levels":
            residual, options["sigma"] = 0.01 * residual, 1.0
        if kind == "rounded":
            residual = (np.round(5 * residual / 4) * 4) / 5
            options |= {"step": 0.8, "sigma": 1.0}
        if kind == "robust":
            residual = np.where(rng.random(residual.shape) < 0.1, 40.0, residual)
            options["loss"] = "tukey"
        found = looked_at(residual, **options)
        assert found.significance < SIGNIFICANT, (kind, seed, found)


def test_a_ring_is_seen_where_neighbours_hardly_correlate():
    residual = noise() + ring(0.8)[..., None]
    found = looked_at(residual)
    assert found.neighbour_correlation < 0.1
    assert found.significance > 6 and found.significant
    assert found.inflation > 3
    assert abs(found.row - SIZE / 2) <= 8 and abs(found.column - SIZE / 2) <= 8
    (blocks,) = found.maps
    assert blocks.shape == (SIZE // found.side,) * 2


def test_one_small_spot_is_seen():
    residual = noise()
    residual[8:14, 40:46] += 2.0
    found = looked_at(residual)
    assert found.significant
    assert abs(found.row - 11) <= found.side and abs(found.column - 43) <= found.side


def test_along_the_model():
    """Too bright where the diffuse light is large, in rows of no block's shape."""
    _, x = np.indices((SIZE, SIZE)) / SIZE
    stripes = np.where(np.indices((SIZE, SIZE))[0] % 2, 1, -1)
    residual = noise() + (0.3 * (x > 0.5) - 0.3 * stripes)[..., None]
    assert looked_at(residual).significant


def test_channels_that_cancel():
    """Red too bright and blue too dark: no sum over channels shows it."""
    residual = noise()
    residual[:32, :, 0] += 0.3
    residual[:32, :, 2] -= 0.3
    assert looked_at(residual).significant
    constant = noise()
    constant[..., 1] += 0.1
    assert looked_at(constant).significant


def test_rounding_that_samples_share_is_no_misfit():
    """Levels of light that changes slowly: sawteeth, much larger than the noise."""
    y, x = np.indices((SIZE, SIZE)) / SIZE
    light = 0.4 + 0.1 * x + 0.05 * y
    step = 1 / 255
    residual = np.repeat((np.round(light / step) * step - light)[..., None], 3, -1)
    found = looked_at(residual, step=step, sigma=1e-5)
    assert found.significance < SIGNIFICANT and np.isnan(found.over_repeatability)


def test_nothing_left_over():
    found = looked_at(np.zeros((SIZE, SIZE, 3)))
    assert found.significance == 0 and found.inflation == 1 and found.maps == ()


@pytest.mark.parametrize("shape", [(64, 64), (37, 61), (5, 3)])
def test_a_picture_of_any_size(shape):
    """One bright corner is found, whether blocks fill the picture or not."""
    residual = 0.01 * np.random.default_rng(0).normal(size=(*shape, 3))
    residual[-1, -1] = 5.0
    found = looked_at(residual)
    assert np.argmax(np.abs(found.maps[0])) == found.maps[0].size - 1
    assert found.maps[0].shape == tuple(-(-length // found.side) for length in shape)


def test_tiles_are_small_in_small_images():
    assert [tile_side(n, n) for n in (16, 32, 64, 128, 256, 2048)] == [
        *(1, 1, 2, 4, 8, 8)
    ]


@pytest.mark.parametrize(("correlation", "factor"), [(-0.5, 1), (0, 1), (0.5, 9)])
def test_variance_inflation(correlation, factor):
    assert variance_inflation(correlation) == pytest.approx(factor)


def test_one_channel_stored_thrice():
    """Channels share their noise: the model is right, and three know what one does."""
    alike = np.repeat(noise()[..., :1], 3, axis=-1)
    found = looked_at(alike)
    assert found.channel_correlation == pytest.approx(1, abs=1e-3)
    assert not found.significant
    assert looked_at(noise()).channel_correlation == 0
    half = (noise(1) + alike) / np.sqrt(2)
    assert looked_at(half).channel_correlation == pytest.approx(0.5, abs=0.05)


@pytest.mark.extended
def test_rounding_of_the_arithmetic_is_no_misfit():
    """What an image without noise leaves has a pattern, and means nothing."""
    scene = ball()
    for seed in range(8):
        rng = np.random.default_rng(seed)
        truth = pf.Material(
            rng.uniform(0.1, 0.9, 3),
            rng.uniform(0.15, 0.8, 3),
            np.exp(rng.uniform(np.log(5), np.log(100))),
            rng.uniform(0.1, 0.9, 3),
        )
        image = pf.render(scene, truth, film=pf.Film(clamp=False))
        fit = pf.fit(scene, np.asarray(image))
        assert not fit.misfit.significant and not fit.warnings, seed


@pytest.mark.extended
@pytest.mark.parametrize("loss", ["linear", "huber"])
def test_errors_where_channels_share_their_noise(loss):
    """What channels share is known from one of them; what each has, as ever."""
    scene = ball()
    clean = photograph(scene, TRUTH)
    rng = np.random.default_rng(0)
    own = 0.01 * rng.normal(size=clean.shape)
    apart = pf.fit(scene, clean + own, loss=loss)
    alike = pf.fit(scene, clean + own[..., :1], loss=loss)
    assert not alike.warnings
    ratio = alike.errors / apart.errors
    labels = list(alike.labels)
    assert ratio[labels.index("shininess")] == pytest.approx(np.sqrt(3), rel=0.15)
    assert ratio[labels.index("ambient.red")] == pytest.approx(1, rel=0.1)


def test_mean_of_neighbours_correlates():
    white = noise(size=SIZE + 1)
    # A 2 × 2 mean shares half of its pixels with the one beside it.
    smooth = (white[1:, 1:] + white[:-1, 1:] + white[1:, :-1] + white[:-1, :-1]) / 4
    found = looked_at(smooth)
    assert found.neighbour_correlation == pytest.approx(0.5, abs=0.03)
    assert found.over_repeatability == pytest.approx(np.sqrt(2), rel=0.05)


def test_only_pairs_inside_the_mask_count():
    # A constant in every second column: no pixel there has a neighbour to its side.
    used = np.zeros((SIZE, SIZE, 3))
    used[:, ::2] = 1
    rows = np.where(np.arange(SIZE) % 2, 1.0, -1.0)[:, None, None]
    residual = np.broadcast_to(rows, (SIZE, SIZE, 3))
    assert looked_at(residual, used=used).neighbour_correlation == -1


@pytest.mark.extended
def test_an_exponent_that_is_held_wrongly():
    """The ring of a highlight a tenth too narrow; held right, there is nothing."""
    camera = pf.OrthographicCamera(SIZE, SIZE)
    scene = pf.Scene(pf.Sphere(), camera, pf.DirectionalLight((1, 1, 2)), ambient=0.3)
    truth = pf.Material((0.6, 0.3, 0.2), 0.3, 60.0, 0.5)
    light = np.asarray(pf.render(scene, truth, film=pf.Film(clamp=False)))
    image = light + 0.005 * noise()
    wrong = pf.fit(scene, image, fixed={"shininess": 66.0})
    right = pf.fit(scene, image, fixed={"shininess": 60.0})
    assert not right.warnings and not right.misfit.significant
    (warning,) = wrong.warnings
    assert warning.startswith("residuals are not noise")
    widened = np.sqrt(wrong.misfit.inflation)
    assert f"errors are widened {widened:.1f} times" in warning and widened > 2
