import jax.numpy as jnp
import numpy as np

import phongfit as pf
from phongfit.fitting.problem.parameters import MATERIAL_PARAMETERS
from phongfit.fitting.problem.problem import Problem
from phongfit.fitting.problem.samples import Source, gather, seen_pixels
from phongfit.fitting.solve.start import CANDIDATES, SUBSET, choose_few, scan
from phongfit.rendering.pixels import resolve_terms
from tests.fitting.scenes import ball, photograph, truth, unknowns_of

TRUTH = truth()

DARK = pf.Material(0.0, 0.0, 32.0, 0.0)
DEFAULTS = (MATERIAL_PARAMETERS[:-1], ("ambient", "diffuse", "specular"), DARK, {})
# A step of the grid in log f from 1 to 1000.
STEP = np.log(1000) / (CANDIDATES - 1)


def source_of(scene: pf.Scene, image: np.ndarray) -> Source:
    image = np.asarray(image, np.asarray(scene.ambient).dtype)
    mask, pixels = resolve_terms(scene)
    weight = np.repeat(np.asarray(mask)[..., None], 3, axis=-1)
    weight = weight.astype(image.dtype)
    measured = jnp.asarray(image), jnp.asarray(weight), None
    return Source(scene, mask, pixels, None, *measured)


def started(scene: pf.Scene, image: np.ndarray, layout=None) -> pf.Material:
    layout = unknowns_of(*DEFAULTS) if layout is None else layout
    source = source_of(scene, image)
    samples = gather([source], seen_pixels([source]))
    sigma = jnp.asarray(1e-6, samples.target.dtype)
    y = scan(Problem(samples, layout, sigma, pf.Linear(), True), layout.start)
    assert np.all((layout.lower <= y) & (y <= layout.upper))
    return layout.material(y)


def test_it_starts_near_the_truth():
    scene = ball()
    for shininess in (1.0, 3.0, 10.0, 40.0, 150.0, 700.0):
        truth = pf.Material(TRUTH.diffuse, TRUTH.specular, shininess, TRUTH.ambient)
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
    names = MATERIAL_PARAMETERS[:-1]
    start = started(
        scene, photograph(scene, truth), unknowns_of(names, names, DARK, {})
    )
    ratio = np.asarray(start.shininess) / np.asarray(truth.shininess)
    assert np.all(np.abs(np.log(ratio)) < STEP)


def test_shared_reflectances_and_a_known_exponent():
    truth = pf.Material((0.6, 0.3, 0.2), 0.3, 20.0, 0.4)
    scene = ball()
    layout = unknowns_of(("diffuse", "specular", "ambient"), ("diffuse",), truth, {})
    start = started(scene, photograph(scene, truth), layout)
    for name in MATERIAL_PARAMETERS[:3]:
        assert np.allclose(getattr(start, name), getattr(truth, name), atol=1e-3)
    assert float(start.shininess) == 20


def test_known_reflectances_are_taken_off():
    scene = ball()
    layout = unknowns_of(("specular", "shininess"), ("specular",), TRUTH, {})
    start = started(scene, photograph(scene, TRUTH), layout)
    assert np.allclose(start.specular, TRUTH.specular, atol=0.03)
    assert abs(np.log(float(start.shininess) / 20)) < STEP


def test_bounds_hold_in_the_start():
    scene = ball()
    bounds = {"diffuse": (0.0, 0.25), "shininess": (30.0, 90.0), "ambient": (0.45, 1.0)}
    layout = unknowns_of(*DEFAULTS[:3], bounds)
    start = started(scene, photograph(scene, TRUTH), layout)
    assert np.asarray(start.diffuse)[0] == np.float32(0.25)
    assert 30 <= float(start.shininess) * (1 + 1e-6) <= 35
    assert np.all(np.asarray(start.ambient) >= np.float32(0.45))


def test_a_dark_image_starts_dark():
    scene = ball()
    start = started(scene, np.zeros((32, 32, 3)))
    for name in MATERIAL_PARAMETERS[:3]:
        assert np.allclose(getattr(start, name), 0, atol=1e-6)


def test_few_of_many():
    scene = ball(size=64)
    source = source_of(scene, photograph(scene, TRUTH))
    seen = seen_pixels([source])
    few = choose_few([source], seen)
    assert few is not None
    (chosen,), (all_seen,) = few, seen
    assert len(chosen) == SUBSET < len(all_seen) and np.isin(chosen, all_seen).all()
    # Whatever is brightest is among them, and so is the least lit part.
    cosine = np.asarray(source.pixels.terms.cosine).reshape(-1, 2)
    assert np.max(cosine[chosen]) == np.max(cosine[all_seen])
    diffuse = np.asarray(source.pixels.terms.diffuse).reshape(-1, 3)
    for numbers in (diffuse, source.image.reshape(-1, 3)):
        part, whole = numbers[chosen], numbers[all_seen]
        assert np.quantile(part, 0.04) <= np.quantile(whole, 0.1)


def test_every_image_gives_its_share():
    scene = ball(size=64)
    sources = [source_of(scene, photograph(scene, TRUTH))] * 4
    few = choose_few(sources, seen_pixels(sources))
    assert few is not None and [len(index) for index in few] == [SUBSET // 4] * 4


def test_all_of_few():
    source = source_of(ball(), photograph(ball(), TRUTH))
    assert choose_few([source], seen_pixels([source])) is None
