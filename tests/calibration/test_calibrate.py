"""Lamps found by spheres, against captures of known truth."""

import numpy as np
import pytest
from scipy.special import ndtr

import phongfit as pf
from phongfit.calibration.lamps import solve_lamps
from phongfit.calibration.matte import _unclipped
from phongfit.calibration.spheres import find_ball
from tests.calibration.studio import Ball, Studio, degrees, directions

LAMPS = directions(6)
STRENGTHS = 0.8 + 0.4 * ((np.arange(6) * 0.37) % 1)
FEW = 4
"""Photographs, where not all are needed."""


@pytest.fixture(scope="module")
def distant():
    studio = Studio()
    images = [
        studio.photograph(lamp, strength, seed=number)
        for number, (lamp, strength) in enumerate(zip(LAMPS, STRENGTHS, strict=True))
    ]
    return studio, images


@pytest.fixture(scope="module")
def found(distant):
    """Of distant lamps, by all spheres."""
    return calibrated(*distant)


def calibrated(studio, images, **options):
    options = {
        "chrome": studio.circles("chrome"),
        "matte": studio.circles("matte")[0],
        "sphere_radius": 0.5,
        "fov": studio.fov,
    } | options
    return pf.calibrate(options.pop("photographs", images), **options)


def test_distant_lamps_are_where_they_are(found):
    apart = degrees([lamp.direction for lamp in found.lamps], LAMPS)
    stated = np.array([lamp.direction_error for lamp in found.lamps])
    assert apart.max() < 0.5
    assert np.median(apart) < 0.25
    assert np.sqrt(np.mean((apart / stated) ** 2)) < 2
    assert found.warnings == ()
    assert found.left_out == {}
    # What is wrong with a sphere is wrong for all lamps.
    joint = found.covariance
    assert joint is not None and joint.shape == (37, 37)
    # Of directions, strengths and the fall-off, which distant lamps have none of.
    joint = joint[:18, :18]
    assert joint[3:6, 3:6] == pytest.approx(found.lamps[1].covariance)
    root = np.sqrt(np.diag(joint))
    assert np.abs(joint / np.outer(root, root))[:3, 3:].max() > 0.3


def test_strengths_and_their_colour(found):
    intensity = np.array([lamp.intensity for lamp in found.lamps])
    truth = STRENGTHS[:, None] * [1, 0.9, 0.8]
    ratio = intensity / truth
    assert np.abs(ratio / ratio.mean() - 1).max() < 0.015
    assert intensity.mean() == pytest.approx(1)


@pytest.mark.parametrize(
    "gain",
    [
        pytest.param(2, marks=pytest.mark.extended),
        4,
        pytest.param(8, marks=pytest.mark.extended),
    ],
)
def test_what_is_white(distant, gain):
    """Highlights are round still; of the matte sphere only what is not white counts."""
    studio, images = distant
    white = [np.minimum(gain * image, 1) for image in images]
    assert np.mean([(image == 1).any(axis=-1).mean() for image in white]) > 0.01
    found = calibrated(studio, white)
    apart = degrees([lamp.direction for lamp in found.lamps], LAMPS)
    stated = [lamp.direction_error for lamp in found.lamps]
    assert np.sqrt(np.mean((apart / stated) ** 2)) < 3
    assert apart.max() < 0.5 if gain < 8 else apart.max() < 3
    ratio = np.array([lamp.intensity.mean() for lamp in found.lamps]) / STRENGTHS
    known = np.isfinite(ratio)
    assert known.all() == (gain < 8)
    limit = 0.015 if gain < 8 else 0.05
    assert np.abs(ratio / ratio[known].mean() - 1)[known].max() < limit


def test_a_matte_sphere_that_is_white_says_nothing_of_its_lamp(distant):
    """Of a lamp that shades it from bright to white no direction is made up."""
    studio, images = distant
    with pytest.raises(ValueError, match="expose less"):
        calibrated(studio, [np.minimum(8 * i, 1) for i in images], chrome=None)
    # Two of them six times as bright as the others: the first is white, and left out.
    white = [np.minimum((6 if n < 2 else 1) * i, 1) for n, i in enumerate(images)]
    found = calibrated(studio, white, chrome=None)
    assert found.left_out["photograph 1"].endswith("the matte one is overexposed")
    apart = degrees(
        [lamp.direction for lamp in found.lamps], LAMPS[-len(found.lamps) :]
    )
    assert (apart < 3 * np.array([x.direction_error for x in found.lamps])).all()
    # Chrome spheres show where its lamp is, but not how strong.
    found = calibrated(studio, [np.minimum(8 * images[0], 1), *images[1:]])
    assert degrees(found.lamps[0].direction, LAMPS[0]) < 1
    assert np.isnan(found.lamps[0].intensity).any()
    (warning,) = found.warnings
    assert warning.startswith("photograph 1: the matte sphere is overexposed")
    assert pf.warning_code(warning) == "strength-unknown"


def test_light_of_the_room_is_told_from_the_lamps():
    """What is left once the room's light is taken off is below white: and was white."""
    studio = Studio()
    images = [
        np.minimum(2 * studio.photograph(lamp, ambient=0.05, seed=n), 1)
        for n, lamp in enumerate(LAMPS[:FEW])
    ]
    found = calibrated(studio, images)
    intensity = np.array([lamp.intensity for lamp in found.lamps])
    ratio = intensity.mean(axis=0)
    assert found.ambient / ratio == pytest.approx(0.05 / 0.6, rel=0.1)
    strength = intensity.mean(axis=1)
    assert np.abs(strength / strength.mean() - 1).max() < 0.02


def test_spheres_are_found_where_nobody_says_where(distant):
    studio, images = distant
    found = pf.calibrate(images[:FEW], fov=studio.fov, sphere_radius=0.5)
    for kind in ("chrome", "matte"):
        seen = sorted(tuple(s.outline) for s in found.spheres if s.kind == kind)
        assert len(seen) == len(studio.circles(kind))
        for outline, circle in zip(seen, sorted(studio.circles(kind)), strict=True):
            assert np.abs(np.subtract(outline, circle)).max() < 1


def test_chrome_alone_and_matte_alone_agree(distant):
    studio, images = distant
    chrome = calibrated(studio, images, matte=None)
    matte = calibrated(studio, images, chrome=None)
    apart = degrees(
        [lamp.direction for lamp in chrome.lamps],
        [lamp.direction for lamp in matte.lamps],
    )
    assert apart.mean() < 0.7
    assert np.isnan([lamp.intensity for lamp in chrome.lamps]).all()
    assert any("no matte sphere" in warning for warning in chrome.warnings)
    assert all(map(pf.warning_code, chrome.warnings))


def test_near_lamps_have_a_place():
    studio = Studio()
    places = np.array([0, 0, -10.0]) + 6 * LAMPS[:5]
    images = [studio.photograph(p, near=True, seed=n) for n, p in enumerate(places)]
    found = calibrated(studio, images, lamps="near")
    positions = np.array([lamp.position for lamp in found.lamps])
    apart = np.linalg.norm(positions - places, axis=1)
    assert apart.max() < 0.02 * 10
    squares = [
        (p - q) @ np.linalg.solve(lamp.covariance, p - q) / 3
        for p, q, lamp in zip(positions, places, found.lamps, strict=True)
    ]
    assert np.sqrt(np.mean(squares)) < 2
    assert found.falloff == pytest.approx(1, abs=0.15)
    intensity = np.array([lamp.intensity.mean() for lamp in found.lamps])
    assert np.abs(intensity / intensity.mean() - 1).max() < 0.03
    assert isinstance(found.lights[0], pf.PointLight)


@pytest.mark.parametrize("every", [False, True])
def test_lamps_that_are_not_near(distant, monkeypatch, every):
    """Rays that do not meet: of the first lamp, which is left out, or of all."""
    studio, images = distant
    rounds = []

    def solve(candidates, chosen, *others):
        found = solve_lamps(candidates, chosen, *others)
        distances = np.full(len(chosen), 0.1)
        if not rounds:
            distances[: None if every else 1] = -0.1
        rounds.append(chosen)
        return found._replace(inverse_distances=distances)

    monkeypatch.setattr("phongfit.calibration.calibrate.solve_lamps", solve)
    options = {"matte": None, "lamps": "near"}
    if every:
        with pytest.raises(ValueError, match="lamps: expected near ones, got rays"):
            calibrated(studio, images[:FEW], **options)
        return
    found = calibrated(studio, images[:FEW], **options)
    whys = [why for why in found.left_out.values() if "not near" in why]
    assert len(whys) == 1 and len(rounds[1]) == len(rounds[0]) - 1


def test_parallel_rays():
    studio = Studio(fov=None)
    images = [studio.photograph(lamp, seed=n) for n, lamp in enumerate(LAMPS[:FEW])]
    found = calibrated(studio, images)
    apart = degrees([lamp.direction for lamp in found.lamps], LAMPS[:FEW])
    assert apart.max() < 0.5
    assert isinstance(found.camera, pf.OrthographicCamera)
    assert found.camera.view_height == pytest.approx(3.6, rel=0.01)


def test_another_bright_thing_is_no_lamp(distant):
    studio, images = distant
    images = [image.copy() for image in images]
    x, y, radius = studio.circles("chrome")[0]
    rows, columns = np.mgrid[: studio.height, : studio.width] + 0.5
    window = np.hypot(columns - x - 0.3 * radius, rows - y - 0.3 * radius) < radius / 3
    images[3][window] = 1.0
    found = calibrated(studio, images)
    apart = degrees([lamp.direction for lamp in found.lamps], LAMPS)
    assert apart.max() < 0.5


def doubled(images, *numbers):
    """The same with a second lamp in some, which leaves the wall as it is."""
    return [
        np.maximum(image, images[(number + 3) % len(images)])
        if number in numbers
        else image
        for number, image in enumerate(images)
    ]


def test_two_lamps_in_one_photograph_are_named(distant):
    studio, images = distant
    found = calibrated(studio, doubled(images, 2)[:FEW])
    assert found.left_out == {"photograph 3": "it shows two lamps"}
    kept = np.delete(LAMPS[:FEW], 2, 0)
    apart = degrees([lamp.direction for lamp in found.lamps], kept)
    assert apart.max() < 0.5


def test_one_sphere_alone_warns_of_two_lamps(distant):
    studio, images = distant
    one = {"chrome": studio.circles("chrome")[1:], "matte": None}
    found = calibrated(studio, doubled(images, 2), **one)
    (said,) = (warning for warning in found.warnings if "two lamps" in warning)
    assert said.startswith("photograph 3: the sphere shows two highlights")
    assert not any("two" in w for w in calibrated(studio, images, **one).warnings)


def test_two_lamps_everywhere(distant, monkeypatch):
    studio, images = distant
    monkeypatch.setattr(
        "phongfit.calibration.calibrate.show_two_lamps",
        lambda candidates, chosen, lamps: np.ones(len(chosen), bool),
    )
    with pytest.raises(ValueError, match="expected one lamp in each, got two in phot"):
        calibrated(studio, images)


def test_a_photograph_without_a_lamp_is_left_out_by_name(distant):
    studio, images = distant
    images = [*images[:FEW], np.full_like(images[0], 0.001)]
    names = [f"{number}.jpg" for number in range(FEW + 1)]
    found = calibrated(studio, images, names=names)
    assert list(found.left_out) == [names[FEW]]
    assert any(f"{names[FEW]} is left out" in warning for warning in found.warnings)
    assert [lamp.photograph for lamp in found.lamps] == names[:FEW]


def test_a_wrong_camera_is_minded(distant):
    studio, images = distant
    found = calibrated(studio, images, fov=None, matte=None)
    assert any("angle of view" in warning for warning in found.warnings)


@pytest.mark.parametrize(
    "options, message",
    [
        (
            {"chrome": [(5, 90, 20)]},
            "chrome\\[0\\]: expected a sphere that lies wholly",
        ),
        ({"chrome": [(60, 90)]}, "chrome\\[0\\]: expected x, y and radius"),
        ({"chrome": [(60, 90, "x")]}, "chrome: expected a list, each entry a list"),
        ({"chrome": [(60, 90, 3)]}, "chrome\\[0\\]: expected a radius of at least 5"),
        ({"photographs": 5}, "photographs: expected a list of images, got 5"),
        ({"fov": 200}, "fov: expected a number > 0 and < 180, got 200"),
        ({"sphere_radius": -1}, "sphere_radius: expected a number > 0"),
        ({"lamps": "far"}, "lamps: expected 'distant' or 'near', got 'far'"),
        ({"names": ["a"]}, "names: expected 6, one a photograph, got 1"),
        (
            {"lamps": "near", "matte": None, "chrome": [(64, 99, 25)]},
            "lamps: expected two spheres",
        ),
    ],
)
def test_what_cannot_be_is_said_by_its_name(distant, options, message):
    studio, images = distant
    with pytest.raises(ValueError, match=message):
        calibrated(studio, images, **options)


def test_one_photograph_of_a_ball_with_a_dark_side():
    """Half of its outline is as dark as the background."""
    height, width, (x, y, radius) = 90, 120, (50.0, 44.0, 30.0)
    rows, columns = np.mgrid[:height, :width] + 0.5
    right, up = (columns - x) / radius, (y - rows) / radius
    inside = np.hypot(right, up) < 1
    front = np.sqrt(np.maximum(1 - right**2 - up**2, 0))
    lit = np.maximum(0.8 * right + 0.3 * up + 0.5 * front, 0)
    light = np.repeat(np.where(inside, 0.5 * lit, 0)[..., None], 3, axis=-1)
    noise = np.random.default_rng(1).normal(0, 0.003, light.shape)
    found = find_ball([light + noise], ["ball.png"])
    assert found is not None
    np.testing.assert_allclose(found, (x, y, radius), atol=1.0)
    assert find_ball([0.3 + noise], ["empty.png"]) is None


def test_a_circle_beside_its_sphere_is_moved(distant):
    studio, images = distant
    right = studio.circles("chrome")[0]
    wrong = np.asarray(right) + (5, -3, 0)
    found = calibrated(studio, images, chrome=[wrong], matte=None)
    (sphere,) = found.spheres
    np.testing.assert_allclose(sphere.outline, right, atol=1)
    assert "outline-moved" in map(pf.warning_code, found.warnings)


def test_a_circle_around_nothing_has_the_error_of_the_eye():
    """A lamp's mirror image before black, without an outline."""
    random = np.random.default_rng(0)
    images = [random.normal(0.02, 0.003, (120, 160, 3)) for _ in range(4)]
    for number, image in enumerate(images):
        image[50 + 4 * number : 53 + 4 * number, 70:73] = 1
    found = pf.calibrate(images, chrome=[(80, 60, 30)])
    assert "outline-unseen" in map(pf.warning_code, found.warnings)
    (sphere,) = found.spheres
    np.testing.assert_array_equal(sphere.covariance, np.eye(3))
    # A pixel turns a mirror image by 2 / 30.
    assert min(lamp.direction_error for lamp in found.lamps) > 1.5


def test_no_sphere_in_view():
    random = np.random.default_rng(0)
    images = [random.uniform(0.2, 0.3, (60, 80, 3)) for _ in range(4)]
    with pytest.raises(ValueError, match="chrome: no sphere is seen"):
        pf.calibrate(images)


def test_photographs_of_unequal_size_are_named(distant):
    studio, images = distant
    images = [*images[:3], images[3][:-10]]
    with pytest.raises(ValueError, match="photograph 4: expected 240 × 180 pixels"):
        calibrated(studio, images)


def test_a_sphere_that_the_stand_hides_is_taken_as_given():
    studio = Studio(balls=(Ball("chrome", (0, 0, -10.0), 0.8),))
    images = [studio.photograph(lamp, seed=n) for n, lamp in enumerate(LAMPS[:FEW])]
    for image in images:
        image[90:] = 0.0  # cloth
    circle = studio.circles("chrome")[0]
    found = pf.calibrate(images, chrome=[circle], fov=studio.fov)
    assert tuple(found.spheres[0].outline) == pytest.approx(circle)
    assert any("circle is used as given" in warning for warning in found.warnings)
    # Unless the half that is seen contradicts it.
    wrong = tuple((np.asarray(circle) + (0, 5, 0)).tolist())
    found = pf.calibrate(images, chrome=[wrong], fov=studio.fov)
    np.testing.assert_allclose(found.spheres[0].outline, circle, atol=1)
    assert "outline-moved" in map(pf.warning_code, found.warnings)


def test_it_prints_as_a_table(found):
    assert repr(found) == "Calibration(6 distant lamps, 3 spheres)"
    text = str(found)
    assert text.startswith("photograph")
    assert "strength" in text and "spheres (pixels): chrome at" in text


@pytest.mark.parametrize("ratio", [0, 0.3, 1, 3, 7.9, 8, 8.1, 8.3, 12])
@pytest.mark.parametrize("sigma", [0.003, 0.01, 0.037])
def test_light_is_found_from_the_mean_of_clamped_samples(ratio, sigma):
    """The mean of max(light + noise, 0), in closed form."""
    density = np.exp(-(ratio**2) / 2) / np.sqrt(2 * np.pi)
    mean = sigma * (ratio * ndtr(ratio) + density)
    assert _unclipped(mean, sigma) == pytest.approx(ratio * sigma, abs=1e-6)
