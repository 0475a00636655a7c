import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.fitting.samples import gather
from phongfit.rendering.pixels import PixelTerms, pixel_terms
from tests.fitting.scenes import SIZE, TRUTH, ball
from tests.helpers import floats, near

SHAPE = (SIZE, SIZE, 3)
SCENE = ball()


def view(scene: pf.Scene = SCENE) -> PixelTerms:
    return pixel_terms(scene, scene.trace())


def arrays(seed: int) -> list[np.ndarray]:
    """Image, weight and step, all different everywhere."""
    rng = np.random.default_rng(seed)
    return [np.array(floats(rng.random(SHAPE))) for _ in range(3)]


def test_samples_are_the_pixels_with_weight():
    image, weight, step = arrays(0)
    weight *= np.random.default_rng(1).random((SIZE, SIZE, 1)) < 0.5
    weight[3, 4] = [0, 0.5, 0]  # one channel is enough
    samples = gather([view()], [image], [weight], [step])
    used = weight.any(axis=-1)
    count = used.sum()
    assert np.array_equal(samples.target[:count], image[used])
    assert np.array_equal(samples.weight[:count], weight[used])
    assert np.array_equal(samples.step[:count], step[used])
    light = np.asarray(pf.render(SCENE, TRUTH, film=pf.Film(clamp=False)))
    seen = np.asarray(SCENE.trace().mask)[used]
    near(samples.light(TRUTH)[:count][seen], light[used][seen])


@pytest.mark.parametrize("count", [1, 255, 256, 257, 300, 513, 900, 1023])
def test_padding_has_no_weight(count):
    image, weight, step = arrays(2)
    weight.reshape(-1, 3)[count:] = 0
    samples = gather([view()], [image], [weight], [step])
    size = samples.target.shape[0]
    # Not much more than needed, and few different sizes.
    assert count <= size <= max(256, 1.25 * count + 1) and size % 64 == 0
    assert np.all(samples.weight[:count] > 0) and not np.any(samples.weight[count:])
    assert np.all(np.isfinite(samples.light(TRUTH)))


def test_sizes_are_few():
    image, weight, step = arrays(3)
    sizes = set()
    for count in range(1, SIZE * SIZE, 31):
        part = weight.copy()
        part.reshape(-1, 3)[count:] = 0
        sizes.add(gather([view()], [image], [part], [step]).target.shape[0])
    assert len(sizes) <= 10


def test_images_one_after_another():
    one_light = pf.Scene(
        SCENE.surface, SCENE.camera, SCENE.lights[:1], ambient=SCENE.ambient
    )
    (a, wa, sa), (b, wb, sb) = arrays(4), arrays(5)
    wa.reshape(-1, 3)[10:] = 0
    wb.reshape(-1, 3)[300:] = 0
    samples = gather([view(), view(one_light)], [a, b], [wa, wb], [sa, sb])
    size = samples.target.shape[0] // 2
    assert size >= 300
    assert np.array_equal(samples.target[:10], a.reshape(-1, 3)[:10])
    assert np.array_equal(samples.target[size : size + 300], b.reshape(-1, 3)[:300])
    assert np.count_nonzero(np.any(np.asarray(samples.weight) > 0, axis=-1)) == 310
    # The light that is missing in the second is dark, not absent.
    light = np.asarray(pf.render(one_light, TRUTH, film=pf.Film(clamp=False)))
    seen = np.asarray(one_light.trace().mask).ravel()[:300]
    found = np.asarray(samples.light(TRUTH))[size : size + 300]
    near(found[seen], light.reshape(-1, 3)[:300][seen])


def test_take():
    image, weight, step = arrays(6)
    samples = gather([view()], [image], [weight], [step])
    index = np.array([5, 3, 900])
    few = samples.take(index)
    assert np.array_equal(few.target, samples.target[index])
    assert np.array_equal(few.weight, samples.weight[index])
    assert np.array_equal(few.step, samples.step[index])
    near(few.light(TRUTH), samples.light(TRUTH)[jnp.asarray(index)])
