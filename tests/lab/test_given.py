"""Photographs that the command was given: a ball's capture, or a data set of one."""

import numpy as np
import pytest

import phongfit as pf
from phongfit.cli import run
from phongfit.commands.lab import main
from phongfit.lab.given import open_given, settings_of
from phongfit.lab.scene import Frame, make_scene
from phongfit.lab.session import Session
from phongfit.lab.settings import ChosenRequest, Settings
from tests.calibration.studio import directions
from tests.lab.conftest import serving

LAMPS = directions(3)
CIRCLE = (27.0, 20.0, 15.0)
TRUTH = pf.Material((0.6, 0.3, 0.2), 0.3, 20.0, 0.1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ball")
    camera = pf.OrthographicCamera(48, 40, view_height=40 / 15)
    ball = pf.Sphere(((27 - 24) / 15, 0, 0), 1.0)
    for number, lamp in enumerate(LAMPS, 1):
        scene = pf.Scene(ball, camera, pf.DirectionalLight(lamp), ambient=1.0)
        pf.write_image(folder / f"{number}.png", pf.render(scene, TRUTH), "srgb")
    pf.write_lp(folder / "a.lp", [f"{n}.png" for n in (1, 2, 3)], LAMPS)
    return folder


def test_sliders_stand_where_the_capture_says(folder):
    given = open_given(folder, CIRCLE, None, "srgb")
    session = Session(32, given)
    chosen = session.choose(ChosenRequest(number=1))
    assert (chosen["width"], chosen["height"]) == (48, 40)
    settings = Settings.model_validate(chosen["settings"])
    assert settings.centre_x == pytest.approx(100 * 27 / 48)
    assert (settings.centre_y, settings.radius) == pytest.approx((50, 37.5))
    x, y, z = LAMPS[1]
    assert settings.azimuth == pytest.approx(np.degrees(np.arctan2(x, z)), abs=0.01)
    # The ball and its lamp are right: the scene shows what the photograph does.
    scene = make_scene(settings, pf.Sphere(), Frame(40, 48, free=True))
    off = np.abs(pf.render(scene, TRUTH) - pf.read_image(folder / "2.png", "srgb"))
    assert np.mean(np.asarray(off) < 0.01) > 0.98
    with pytest.raises(ValueError, match="number: expected one below 3"):
        session.choose(ChosenRequest(number=3))


def test_a_photograph_given_alone(folder):
    """The circle is found, the lamp is unknown, and both are said."""
    given = open_given(folder / "1.png")
    chosen = Session(32, given).choose(ChosenRequest(number=0))
    settings = Settings.model_validate(chosen["settings"])
    assert settings.centre_x == pytest.approx(100 * 27 / 48, abs=1.0)
    assert settings.centre_y == pytest.approx(50, abs=1.0)
    assert settings.radius == pytest.approx(37.5, abs=1.0)
    assert chosen["options"] == {"light_too": True, "rim": 0.15}
    encoding, circle, lamp = chosen["notes"]
    assert "encoding of 1.png is not known: it is read as sRGB" in encoding
    assert "circle was found" in circle and "direction is unknown" in lamp
    # The circle is a guess, which the page corrects: no pixel is masked by it.
    assert np.asarray(given.read(0).mask).all()
    known = open_given(folder, encoding="srgb")
    chosen = Session(32, known).choose(ChosenRequest(number=1))
    assert chosen["options"]["light_too"] is False
    assert chosen["settings"]["radius"] == pytest.approx(37.5, abs=1.0)


def test_white_of_a_photograph(folder, tmp_path):
    """12 bits in a file of 16."""
    numbers = np.asarray(pf.read_image(folder / "1.png", "srgb"))
    pf.write_image(tmp_path / "dim.png", numbers * 4095 / 65535, "linear", bits=16)
    given = open_given(tmp_path / "dim.png", CIRCLE, None, "linear", 4095)
    np.testing.assert_allclose(given.read(0).image, numbers, atol=2e-4)
    assert len(given.notes) == 1


def test_a_data_set_and_a_camera_that_stands_elsewhere(folder, tmp_path):
    camera = pf.PerspectiveCamera.look_at((4, 0, 3), (0, 0, 0), width=48, height=40)
    # The lamp is in the camera's back: straight from the front.
    scene = pf.Scene(pf.Sphere(), camera, pf.PointLight((8, 0, 6), 2.0), ambient=0.5)
    found = settings_of(scene)
    assert found["azimuth"] == pytest.approx(0, abs=0.01)
    assert found["intensity"] == pytest.approx([2, 2, 2])
    assert (found["centre_x"], found["centre_y"]) == pytest.approx((50, 50))
    # One that was calibrated is the same camera.
    focal = 20 / np.tan(np.radians(15))
    pose = {"position": camera.position, "rotation": camera.rotation}
    same = pf.PinholeCamera(48, 40, fx=focal, **pose)  # pyright: ignore
    other = settings_of(pf.Scene(pf.Sphere(), same, scene.lights, ambient=0.5))
    assert [other[key] for key in ("centre_x", "centre_y", "radius")] == pytest.approx(
        [found[key] for key in ("centre_x", "centre_y", "radius")], rel=1e-5
    )
    rows = np.count_nonzero(np.asarray(scene.trace().mask).any(axis=1))
    assert found["radius"] / 100 * 40 == pytest.approx(rows / 2, abs=1)


def test_a_ball_beside_the_axis_of_a_pinhole():
    camera = pf.PerspectiveCamera(48, 40, fov_y=40.0, position=(0, 0, 0))
    place = np.array([1.5, 1.0, -6.0])
    # A lamp beside the camera lights the ball straight from where it is seen.
    scene = pf.Scene(pf.Sphere(place, 0.5), camera, pf.DirectionalLight(-place))
    found = settings_of(scene)
    assert (found["azimuth"], found["elevation"]) == pytest.approx((0, 0), abs=0.01)
    assert found["centre_x"] > 60 and found["centre_y"] < 40


def test_a_near_lamp_stays_near():
    """What the sliders show of a calibrated ball is what the scene shows of it."""
    camera = pf.OrthographicCamera(48, 40, view_height=4.0, position=(0, 0, 50))
    ball = pf.Sphere((0.4, -0.2, 1.0), 1.5)
    # From a reference point elsewhere, its light half a bulb's.
    lamp = pf.PointLight((3, 2, 6), (1.0, 0.9, 0.8), attenuation=(0.5, 0, 0.5 / 36))
    scene = pf.Scene(ball, camera, lamp)
    found = settings_of(scene)
    assert found["light"] == "point"
    assert found["distance"] == pytest.approx(np.sqrt(2.6**2 + 2.2**2 + 25) / 1.5)
    shown = make_scene(
        Settings.model_validate(found), pf.Sphere(), Frame(40, 48, free=True)
    )
    images = [np.asarray(pf.render(one, TRUTH)) for one in (scene, shown)]
    assert images[0].max() > 0.5
    assert np.abs(images[0] - images[1]).max() < 0.002
    # So far away that the slider ends: its light is parallel.
    away = pf.PointLight((0, 0, 500), attenuation=(0, 0, 1 / 500**2))
    far = settings_of(pf.Scene(ball, camera, away))
    assert far["light"] == "directional"
    assert far["intensity"] == pytest.approx([1, 1, 1], rel=0.01)
    inside = pf.PointLight((0.4, -0.2, 2.0))
    with pytest.raises(ValueError, match="lights: .* at least 1.2 radii .* 0.667"):
        settings_of(pf.Scene(ball, camera, inside))


@pytest.mark.parametrize(
    "options, words",
    [
        (["{dark}"], "sphere: no circle of a ball was found in"),
        (["{folder}"], "encoding: expected linear or srgb"),
        (["--white", "4095"], "white: is of photographs, and none are given"),
        (["--sphere", "1", "2", "3"], "sphere: is of photographs, and none are given"),
        (["nowhere", "--sphere", "1", "2", "3"], "nowhere"),
        (["{folder}", "--sphere", "27", "20", "15"], "encoding: expected"),
    ],
)
def test_bad_options(folder, tmp_path, capsys, options, words):
    pf.write_image(tmp_path / "dark.png", np.zeros((40, 48, 3)), "srgb")
    names = {"folder": folder, "dark": tmp_path / "dark.png"}
    words_given = [option.format(**names) for option in options]
    assert run(main, ["--no-browser", "--port", "0", *words_given]) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: ") and words in err and err.count("\n") == 1


def test_a_mesh_is_no_ball(tmp_path):
    scene = pf.Scene(pf.shapes.Ball().mesh(8, 4), lights=pf.DirectionalLight((0, 0, 1)))
    with pytest.raises(ValueError, match="surface: expected a ball"):
        settings_of(scene)


@pytest.mark.extended
def test_the_page_begins_with_the_first_and_has_a_menu(folder, browser):
    with serving(Session(64, open_given(folder, CIRCLE, None, "srgb"))) as port:
        page = browser.new_page()
        page.goto(f"http://127.0.0.1:{port}/")
        caption = page.locator("#target-figure figcaption")
        caption.get_by_text("1.png").wait_for(timeout=60_000)
        menu = page.locator("#photographs")
        names = menu.locator("option").all_inner_texts()
        assert names == ["–", "1.png", "2.png", "3.png"]
        menu.select_option("2")
        caption.get_by_text("3.png").wait_for(timeout=60_000)
        azimuth = page.locator("input[type=range][name=azimuth]").input_value()
        x, _, z = LAMPS[2]
        assert float(azimuth) == pytest.approx(np.degrees(np.arctan2(x, z)), abs=1)
        page.close()


@pytest.mark.extended
@pytest.mark.parametrize("width", [1440, 390])
def test_the_page_of_a_photograph_alone(folder, browser, width):
    with serving(Session(64, open_given(folder / "1.png"))) as port:
        page = browser.new_page(viewport={"width": width, "height": 844})
        page.goto(f"http://127.0.0.1:{port}/")
        page.locator("#notes li").nth(2).wait_for(timeout=60_000)
        assert page.is_checked("input[name=light_too]")
        page.locator("#outline path[d^=M]").wait_for(timeout=60_000)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        page.click("#make")
        page.locator("#notes li").first.wait_for(state="detached")
        page.close()
