"""How strong the light of each photograph was: against what it was made with."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from data_synth.lights import spread_directions
from phongfit.maps.job import make_job
from phongfit.maps.layers import mask_layers
from phongfit.maps.result import Strengths
from phongfit.maps.stacks import ArrayStack
from phongfit.maps.strengths import find_strengths, may_be_equal, sample_points, solve
from tests.maps.synthetic import FREE, dtype, noisy, shown

CAMERA = pf.OrthographicCamera(32, 28, view_height=2.2)
LAMPS = spread_directions(10)
TRUE = np.random.default_rng(0).uniform(0.4, 1.6, 10)
TRUE /= TRUE.mean()
NOISE = 0.004


def scenes() -> list[pf.Scene]:
    return [pf.Scene(pf.Sphere(), CAMERA, pf.DirectionalLight(lamp)) for lamp in LAMPS]


def photographs(specular: float, true=TRUE) -> np.ndarray:
    rng = np.random.default_rng(1)
    material = pf.Material((0.5, 0.35, 0.25), specular, 25.0, 0.0)
    light = shown(scenes(), material).astype(float)
    images = np.stack([t * one for t, one in zip(true, light, strict=True)])
    return noisy(images, NOISE, rng)


def check(found: Strengths, true: np.ndarray, most: float, error=0.15) -> None:
    assert found.values.shape == true.shape
    np.testing.assert_allclose(found.values / true, 1, atol=most)
    # Lamps whose directions are not quite right look like others.
    assert (most * found.values < found.stderr).all() and found.stderr.max() < error


def matte(images: np.ndarray, mask=None, per_channel: bool = False) -> Strengths:
    def never(*args, **options):
        raise AssertionError("a matte surface needs no maps")

    job = make_job(
        scenes(),
        ArrayStack(images),
        mask=mask,
        unknowns=("diffuse",),
        normals="fit",
        film=FREE,
    )
    return find_strengths(never, job, per_channel=per_channel)


def test_of_a_matte_surface():
    check(matte(photographs(0.0)), TRUE, 0.005)


def test_equal_lamps_may_be_equal():
    assert may_be_equal(matte(photographs(0.0, np.ones(10))))
    assert not may_be_equal(matte(photographs(0.0)))


def test_of_each_channel():
    rng = np.random.default_rng(3)
    true = TRUE[:, None] * rng.uniform(0.8, 1.2, (10, 3))
    true /= true.mean(axis=0)
    check(matte(photographs(0.0, true[:, None, None]), per_channel=True), true, 0.008)


def test_shadows_and_masks_are_left_out():
    images = photographs(0.0)
    images[2:5, 8:14, 6:20] *= dtype().type(0.2)
    check(matte(images), TRUE, 0.01)
    wrong = images.copy()
    wrong[:, :, :16] **= 2
    mask = np.zeros(images.shape[1:3], bool)
    mask[:, 16:] = True
    wrong[3, 10:12, 20:24] = np.nan
    check(matte(wrong, mask), TRUE, 0.02)


def test_too_dark_to_tell():
    with pytest.raises(ValueError, match="strengths: no pixel is bright enough"):
        matte(np.zeros((10, 28, 32, 3), dtype()))


def test_near_lamps_have_their_own_directions_at_each_point():
    lamps = [pf.PointLight(3 * lamp, attenuation=(0, 0, 1 / 9)) for lamp in LAMPS]
    near = [
        dataclasses.replace(s, lights=(x,))
        for s, x in zip(scenes(), lamps, strict=True)
    ]
    buffer = near[0].trace()
    material = pf.Material(0.4, 0.0, 1.0, 0.0)
    images = TRUE[:, None, None, None] * shown(near, material)
    stack = ArrayStack(images.astype(dtype()))
    masks = mask_layers(None, stack.shape)
    _, points = sample_points(near, stack, buffer, masks, np.inf)
    found, _ = solve(points, np.zeros(points.light.shape), np.ones((10, 1)))
    np.testing.assert_allclose(found.values[:, 0], TRUE, rtol=2e-3)


def test_scenes_under_light_so_strong():
    ambient = [dataclasses.replace(s, ambient=jnp.full(3, 0.5)) for s in scenes()]
    lit = Strengths(TRUE, TRUE / 100).lit(ambient)
    lights: Any = [scene.lights[0] for scene in lit]
    near = [np.asarray(light.intensity) for light in lights]
    np.testing.assert_allclose(near, TRUE[:, None] * np.ones(3), rtol=1e-6)
    np.testing.assert_allclose(lit[0].ambient, 0.5 * TRUE[0], rtol=1e-6)
    np.testing.assert_allclose(lights[0].direction, LAMPS[0], atol=1e-6)


@pytest.mark.extended
@pytest.mark.parametrize("true, warned", [(np.ones(10), False), (TRUE, True)])
def test_given_strengths_that_are_wrong_are_a_warning(true, warned):
    options: dict[str, Any] = {"unknowns": ("diffuse",), "normals": "fit"}
    images = photographs(0.0, true)
    maps = pf.fit_maps(scenes(), images, film=FREE, progress=False, **options)
    codes = [pf.warning_code(one) for one in maps.warnings]
    assert codes == ["strengths-doubtful"] * warned


@pytest.mark.parametrize("given", [{}, {"normals": "given"}])
def test_normals_that_are_given_are_refused(given):
    with pytest.raises(ValueError, match="strengths: expected 'given' where normals"):
        pf.fit_maps(scenes(), photographs(0.0), strengths="fit", **given)


@pytest.mark.extended
def test_maps_of_a_glossy_ball(tmp_path):
    options = {"normals": "fit", "film": FREE, "passes": 1, "progress": False}
    options |= {"per_channel": ("diffuse",)}
    maps = pf.fit_maps(scenes(), photographs(0.3), strengths="fit", **options)
    assert maps.strengths is not None
    # Lamps 2° elsewhere make strengths of a glossy ball a tenth wrong.
    check(maps.strengths, TRUE, 0.02, 0.4)
    assert "strengths of the light fitted: 0." in str(maps)
    known = maps.identified
    assert abs(np.median(maps.shininess[known]) / 25 - 1) < 0.1
    maps.save(tmp_path / "maps.npz")
    again = pf.load_maps(tmp_path / "maps.npz")
    assert again.strengths is not None
    np.testing.assert_array_equal(again.strengths.values, maps.strengths.values)
    # Held at 1, they leave what is no noise.
    held = pf.fit_maps(scenes(), photographs(0.3), **options)
    assert held.strengths is None
    assert np.nanmedian(held.noise) > 3 * np.nanmedian(maps.noise)
