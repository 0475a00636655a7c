"""What maps leave of photographs, under lamps that no photograph was taken under."""

import dataclasses
from typing import Any

import numpy as np
import pytest

import phongfit as pf
from data_synth.lights import spread_directions
from phongfit.geometry.planes import plane_before
from phongfit.maps.relighting import NUGGET, WIDTHS, find_remainder
from phongfit.maps.stacks import as_stack
from tests.maps.hills import CAMERA, SIZE, made


def lamps(count):
    directions = np.asarray(spread_directions(count), float)
    directions[:, 2] = 0.3 + np.abs(directions[:, 2])
    return [pf.DirectionalLight(v / np.linalg.norm(v)) for v in directions]


def bounced(light, pixels=SIZE):
    """What the model has not: smooth over lamps, another for each pixel and channel."""
    y, x = np.mgrid[: pixels[0], : pixels[1]] / 10
    direction, strength = np.asarray(light.direction), np.asarray(light.intensity)
    wave = np.sin(x + 2 * direction[0]) * np.cos(y - 2 * direction[1])
    return 0.04 * (1 + wave[..., None] * [1, 0.5, -0.5]) * strength


def photographs(lights, maps=None):
    """Scenes of the hills and their photographs, of which maps know only a part."""
    maps = made() if maps is None else maps
    flat = plane_before(CAMERA)
    scenes = [pf.Scene(flat, CAMERA, light, ambient=0.2) for light in lights]
    seen = maps.relight(lights) + [bounced(light) for light in lights]
    return scenes, seen.astype(np.float32)


def off(shown, true):
    return float(np.sqrt(np.mean((shown - true) ** 2)))


def test_lamps_between_those_of_the_photographs():
    every = lamps(48)
    scenes, seen = photographs(every)
    left, kept = range(0, 48, 6), [k for k in range(48) if k % 6]
    asked = [every[k] for k in left]
    known = {"scenes": [scenes[k] for k in kept], "images": seen[kept]}
    alone, both = made().relight(asked), made().relight(asked, **known)
    assert off(both, seen[left]) < 0.4 * off(alone, seen[left])
    # A lamp of another strength, and ambient light of another: as the maps have it.
    double = [pf.DirectionalLight(light.direction, 2.0) for light in asked]
    twice = made().relight(double, ambient=0.4, **known)
    np.testing.assert_allclose(twice, 2 * both, atol=2e-3)


def test_under_its_own_lamp_a_photograph_comes_back():
    lights = [
        pf.DirectionalLight(light.direction, strength)
        for light, strength in zip(lamps(9), np.linspace(0.5, 1.5, 9), strict=True)
    ]
    # One of the lamps twice: no matrix is singular.
    scenes, seen = photographs([*lights, lights[0]])
    shown = made().relight(lights, scenes=scenes, images=seen)
    np.testing.assert_allclose(shown, seen[:9], atol=2e-3)
    flags = np.zeros(SIZE, int)
    flags[:, :5] = int(pf.Flag.OUTSIDE)
    part = dataclasses.replace(made(), flags=flags)
    (picture,) = part.relight(lights[:1], scenes=scenes, images=seen)
    assert not picture[:, :5].any() and picture[:, 5:].any()


def test_what_was_cut_off_at_white_is_not_less_than_that():
    """Maps know better than a photograph how bright a highlight is."""
    lights = lamps(9)
    scenes, seen = photographs(lights)
    bright = np.quantile(seen, 0.9)
    masked = np.ma.MaskedArray(np.minimum(seen, bright), seen >= bright)
    shown = made().relight(lights, scenes=scenes, images=masked)
    alone = made().relight(lights)
    hidden = masked.mask & (alone > bright)
    assert hidden.mean() > 0.02
    np.testing.assert_allclose(shown[hidden], alone[hidden], atol=2e-3)
    np.testing.assert_allclose(shown[~masked.mask], seen[~masked.mask], atol=2e-3)
    white = np.minimum(seen / bright, 1).astype(np.float32)
    brighter = dataclasses.replace(
        made(), diffuse=made().diffuse / bright, ambient=made().ambient / bright
    )
    brighter = dataclasses.replace(brighter, specular=made().specular / bright)
    shown = brighter.relight(lights, scenes=scenes, images=white)
    np.testing.assert_allclose(
        shown[hidden], brighter.relight(lights)[hidden], atol=5e-3
    )


def test_the_width_tells_each_photograph_best_from_the_others():
    """By leaving each out and solving anew."""
    scenes, seen = photographs(lamps(12))
    found = find_remainder(
        lambda light, ambient: np.zeros((*SIZE, 3)), scenes, as_stack(seen), np.zeros(3)
    )
    images = found.images.astype(float)
    cosine = np.clip(found.directions @ found.directions.T, -1, 1)

    def missed(width):
        common = np.exp(-np.arccos(cosine) / width) + NUGGET * np.eye(12)
        total = 0.0
        for k in range(12):
            rest = np.arange(12) != k
            weights = np.linalg.solve(common[np.ix_(rest, rest)], common[rest, k])
            total += ((np.tensordot(weights, images[rest], 1) - images[k]) ** 2).sum()
        return total

    best = min(WIDTHS, key=missed)
    # Neighbours among those that are tried are as good as alike.
    assert abs(np.log(found.width / best)) < 0.1 and WIDTHS[0] < best


def test_near_lamps_count_from_the_middle():
    far = 4000.0
    lights = [
        pf.PointLight(far * light.direction, 1.0, attenuation=(0, 0, far**-2))
        for light in lamps(9)
    ]
    scenes, seen = photographs(lamps(9))
    near = [
        dataclasses.replace(scene, lights=(light,))
        for scene, light in zip(scenes, lights, strict=True)
    ]
    asked = lamps(10)[1:3]
    a = made().relight(asked, scenes=scenes, images=seen)
    b = made().relight(asked, scenes=near, images=seen)
    np.testing.assert_allclose(a, b, atol=5e-3)


def test_what_is_wrong_is_named():
    lights = lamps(4)
    scenes, seen = photographs(lights)
    two = [dataclasses.replace(scenes[0], lights=tuple(lights[:2])), *scenes[1:]]
    room = pf.HarmonicLight(np.ones((9, 3)))
    cases: tuple[tuple[Any, dict[str, Any], str], ...] = (
        (lights, {"images": seen}, "images: expected them with their scenes"),
        (lights, {"scenes": scenes}, "images: expected them with their scenes"),
        (lights, {"scenes": scenes[1:], "images": seen}, "scenes: expected 4"),
        (lights, {"scenes": two, "images": seen}, r"scenes\[0\]: expected one light"),
        ([room], {"scenes": scenes, "images": seen}, "lights: expected a lamp"),
    )
    for asked, given, words in cases:
        with pytest.raises(ValueError, match=words):
            made().relight(asked, **given)


def test_memory_is_asked_for(monkeypatch):
    scenes, seen = photographs(lamps(4))
    monkeypatch.setenv("PHONGFIT_MAX_MEMORY", "10K")
    with pytest.raises(ValueError, match="images: expected what takes at most"):
        made().relight(lamps(1), scenes=scenes, images=seen)
