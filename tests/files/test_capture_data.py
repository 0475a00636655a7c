"""Photographs of known shape as a data set, with lights known or not."""

import dataclasses
import shutil

import numpy as np
import pytest
from PIL import Image

import phongfit as pf
from phongfit.files.capture_data import open_captured
from tests.calibration.studio import Studio, calibrated, directions
from tests.files.test_photographs import exif

HEIGHT, WIDTH = 36, 48
CIRCLE = (27.0, 16.0, 12.0)
LAMPS = directions(3)
TRUTH = pf.Material((0.5, 0.3, 0.2), 0.3, 20.0, 0.1)


def ball(lamp):
    """The same ball as the circle shows, in units of its own."""
    x, y, radius = CIRCLE
    centre = (2 * (x - WIDTH / 2) / radius, 2 * (HEIGHT / 2 - y) / radius, 0)
    camera = pf.OrthographicCamera(WIDTH, HEIGHT, view_height=2 * HEIGHT / radius)
    light = pf.DirectionalLight(lamp)
    return pf.Scene(pf.Sphere(centre, 2.0), camera, light, ambient=1.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ball")
    for number, lamp in enumerate(LAMPS, 1):
        pf.write_image(folder / f"{number}.png", pf.render(ball(lamp), TRUTH), "srgb")
    return folder


def test_one_photograph_and_its_circle_are_enough(folder):
    data = open_captured(folder / "1.png", "srgb", sphere=CIRCLE).load()
    assert data.unknown == ("scene.lights[0].direction",)
    assert data.film == pf.Film(encoding="srgb", bits=8)
    # The scene is the ball's, but for its light.
    scene = dataclasses.replace(data.scenes[0], lights=pf.DirectionalLight(LAMPS[0]))
    off = np.abs(np.asarray(pf.render(scene, TRUTH)) - data.images[0])[data.masks[0]]
    assert len(off) > 200 and off.max() < 0.01


def test_a_folder_without_lights_says_what_is_unknown(folder):
    data = open_captured(folder, "srgb", sphere=CIRCLE)
    assert data.names == ("1.png", "2.png", "3.png")
    assert data.unknown == ("scene.lights[0].direction", "exposure")


def test_a_list_of_lights_in_the_order_of_the_list(folder, tmp_path):
    names = ["3.png", "1.png", "2.png"]
    pf.write_lp(tmp_path / "a.lp", names, LAMPS[[2, 0, 1]])
    data = open_captured(folder, "srgb", sphere=CIRCLE, lights=tmp_path / "a.lp")
    assert data.names == tuple(names)
    assert data.unknown == ("exposure",)
    lights = []
    for scene in data.scenes:
        light = scene.lights[0]
        assert isinstance(light, pf.DirectionalLight)
        lights.append(np.asarray(light.direction))
    assert np.stack(lights) == pytest.approx(LAMPS[[2, 0, 1]], abs=1e-6)


def test_one_photograph_takes_its_lamp_from_a_list(folder, tmp_path):
    pf.write_lp(tmp_path / "a.lp", ["1.png", "dome/2.png"], LAMPS[:2])
    one = {"sphere": CIRCLE, "lights": tmp_path / "a.lp"}
    data = open_captured(folder / "2.png", "srgb", **one)
    assert data.unknown == ()
    light = data.scenes[0].lights[0]
    assert isinstance(light, pf.DirectionalLight)
    assert np.asarray(light.direction) == pytest.approx(LAMPS[1], abs=1e-6)
    with pytest.raises(ValueError, match=r"a.lp: lights: expected .* none for 3.png"):
        open_captured(folder / "3.png", "srgb", **one)


@pytest.mark.parametrize("name", ["mask.png", "ball.Mask.png"])
def test_a_mask_beside_the_photographs_is_used(folder, tmp_path, name):
    shutil.copytree(folder, tmp_path / "photos")
    pf.write_lp(tmp_path / "photos/a.lp", ["1.png", "2.png", "3.png"], LAMPS)
    white = np.zeros((HEIGHT, WIDTH))
    white[:, :30] = 1
    pf.write_image(tmp_path / "photos" / name, white, "linear")
    data = open_captured(tmp_path / "photos", "srgb", sphere=CIRCLE)
    assert f"pixels that are black in {name} are left out" in data.notes
    mask = data.read(0).mask
    assert mask[:, :30].any() and not mask[:, 30:].any()
    # Two could be of anything.
    pf.write_image(tmp_path / "photos/cat.mask.png", white, "linear")
    data = open_captured(tmp_path / "photos", "srgb", sphere=CIRCLE)
    assert data.read(0).mask[:, 30:].any()


def test_exposures_that_differ_are_lights_that_do(tmp_path):
    for name, time in (("1.png", 0.25), ("2.png", 1.0)):
        image = np.round(255 * time * np.asarray(pf.render(ball(LAMPS[0]), TRUTH)))
        shown = Image.fromarray(image.astype(np.uint8))
        shown.save(tmp_path / name, exif=exif(time=time))
    pf.write_lp(tmp_path / "a.lp", ["1.png", "2.png"], LAMPS[[0, 0]])
    data = open_captured(tmp_path, "linear", sphere=CIRCLE)
    assert data.notes == (
        "1.png 1/4 s, 2.png 1 s: brought to common light, to some 5 %, as cameras "
        "state rounded numbers",
    )
    bright = data.scenes[1]
    assert float(bright.ambient[0]) == 4
    # In the light of the first.
    quarter = pf.Material((0.125, 0.075, 0.05), 0.075, 20.0, 0.025)
    for number, scene in enumerate(data.scenes):
        photograph, shown = data.read(number), np.asarray(pf.render(scene, quarter))
        off = np.abs(shown - photograph.image)[photograph.mask]
        assert len(off) > 50 and off.max() < 0.003


def test_rims_and_shades_are_left_out(folder, tmp_path):
    pf.write_lp(tmp_path / "a.lp", ["1.png", "2.png", "3.png"], LAMPS)
    _, mask = open_captured(
        folder, "srgb", sphere=CIRCLE, lights=tmp_path / "a.lp", min_facing=0.5
    ).read(0)
    rows, columns = np.nonzero(mask)
    away = np.hypot(columns + 0.5 - CIRCLE[0], rows + 0.5 - CIRCLE[1])
    # n·v is the cosine of the angle, at whose sine the pixel lies.
    assert 0.75 < away.max() / CIRCLE[2] < np.sqrt(1 - 0.5**2) + 1e-3
    lit = open_captured(folder, "srgb", sphere=CIRCLE, lights=tmp_path / "a.lp")
    whole = open_captured(folder, "srgb", sphere=CIRCLE)
    assert whole.read(1).mask.sum() > lit.read(1).mask.sum() > 0


@pytest.fixture(scope="module")
def distant(tmp_path_factory):
    """Photographs, their calibration, and the matte ball's circle."""
    folder, studio = tmp_path_factory.mktemp("distant"), Studio()
    for number, lamp in enumerate(LAMPS, 1):
        image = studio.photograph(lamp, seed=number)
        pf.write_image(folder / f"{number}.jpg", image, "srgb")
    return folder, calibrated(studio, folder), studio.circles("matte")[0]


def test_a_calibration_gives_camera_lights_and_strengths(distant, tmp_path):
    folder, found, circle = distant
    # In the folder of the photographs it is found by itself.
    data = open_captured(folder, sphere=circle)
    assert data.unknown == ()
    scene = data.scenes[0]
    assert isinstance(scene.camera, pf.PerspectiveCamera)
    assert isinstance(scene.surface, pf.Sphere)
    assert np.asarray(scene.surface.center) == pytest.approx([-0.1, 0.8, -10], abs=0.05)
    assert float(scene.surface.radius) == pytest.approx(0.5, rel=0.01)
    assert found.covariance is not None
    names = "scene.lights[0].direction", "scene.lights[0].intensity"
    joint = data.load().uncertain[names]
    assert joint == pytest.approx(found.covariance[:-1, :-1])
    errors = np.sqrt(np.diag(joint))[-3:]
    assert errors == pytest.approx(found.lamps[2].intensity_error)
    # What a JPEG rounds of their one hue is the same for all of a colour, or nearly.
    assert (errors > 0.002).all()
    behind = dataclasses.replace(found, reference=-found.reference)
    pf.save_calibration(tmp_path / "behind.json", behind)
    with pytest.raises(ValueError, match="lights: .* lies before the camera, at z < 0"):
        open_captured(folder, sphere=circle, lights=tmp_path / "behind.json")
    more = shutil.copytree(folder, tmp_path / "more")
    shutil.copy(folder / "3.jpg", more / "4.jpg")
    with pytest.raises(ValueError, match="got none for 4.jpg"):
        open_captured(more, sphere=circle)
    with pytest.raises(ValueError, match="fov: expected none, since the calibration"):
        open_captured(folder, normals="fit", fov=40)


def test_photographs_that_the_calibration_leaves_out(distant, tmp_path):
    folder, found, circle = distant
    left = dataclasses.replace(
        found,
        lamps=found.lamps[:1] + found.lamps[2:],
        covariance=None,
        left_out={"2.jpg": "it shows two lamps"},
    )
    pf.save_calibration(tmp_path / "lights.json", left)
    data = open_captured(folder, sphere=circle, lights=tmp_path)
    assert data.names == ("1.jpg", "3.jpg")
    assert data.notes[-1] == "2.jpg: left out, as the calibration does"
    assert data.load().images[1].shape == data.read(1).image.shape


@pytest.fixture(scope="module")
def near(tmp_path_factory):
    """Photographs under near lamps, their calibration, and the matte ball's circle."""
    folder, studio = tmp_path_factory.mktemp("near"), Studio()
    for number, lamp in enumerate([0, 0, -10] + 6 * LAMPS, 1):
        image = studio.photograph(lamp, near=True, seed=number)
        pf.write_image(folder / f"{number}.png", image, "srgb")
    found = calibrated(studio, folder, "srgb", "near")
    return folder, found, studio.circles("matte")[0]


@pytest.mark.extended
def test_a_near_lamp_that_is_further_is_as_bright_where_it_was_measured(near):
    folder, found, circle = near
    data = open_captured(folder, "srgb", sphere=circle)
    names = [f"scene.lights[0].{n}" for n in ("position", "attenuation", "intensity")]
    joint = data.uncertain[tuple(names)]
    assert found.covariance is not None
    assert joint[:9, :9] == pytest.approx(found.covariance[:9, :9])
    # And strengths with it, which the matte ball shows next to where the lamp is.
    assert joint[18:, :9] == pytest.approx(found.covariance[9:18, :9])
    assert np.abs(joint[18:, :9]).max() > 0
    errors = np.concatenate([lamp.intensity_error for lamp in found.lamps])
    assert np.sqrt(np.diag(joint)[18:]) == pytest.approx(errors)
    # One of the joint covariance's own steps: light at the reference point stays.
    lamp, light = found.lamps[1], data.scenes[1].lights[0]
    assert isinstance(light, pf.PointLight)
    away = (lamp.position - found.reference) / np.linalg.norm(
        lamp.position - found.reference
    )
    # How attenuation follows the distance.
    share = joint[9 + 3 + 2, 3:6] @ away / (away @ joint[3:6, 3:6] @ away)
    distance = np.linalg.norm(lamp.position - found.reference)
    expected = -2 * min(found.falloff, 1) / distance**3
    assert share == pytest.approx(expected, rel=0.2)
    assert found.falloff <= 1 + 1e-4


@pytest.mark.extended
def test_positions_in_other_axes_than_the_calibrations(near, tmp_path):
    folder, found, circle = near
    seen = open_captured(folder, "srgb", sphere=circle).scenes[0].trace()
    there = np.asarray(seen.mask)[..., None]
    normals = np.where(there, seen.normal, 0)
    places = np.where(there, seen.position, 0)
    for name, shift in (("own", 0), ("other", 20)):
        moved = np.where(there, places + [0, 0, shift], 0)
        np.savez(tmp_path / f"{name}.npz", normals=normals, positions=moved)
    open_captured(folder, "srgb", normals=tmp_path / "own.npz")
    wanted = "other.npz: expected positions in the axes of the calibration"
    with pytest.raises(ValueError, match=wanted):
        open_captured(folder, "srgb", normals=tmp_path / "other.npz")


def test_normals_from_a_file(folder, tmp_path):
    seen = ball(LAMPS[0]).trace()
    normals = np.where(seen.mask[..., None], seen.normal, 0)
    np.savez(tmp_path / "n.npz", normals=normals)
    np.save(tmp_path / "n.npy", normals)
    pf.write_lp(tmp_path / "a.lp", ["1.png", "2.png", "3.png"], LAMPS)
    read = [
        open_captured(folder, "srgb", normals=tmp_path / name, lights=tmp_path / "a.lp")
        for name in ("n.npz", "n.npy")
    ]
    for data in read:
        assert isinstance(data.scenes[0].surface, pf.NormalMap)
        assert (data.read(0).mask == read[0].read(0).mask).all()
    np.savez(tmp_path / "other.npz", normals=normals[:-1])
    with pytest.raises(ValueError, match="other.npz: expected 48 × 36 normals"):
        open_captured(folder, "srgb", normals=tmp_path / "other.npz")


@pytest.mark.parametrize(
    "options, message",
    [
        ({}, "sphere: expected the shape .* got neither"),
        ({"sphere": (1, 2)}, "sphere: expected x, y and radius"),
        ({"sphere": (1000, 2, 5)}, "sphere: expected a sphere .* 48 × 36 pixels"),
        ({"sphere": (27, 16, 19)}, "sphere: expected a sphere .* radius 19"),
        ({"sphere": 5}, "sphere: expected a list, each entry a number"),
        ({"sphere": CIRCLE, "lights": "nowhere"}, "nowhere: cannot be read"),
    ],
)
def test_what_is_wrong_is_said(folder, options, message):
    with pytest.raises(ValueError, match=message):
        open_captured(folder, "srgb", **options)


def test_the_encoding_is_not_guessed(folder):
    with pytest.raises(ValueError, match="encoding: expected linear or srgb"):
        open_captured(folder / "1.png", sphere=CIRCLE)


@pytest.mark.parametrize("normals", ["fit", "n.npy"])
def test_a_pinhole_without_a_calibration(folder, tmp_path, normals):
    """As each pixel looks; a plane before it, where no positions are known."""
    np.save(tmp_path / "n.npy", np.tile([0.0, 0.0, 1.0], (HEIGHT, WIDTH, 1)))
    pf.write_lp(tmp_path / "a.lp", ["1.png", "2.png", "3.png"], LAMPS)
    given = normals if normals == "fit" else tmp_path / normals
    options = {"normals": given, "lights": tmp_path / "a.lp"}
    data = open_captured(folder, "srgb", fov=40, **options)
    camera = pf.PerspectiveCamera(WIDTH, HEIGHT, fov_y=40, position=(0, 0, 0))
    seen = data.scenes[0].trace()
    np.testing.assert_allclose(seen.to_viewer, -camera.rays().direction, atol=1e-6)
    np.testing.assert_allclose(seen.position[..., 2], -1, atol=1e-6)
    for wrong in (-1, 180):
        with pytest.raises(ValueError, match="fov: expected degrees ≥ 0 and < 180"):
            open_captured(folder, "srgb", fov=wrong, **options)


def test_the_angle_of_view_that_exif_data_state(folder, tmp_path):
    for number in (1, 2, 3):
        photograph = Image.open(folder / f"{number}.png")
        photograph.save(tmp_path / f"{number}.png", exif=exif(equivalent=50))
    pf.write_lp(tmp_path / "a.lp", ["1.png", "2.png", "3.png"], LAMPS)
    stated = open_captured(tmp_path, "srgb", normals="fit")
    assert any("° from bottom to top (EXIF" in note for note in stated.notes)
    focal = 50 / np.hypot(36, 24) * np.hypot(HEIGHT, WIDTH)
    angle = np.degrees(2 * np.arctan(HEIGHT / 2 / focal))
    expected = pf.PerspectiveCamera(WIDTH, HEIGHT, fov_y=angle, position=(0, 0, 0))
    found = stated.scenes[0].camera.rays().direction
    np.testing.assert_allclose(found, expected.rays().direction, atol=1e-5)
    plain = open_captured(tmp_path, "srgb", normals="fit", fov=0)
    assert isinstance(plain.scenes[0].camera, pf.OrthographicCamera)
