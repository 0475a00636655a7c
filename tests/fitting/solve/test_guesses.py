"""Lights that an image shows before any fit, and fits that start from them."""

from typing import Any

import numpy as np
import pytest

import phongfit as pf
from phongfit.fitting.problem.posing import set_up
from phongfit.fitting.problem.samples import seen_pixels
from phongfit.fitting.problem.specification import Specification
from phongfit.fitting.solve.guesses import guess_places, look, moves_lights
from phongfit.fitting.solve.start import choose_few
from tests.fitting.scenes import PARAMETERS, photograph

DIRECTION, POSITION = "scene.lights[0].direction", "scene.lights[0].position"
GLOSS = pf.Material((0.4, 0.3, 0.2), 0.06, 400.0, 0.1)
STATED = np.array([0.0, 0.0, 1.0])
# Narrow highlights that were missed: f = 1 came out, without a warning.
MISSED = [(-0.035, 0.467, 0.884), (-0.6, -0.2, 0.75)]


def scene(*lights: pf.AbstractLight, size: int = 32, **changes: Any) -> pf.Scene:
    camera = pf.OrthographicCamera(size, size)
    return pf.Scene(pf.Sphere(), camera, lights, 0.3, **changes)


def lit_from(way, **changes: Any) -> pf.Scene:
    return scene(pf.DirectionalLight(way, 0.6), **changes)


def looked(stated, image, *names, **options):
    """What the image shows of its lights, and where those may be."""
    setting = set_up(Specification(unknowns=names, **options), stated, image)
    assert moves_lights(setting.unknowns)
    seen = seen_pixels(setting.sources)
    looks = [look(*one) for one in zip(setting.sources, seen, strict=True)]
    return setting, looks, guess_places(setting.unknowns, looks, setting.sources)


def degrees(one, other) -> float:
    one, other = (np.asarray(a, float) / np.linalg.norm(a) for a in (one, other))
    return float(np.degrees(np.arccos(np.clip(one @ other, -1, 1))))


@pytest.mark.parametrize(
    "model, shininess", [(pf.BlinnPhong(), 400.0), (pf.Phong(), 100.0)]
)
@pytest.mark.parametrize("way", [(0.5, 0.2, 0.8), *MISSED])
def test_a_highlight_and_the_shading_show_the_light(way, model, shininess):
    given: dict[str, Any] = dict(size=64, specular_model=model)
    material = pf.Material(GLOSS.diffuse, GLOSS.specular, shininess, GLOSS.ambient)
    image = photograph(lit_from(way, **given), material, noise=0.005)
    setting, (shown,), places = looked(lit_from(STATED, **given), image, DIRECTION)
    (entry,) = places
    assert entry == setting.unknowns.direction_entries[0]
    spot, *_, shading = places[entry]
    assert degrees(spot, way) < 2
    assert degrees(shading, way) < 10
    # The samples that a search begins with show the highlight, wherever it lies.
    (few,) = choose_few(
        setting.sources, seen_pixels(setting.sources), bright=[shown.excess]
    ) or ([],)
    assert np.argmax(shown.excess) in few


def test_a_bulb_lies_as_far_away_as_stated():
    way = np.array([0.5, 0.2, 0.8])
    image = photograph(scene(pf.PointLight(3 * way, 0.6)), GLOSS, noise=0.005)
    stated = scene(pf.PointLight(3 * STATED, 0.6))
    _, (shown,), places = looked(stated, image, POSITION)
    for place, point in zip(*places.values(), shown.points, strict=True):
        off = np.linalg.norm(place - point), np.linalg.norm(3 * STATED - point)
        assert np.isclose(*off)
    assert degrees(places[0][0] - shown.points[0], 3 * way - shown.points[0]) < 4


def test_several_lights_begin_with_different_guesses():
    ways = (0.6, 0.0, 0.8), (-0.6, 0.3, 0.7)
    lights = [pf.DirectionalLight(way, 0.3) for way in ways]
    names = [f"scene.lights[{k}].direction" for k in range(2)]
    image = photograph(scene(*lights), pf.Material(0.3, 0.5, 200.0, 0.1), noise=0.005)
    stated = scene(*[pf.DirectionalLight(STATED, 0.3)] * 2)
    _, _, places = looked(stated, image, *names)
    off = np.array(
        [[degrees(guesses[0], way) for way in ways] for guesses in places.values()]
    )
    assert (off.min(axis=0) < 4).all() and (off.min(axis=1) < 4).all()


@pytest.mark.extended
@pytest.mark.parametrize("way, seed", [*zip(MISSED, (7, 1), strict=True)])
def test_a_narrow_highlight_under_an_unknown_light(way, seed):
    free = pf.Film(clamp=False)
    image = photograph(lit_from(way), GLOSS, noise=0.005, film=free, seed=seed)
    fit = pf.fit(lit_from(STATED), image, unknowns=(*PARAMETERS, DIRECTION))
    assert fit.converged and not fit.warnings, fit
    assert degrees(fit[DIRECTION].value, way) < 1
    found = fit["shininess"]
    assert abs(np.log(found.value / 400)) < 4 * found.error / found.value
    assert fit.noise < 1.03 * 0.005


@pytest.mark.extended
def test_two_lights_that_explain_an_image_are_a_warning():
    """A surface curved one way alone: a light and its mirror image look the same."""
    slope = np.linspace(-1, 1, 32)
    normals = np.stack([np.sin(slope), 0 * slope, np.cos(slope)], axis=-1)
    surface = pf.NormalMap(np.broadcast_to(normals, (32, 32, 3)))
    matte, camera = pf.Material(0.6, 0.0, 1.0, 0.1), pf.OrthographicCamera(32, 32)
    true, stated = (
        pf.Scene(surface, camera, pf.DirectionalLight(way, 0.6), 0.3)
        for way in ((0.3, 0.6, 0.8), STATED)
    )
    image = photograph(true, matte, noise=0.005)
    fit = pf.fit(stated, image, unknowns=("ambient", DIRECTION), known=matte)
    (warning,) = fit.warnings
    assert pf.warning_code(warning) == "two-solutions" and f"{DIRECTION}.y" in warning
