import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.fitting.problem.samples import (
    Samples,
    Source,
    gather,
    seen_pixels,
    stacked_lit,
)
from phongfit.rendering.pixels import resolve
from tests.fitting.scenes import SIZE, ball, truth
from tests.helpers import floats, near

TRUTH = truth()

SHAPE = (SIZE, SIZE, 3)
SCENE = ball()


def gathered(
    *parts: tuple[pf.Scene, list[np.ndarray]], relight: bool = False
) -> Samples:
    """Samples of scenes with their image, weight and step: all pixels with weight."""
    sources = []
    for scene, numbers in parts:
        image, weight, step = numbers
        measured = jnp.asarray(image), jnp.asarray(weight), step
        buffer, pixels = resolve(scene)
        kept = buffer if relight else None
        sources.append(Source(scene, buffer.mask, pixels, kept, *measured))
    return gather(sources, seen_pixels(sources))


@eqx.filter_jit
def light_of(channels):
    return channels.light(TRUTH)


@eqx.filter_jit
def light_anew(samples, *scenes):
    return samples.lit(scenes).light(TRUTH)


@eqx.filter_jit
def light_stacked(views, *scenes):
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)
    return stacked_lit(views, stacked).light(TRUTH)


def arrays(seed: int) -> list[np.ndarray]:
    """Image, weight and step, all different everywhere."""
    rng = np.random.default_rng(seed)
    return [np.array(floats(rng.random(SHAPE))) for _ in range(3)]


def test_samples_are_the_pixels_with_weight():
    image, weight, step = arrays(0)
    weight *= np.random.default_rng(1).random((SIZE, SIZE, 1)) < 0.5
    weight[3, 4] = [0, 0.5, 0]  # one channel is enough
    samples = gathered((SCENE, [image, weight, step]))
    used = weight.any(axis=-1)
    count = used.sum()
    assert np.array_equal(samples.target[:, :count], image[used].T)
    assert np.array_equal(samples.weight[:, :count], weight[used].T)
    assert samples.step is not None
    assert np.array_equal(samples.step[:, :count], step[used].T)
    light = np.asarray(pf.render(SCENE, TRUTH, film=pf.Film(clamp=False)))
    seen = np.asarray(SCENE.trace().mask)[used]
    near(np.asarray(light_of(samples.channels)).T[:count][seen], light[used][seen])


@pytest.mark.parametrize("count", [1, 255, 256, 257, 300, 513, 900, 1023])
def test_padding_has_no_weight(count):
    image, weight, step = arrays(2)
    weight.reshape(-1, 3)[count:] = 0
    samples = gathered((SCENE, [image, weight, step]))
    size = samples.target.shape[1]
    # Not much more than needed, and few different sizes.
    assert count <= size <= max(256, 1.25 * count + 1) and size % 64 == 0
    found = np.asarray(samples.weight)
    assert np.all(found[:, :count] > 0) and not np.any(found[:, count:])
    assert np.all(np.isfinite(light_of(samples.channels)))


def test_sizes_are_few():
    image, weight, step = arrays(3)
    sizes = set()
    for count in range(1, SIZE * SIZE, 31):
        part = weight.copy()
        part.reshape(-1, 3)[count:] = 0
        sizes.add(gathered((SCENE, [image, part, step])).target.shape[1])
    assert len(sizes) <= 10


def test_images_one_after_another():
    one_light = pf.Scene(
        SCENE.surface, SCENE.camera, SCENE.lights[:1], ambient=SCENE.ambient
    )
    (a, wa, sa), (b, wb, sb) = arrays(4), arrays(5)
    wa.reshape(-1, 3)[10:] = 0
    wb.reshape(-1, 3)[300:] = 0
    samples = gathered((SCENE, [a, wa, sa]), (one_light, [b, wb, sb]))
    size = samples.target.shape[1] // 2
    assert size >= 300
    assert np.array_equal(samples.image, np.repeat([0, 1], size))
    assert np.array_equal(samples.target[:, :10], a.reshape(-1, 3)[:10].T)
    assert np.array_equal(
        samples.target[:, size : size + 300], b.reshape(-1, 3)[:300].T
    )
    assert np.count_nonzero(np.any(np.asarray(samples.weight) > 0, axis=0)) == 310
    # The light that is missing in the second is dark, not absent.
    light = np.asarray(pf.render(one_light, TRUTH, film=pf.Film(clamp=False)))
    seen = np.asarray(one_light.trace().mask).ravel()[:300]
    found = np.asarray(light_of(samples.channels)).T[size : size + 300]
    near(found[seen], light.reshape(-1, 3)[:300][seen])


def every_light(*scenes: pf.Scene) -> Samples:
    return gathered(
        *[(scene, arrays(k)) for k, scene in enumerate(scenes)], relight=True
    )


def other_light(scene: pf.Scene) -> pf.Scene:
    """The same scene, lit from elsewhere, in thicker air."""
    lights = (
        pf.DirectionalLight((0, 1, 1), 0.4),
        pf.PointLight((1, 2, 3), (0.3, 0.2, 0.4)),
    )
    fog = None if scene.fog is None else pf.Fog((0.1, 0.2, 0.3), density=0.7)
    return pf.Scene(
        scene.surface,
        scene.camera,
        lights,
        ambient=0.7,
        specular_model=scene.specular_model,
        shading=scene.shading,
        fog=fog,
    )


BALL = pf.shapes.Ball().mesh(12, 8)


FOG = pf.Fog(0.5, density=0.1)


@pytest.mark.parametrize(
    "surface, shading, fog",
    [
        (pf.Sphere(), None, None),
        (BALL, pf.GouraudShading(), FOG),
        pytest.param(pf.Sphere(), None, FOG, marks=pytest.mark.extended),
        pytest.param(BALL, pf.PhongShading(), None, marks=pytest.mark.extended),
        pytest.param(BALL, pf.PhongShading(), FOG, marks=pytest.mark.extended),
        pytest.param(BALL, pf.GouraudShading(), None, marks=pytest.mark.extended),
    ],
)
def test_relighting_is_lighting_anew(surface, shading, fog):
    scene = pf.Scene(
        surface,
        pf.PerspectiveCamera(SIZE, SIZE, position=(0, 0, 4)),
        (SCENE.lights[0], pf.PointLight((2, 0, 2))),
        ambient=0.2,
        shading=shading,
        fog=fog,
    )
    other = other_light(scene)
    found = light_anew(every_light(scene), other)
    near(found, light_of(every_light(other).channels), 1e-5)


POINT = pf.Scene(
    SCENE.surface, SCENE.camera, pf.PointLight((2, 1, 3)), ambient=SCENE.ambient
)


@pytest.mark.parametrize(
    "scenes",
    [
        (SCENE, POINT),
        (SCENE, SCENE),
        pytest.param((SCENE, other_light(SCENE)), marks=pytest.mark.extended),
    ],
    ids=["of two kinds", "of one kind", "of two kinds of light"],
)
def test_images_of_one_kind_are_relit_together(scenes):
    samples = every_light(*scenes)
    brighter = tuple(
        eqx.tree_at(lambda s: s.lights[0].intensity, scene, replace_fn=lambda i: 2 * i)
        for scene in scenes
    )
    expected = light_of(every_light(*brighter).channels)
    near(light_anew(samples, *brighter), expected, 1e-5)
    views = samples.stacked_views()
    assert (views is not None) == (scenes[0] is scenes[-1])
    if views is not None:
        near(light_stacked(views, *brighter), expected, 1e-5)
