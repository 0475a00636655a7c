"""Maps in passes: where a surface is, and what lies in its shadow, from its normals."""

import dataclasses

import jax
import numpy as np
import pytest

import phongfit as pf
from data_synth.lights import spread_directions
from phongfit.maps.job import make_job
from phongfit.maps.passes import find_offset, moved
from phongfit.maps.pixel.block import samples_of
from phongfit.maps.stacks import ArrayStack, KeptStack
from tests.maps.hills import CAMERA, SIZE, bumps
from tests.maps.synthetic import FREE, noisy, same, shown

TRUTH = pf.Material((0.4, 0.3, 0.2), 0.3, 20.0, 0.0)
RAISED = 0.5


def hills(near: bool, camera: pf.geometry.AbstractCamera = CAMERA) -> tuple:
    """Scenes of a plane, images of hills above it that throw shadows, and the hills."""
    down, right = np.gradient(bumps(), 0.1)
    normals = np.stack([-right, down, np.ones(SIZE)], axis=-1)
    rays = np.asarray(camera.rays().origin, float) * [1, 1, 0]
    points = rays + bumps()[..., None] * [0, 0, 1] + [0, 0, RAISED if near else 0]
    surface = pf.NormalMap(normals, positions=points)
    directions = spread_directions(12) * [1, 1, 0.6]
    lamps = [
        pf.PointLight(3 * d, attenuation=(0, 0, 1 / 9))
        if near
        else pf.DirectionalLight(d)
        for d in directions
    ]
    true = [pf.Scene(surface, camera, lamp, shadows=True) for lamp in lamps]
    images = noisy(shown(true, TRUTH), 0.003, np.random.default_rng(0))
    plane = pf.NormalMap(np.broadcast_to([0.0, 0, 1], normals.shape), positions=rays)
    flat = [dataclasses.replace(s, surface=plane, shadows=False) for s in true]
    return flat, images, surface, true


def found(scenes, images, **options) -> pf.Maps:
    return pf.fit_maps(
        scenes,
        images,
        film=FREE,
        normals="fit",
        per_channel=("diffuse",),
        progress=False,
        **options,
    )


def angles(maps: pf.Maps, surface: pf.NormalMap) -> np.ndarray:
    cosine = np.sum(maps.normals * np.asarray(surface.normals), axis=-1)
    return np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))


@pytest.mark.extended
def test_near_lamps_tell_where_the_surface_is(tmp_path):
    scenes, images, surface, _ = hills(near=True)
    folder = tmp_path / "tiles"
    once = found(scenes, images, passes=1, out=tmp_path / "once")
    # Three passes are the default with near lamps; here they do not quite do.
    again = found(scenes, images, passes=4, out=folder)
    assert [pf.warning_code(one) for one in once.warnings] == ["pixels-misplaced"]
    assert not again.warnings
    wrong = [abs(np.median(m.specular[m.identified]) / 0.3 - 1) for m in (once, again)]
    assert wrong[1] < 0.03 < 0.5 < wrong[0]
    assert np.median(once.noise) > 0.03 and np.median(again.noise) < 0.005
    assert angles(once, surface).mean() > 5 and angles(again, surface).mean() < 1
    passes = sorted(path.name for path in folder.glob("pass_*"))
    assert passes == ["pass_1", "pass_2", "pass_3"]
    # The store itself has the last pass, which another number would replace.
    stored = pf.StoredMaps(folder).load()
    same(stored, again)
    assert stored.misplacement == again.misplacement
    with pytest.raises(ValueError, match="another job .*passes differs"):
        found(scenes, images, passes=3, out=folder)


def test_what_tells_the_distance_is_read_once():
    asked = []

    class Counted(ArrayStack):
        def take_coded(self, pixels, order):
            asked.append(len(pixels))
            return super().take_coded(pixels, order)

    kept = KeptStack(Counted(np.random.default_rng(0).random((2, 4, 5, 3))))
    first = kept.take(np.arange(5), (1, 0))
    np.testing.assert_array_equal(kept.take(np.arange(5), (1, 0)), first)
    assert asked == [5]
    assert not np.array_equal(kept.take(np.arange(5), (0, 1)), first)
    kept.take(np.arange(4), (0, 1))
    assert asked == [5, 5, 4]


@pytest.mark.slow
def test_shadows_are_left_out():
    scenes, images, _, true = hills(near=False)
    dark = np.stack([np.asarray(s.trace().visibility)[..., 0] == 0 for s in true])
    lit = np.median(images, axis=-1) > 0.02
    twice = found(scenes, images)
    once = found(scenes, images, passes=1)
    lost = (once.samples - twice.samples) / 3
    assert dark.sum() > 200 and np.all(once.samples == 36)
    # As many as there are, but for the rims of shadows.
    assert abs(lost.sum() / dark.sum() - 1) < 0.15
    assert np.all(lost[(dark | ~lit).sum(axis=0) == 0] <= 2)


@pytest.mark.parametrize("lamps", [1, 2])
def test_one_program_serves_all_passes(lamps):
    """It is compiled for what tiles are made of, whether there is a shadow or not."""
    scenes, images, _, true = hills(near=False)
    tiles = []
    for known in (scenes, true):
        lit = [dataclasses.replace(s, lights=s.lights * lamps) for s in known]
        job = make_job(lit, ArrayStack(images), normals="fit", film=FREE)
        tiles.append(job.tile(job.pixels[::20], 80))
    first, later = (jax.tree.map(lambda a: (a.shape, a.dtype), tile) for tile in tiles)
    assert first == later and first.visibility[0] == (12, lamps, 80)
    assert np.all(tiles[0].visibility == 1) and np.any(tiles[1].visibility == 0)


@pytest.mark.parametrize("lamps", [1, 2])
def test_only_what_lies_in_shadow_is_left_out(lamps):
    """Of an image that no lamp lights, nothing does."""
    _, images, _, true = hills(near=False)
    lit = [dataclasses.replace(s, lights=s.lights * lamps) for s in true]
    scenes = [*lit, dataclasses.replace(true[0], lights=(), ambient=0.3)]
    stack = ArrayStack(np.concatenate([images, np.full_like(images[:1], 0.1)]))
    job = make_job(scenes, stack, normals="fit", film=FREE)
    tile = jax.tree.map(jax.numpy.asarray, job.tile(job.pixels, len(job.pixels)))
    samples, _ = jax.jit(samples_of, static_argnums=2)(tile, job.outside, job.settings)
    seen = np.stack([np.asarray(s.trace().visibility)[..., 0] > 0 for s in true])
    expected = np.concatenate([seen, np.ones_like(seen[:1])])[
        [*job.outside.lighting.order]
    ]
    used = np.asarray(samples.share)[:, 0] > 0
    np.testing.assert_array_equal(used, expected.reshape(13, -1)[:, job.pixels])
    assert not expected.all()


def test_a_pinhole_sees_a_surface_moved_as_a_larger_or_smaller_one():
    rays = pf.PerspectiveCamera(8, 6, fov_y=30, position=(0, 0, 4))
    field = pf.geometry.integrate_normals(np.broadcast_to([0.0, 0, 1], (6, 8, 3)), rays)
    near = moved(field, 1.0)
    np.testing.assert_allclose(near[..., 2], 1, atol=1e-5)
    np.testing.assert_allclose(near[..., :2], 0.75 * field.positions()[..., :2])
    flat = pf.geometry.integrate_normals(
        np.broadcast_to([0.0, 0, 1], (*SIZE, 3)), CAMERA
    )
    np.testing.assert_allclose(moved(flat, 1.0), flat.positions() + [0, 0, 1])


def test_distant_lamps_tell_no_distance():
    scenes, *_ = hills(near=False)
    field = pf.geometry.integrate_normals(
        np.broadcast_to([0.0, 0, 1], (*SIZE, 3)), CAMERA
    )
    assert find_offset(pf.fit_maps, scenes, field, field.mask) == 0


@pytest.mark.parametrize("passes, normals", [(0, "fit"), (2, "given")])
def test_passes_are_of_normals_that_are_sought(passes, normals):
    scenes, images, *_ = hills(near=False)
    with pytest.raises(ValueError, match="passes: expected 1, or more"):
        pf.fit_maps(scenes, images, normals=normals, passes=passes)
