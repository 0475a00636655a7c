"""Responses that are known, found again: from a matte sphere, and from brackets."""

import numpy as np
import pytest

import phongfit as pf
from phongfit.rendering.film import decode, encode
from tests.calibration.studio import directions

NUMBERS = np.linspace(0, 1, 257)
CURVES = {
    "linear": "linear",
    "srgb": "srgb",
    "gamma": pf.ResponseCurve(NUMBERS**1.8),
    # Steepest in the middle, as film is.
    "s": pf.ResponseCurve(0.35 * NUMBERS + 0.65 * (3 * NUMBERS**2 - 2 * NUMBERS**3)),
}
NOISE = 0.004
EXPOSURES = (1.0, 2.0, 4.0, 8.0)
LAMPS = directions(5)


def extended(*names):
    """Curves that are left out of the usual run."""
    return [pytest.param(name, marks=pytest.mark.extended) for name in names]


def stored(light, curve, seed):
    """Numbers of eight bits, of light that the curve's camera saw."""
    noise = NOISE * np.random.default_rng(seed).normal(size=light.shape)
    numbers = np.asarray(encode(np.clip(light, 0, 1), curve)) + noise
    return np.round(np.clip(numbers, 0, 1) * 255) / 255


@pytest.fixture(scope="module")
def ball():
    """A matte ball in a room with a little light, one lamp a photograph."""
    camera = pf.OrthographicCamera(80, 60, view_height=2.4)
    scenes = [
        pf.Scene(pf.Sphere(), camera, pf.DirectionalLight(lamp)) for lamp in LAMPS
    ]
    matte = pf.Material((0.9, 0.8, 0.7), 0.0, 1.0, 0.0)
    film = pf.Film(clamp=False)
    light = [np.asarray(pf.render(s, matte, film=film), float) for s in scenes]
    strengths = (0.9, 0.7, 0.5, 0.8, 1.1)
    return scenes, [k * one + 0.02 for k, one in zip(strengths, light, strict=True)]


def patches():
    light = np.random.default_rng(0).gamma(1.5, 0.04, size=(12, 16, 3))
    return np.kron(light, np.ones((5, 5, 1)))


def check(found, name):
    curve = CURVES[name]
    low, high = found.seen
    seen = (low <= NUMBERS) & (high >= NUMBERS)
    assert seen.sum() > 120
    truth = np.asarray(decode(NUMBERS, curve))[seen]
    light, error = np.array(found.curve.light)[seen], found.error[seen]
    # Light has no unit of its own: brightness is taken as in the truth.
    scale = light @ truth / (light @ light)
    assert np.abs(scale * light - truth).max() < 0.004
    assert error.max() < 0.01
    for one, verdict in found.checks.items():
        assert verdict.fits == (one == name), (one, verdict)
        assert verdict.off < 0.004 if one == name else verdict.off > 0.03
    assert found.encoding == (curve if isinstance(curve, str) else found.curve)
    assert not found.warnings


@pytest.mark.parametrize("name", ["s", *extended("linear", "srgb", "gamma")])
def test_from_a_matte_sphere_under_known_lamps(ball, name):
    scenes, light = ball
    images = [stored(one, CURVES[name], k) for k, one in enumerate(light)]
    check(pf.fit_response(images, scenes=scenes), name)


@pytest.mark.parametrize("name", ["linear", *extended("srgb", "gamma", "s")])
def test_from_a_bracket(name):
    images = [stored(e * patches(), CURVES[name], int(e)) for e in EXPOSURES]
    # Something moved: not a reason to believe in another curve.
    images[1][10:14, 20:24] = 0.5
    check(pf.fit_response(images, exposures=EXPOSURES), name)


@pytest.mark.extended
@pytest.mark.parametrize("shown", ["bracket", "ball", "ball in a dark room"])
def test_errors_hold(ball, shown):
    """Of ten sets of photographs, curves lie within their stated errors."""
    scenes, light = ball
    room = 0.02 if shown == "ball in a dark room" else 0.0
    pulls = []
    for seed in range(10):
        seeds = (100 * seed + k for k in range(100))
        if shown == "bracket":
            images = [stored(e * patches(), "srgb", next(seeds)) for e in EXPOSURES]
            found = pf.fit_response(images, exposures=EXPOSURES)
        else:
            images = [stored(one - room, "srgb", next(seeds)) for one in light]
            found = pf.fit_response(images, scenes=scenes)
        truth = np.asarray(decode(NUMBERS, "srgb"))
        high = found.seen[1]
        one, other = (
            curve / np.interp(high, NUMBERS, curve)
            for curve in (np.array(found.curve.light), truth)
        )
        seen = [64, 96, 128, 160, 192]
        pulls.append((one - other)[seen] / found.error[seen])
    # In a room with light, what lies below the darkest shadow is not seen.
    least = 0.1 if shown == "ball" else 0.6
    assert least < np.sqrt(np.mean(np.square(pulls))) < 1.4


def test_what_is_not_seen_is_said():
    images = [stored(0.3 * e * patches() + 0.1, "linear", int(e)) for e in (1.0, 1.5)]
    found = pf.fit_response(list(np.clip(images, 0, 0.5)), exposures=(1.0, 1.5))
    assert "range-unseen" in map(pf.warning_code, found.warnings)
    assert "(not seen)" in str(found)


@pytest.mark.parametrize(
    "given, words",
    [
        ({}, "scenes: expected it or exposures, got neither"),
        ({"exposures": (1.0,)}, "exposures: expected 2, one a photograph, got 1"),
        ({"exposures": (1.0, 1.0)}, "exposures: expected several that differ"),
        ({"exposures": (1.0, -1.0)}, "exposures: expected numbers > 0"),
        ({"exposures": (1.0, 2.0), "mask": np.ones((3, 3), bool)}, "mask: expected"),
    ],
)
def test_wrong_arguments(given, words):
    images = [stored(e * patches(), "srgb", 0) for e in (1.0, 2.0)]
    with pytest.raises(ValueError) as caught:
        pf.fit_response(images, **given)
    assert str(caught.value).startswith(words)


def test_black_photographs_tell_nothing():
    with pytest.raises(ValueError, match="too few pixels"):
        pf.fit_response([np.zeros((9, 9, 3))] * 2, exposures=(1.0, 2.0))
