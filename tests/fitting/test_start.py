import numpy as np
import pytest

import phongfit as pf
from phongfit.fitting.samples import Samples, gather
from phongfit.fitting.start import CANDIDATES, SUBSET, choose_few, scan
from phongfit.fitting.unknowns import LEAVES, make_unknowns
from phongfit.rendering.pixels import pixel_terms
from tests.fitting.scenes import TRUTH, ball, photograph

DARK = pf.Material(0.0, 0.0, 32.0, 0.0)
DEFAULTS = (LEAVES[:-1], ("ambient", "diffuse", "specular"), DARK, {})
# A step of the grid in log f from 1 to 1000.
STEP = np.log(1000) / (CANDIDATES - 1)


def samples_of(scene: pf.Scene, image: np.ndarray) -> Samples:
    image = np.asarray(image, np.asarray(scene.ambient).dtype)
    buffer = scene.trace()
    weight = np.repeat(np.asarray(buffer.mask)[..., None], 3, axis=-1).astype(
        image.dtype
    )
    return gather(
        [pixel_terms(scene, buffer)], [image], [weight], [np.zeros_like(image)]
    )


def started(scene: pf.Scene, image: np.ndarray, layout=None) -> pf.Material:
    layout = make_unknowns(*DEFAULTS) if layout is None else layout
    y = scan(samples_of(scene, image), layout, True)
    assert np.all((layout.lower <= y) & (y <= layout.upper))
    return layout.material(y)


@pytest.mark.parametrize("shininess", [1.0, 3.0, 10.0, 40.0, 150.0, 700.0])
def test_it_starts_near_the_truth(shininess):
    truth = pf.Material(TRUTH.diffuse, TRUTH.specular, shininess, TRUTH.ambient)
    scene = ball()
    start = started(scene, photograph(scene, truth))
    assert abs(np.log(float(start.shininess) / shininess)) < STEP
    # At f = 1 the lobe is nearly a diffuse term, and takes a share of it.
    assert np.allclose(start.ambient, truth.ambient, atol=0.02)
    if shininess > 1:
        assert np.allclose(start.diffuse, truth.diffuse, atol=0.05)
        assert np.allclose(start.specular, truth.specular, atol=0.05)


def test_a_clipped_highlight():
    truth = pf.Material((0.6, 0.5, 0.4), (0.9, 0.8, 0.7), 30.0, 0.3)
    scene = pf.Scene(
        pf.Sphere(),
        ball().camera,
        (pf.DirectionalLight((1, 1, 2)), pf.DirectionalLight((-1, 0.3, 1), 0.3)),
        ambient=0.3,
    )
    image = photograph(scene, truth)
    assert 0.02 < np.mean(image >= 1) < 0.2
    start = started(scene, image)
    assert abs(np.log(float(start.shininess) / 30)) < 1.5 * STEP
    assert np.allclose(start.specular, truth.specular, atol=0.15)
    assert np.allclose(start.diffuse, truth.diffuse, atol=0.03)


def test_an_exponent_for_each_channel():
    truth = pf.Material(TRUTH.diffuse, TRUTH.specular, (5.0, 20.0, 80.0), TRUTH.ambient)
    scene = ball()
    names = LEAVES[:-1]
    start = started(
        scene, photograph(scene, truth), make_unknowns(names, names, DARK, {})
    )
    ratio = np.asarray(start.shininess) / np.asarray(truth.shininess)
    assert np.all(np.abs(np.log(ratio)) < STEP)


def test_shared_reflectances_and_a_known_exponent():
    truth = pf.Material((0.6, 0.3, 0.2), 0.3, 20.0, 0.4)
    scene = ball()
    layout = make_unknowns(("diffuse", "specular", "ambient"), ("diffuse",), truth, {})
    start = started(scene, photograph(scene, truth), layout)
    for name in LEAVES[:3]:
        assert np.allclose(getattr(start, name), getattr(truth, name), atol=1e-3)
    assert float(start.shininess) == 20


def test_known_reflectances_are_taken_off():
    scene = ball()
    layout = make_unknowns(("specular", "shininess"), ("specular",), TRUTH, {})
    start = started(scene, photograph(scene, TRUTH), layout)
    assert np.allclose(start.specular, TRUTH.specular, atol=0.03)
    assert abs(np.log(float(start.shininess) / 20)) < STEP


def test_bounds_hold_in_the_start():
    scene = ball()
    bounds = {"diffuse": (0.0, 0.25), "shininess": (30.0, 90.0), "ambient": (0.45, 1.0)}
    layout = make_unknowns(*DEFAULTS[:3], bounds)
    start = started(scene, photograph(scene, TRUTH), layout)
    assert np.asarray(start.diffuse)[0] == np.float32(0.25)
    assert 30 <= float(start.shininess) * (1 + 1e-6) <= 35
    assert np.all(np.asarray(start.ambient) >= np.float32(0.45))


def test_a_dark_image_starts_dark():
    scene = ball()
    start = started(scene, np.zeros((32, 32, 3)))
    for name in LEAVES[:3]:
        assert np.allclose(getattr(start, name), 0, atol=1e-6)


def test_few_of_many():
    scene = ball(size=128)
    samples = samples_of(scene, photograph(scene, TRUTH))
    few = choose_few(samples)
    assert few.target.shape[0] == SUBSET < np.sum(np.asarray(samples.weight)[:, 0] > 0)
    assert np.all(np.asarray(few.weight) > 0)
    # Whatever is brightest is among them, and so is the least lit part.
    terms, all_terms = few.pixels.terms, samples.pixels.terms
    assert np.max(terms.cosine) == np.max(all_terms.cosine)
    for part, whole in (
        (terms.diffuse, all_terms.diffuse),
        (few.target, samples.target),
    ):
        assert np.quantile(part, 0.05) <= np.quantile(whole, 0.1)


def test_all_of_few():
    samples = samples_of(ball(), photograph(ball(), TRUTH))
    assert choose_few(samples) is samples
