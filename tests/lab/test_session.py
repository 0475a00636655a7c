"""Pictures, targets and fits, without a server."""

import re

import imagecodecs
import numpy as np
import pytest
import trimesh

import phongfit as pf
from phongfit.lab.pictures import MOST_BRIGHTENED, outline_path
from phongfit.lab.responses import differences
from phongfit.lab.session import Session
from phongfit.lab.settings import (
    FitOptions,
    FitRequest,
    PictureRequest,
    Settings,
    TargetRequest,
)
from phongfit.rendering.film import decode
from tests.lab.conftest import SIZE

TURNED = Settings(azimuth=-20.0, shininess=9.0)


def _picture(session: Session, settings: Settings, target: str | None = None):
    content = session.picture(PictureRequest(settings=settings, target=target))
    return imagecodecs.png_decode(content)


def _png(image: np.ndarray) -> bytes:
    return bytes(imagecodecs.png_encode(image))


def test_the_picture_is_the_renderers(session):
    camera = pf.OrthographicCamera(SIZE, SIZE)
    azimuth, elevation = np.deg2rad([-20, 30])
    direction = (
        np.cos(elevation) * np.sin(azimuth),
        np.sin(elevation),
        np.cos(elevation) * np.cos(azimuth),
    )
    scene = pf.Scene(pf.Sphere(), camera, pf.DirectionalLight(direction), 0.3)
    material = pf.Material((0.6, 0.3, 0.2), 0.4, 9.0, (0.6, 0.3, 0.2))
    film = pf.Film(encoding="srgb", bits=8)
    smooth = pf.render(scene, material, film=film, samples=4)
    expected = np.round(255 * np.asarray(smooth))
    assert np.abs(_picture(session, TURNED) - expected).max() <= 1


def test_geometry_is_traced_once(session):
    _picture(session, TURNED)
    before = session._geometry.cache_info()
    for settings in (TURNED, Settings(light="none"), Settings(diffuse=(0, 0, 1))):
        _picture(session, settings)
    after = session._geometry.cache_info()
    assert after.misses == before.misses and after.hits == before.hits + 3


def test_a_mesh_under_each_shading_method(session, tmp_path):
    path = tmp_path / "ball.stl"
    trimesh.creation.icosphere(2).export(path)
    loaded = session.add_mesh(path.name, path.read_bytes())
    assert loaded["faces"] == 320
    shown = [
        _picture(session, Settings(surface=loaded["surface"], shading=shading))
        for shading in ("flat", "gouraud", "phong")
    ]
    colours = [len(np.unique(image.reshape(-1, 3), axis=0)) for image in shown]
    # Each of 160 faces has one colour, but for pixels that see several.
    assert colours[0] < 0.6 * min(colours[1:])
    sphere = _picture(session, Settings(shading="flat"))
    assert not np.array_equal(sphere, shown[0])


def test_what_is_no_longer_held(session):
    with pytest.raises(ValueError, match="mesh: is no longer held; load it again"):
        _picture(session, Settings(surface="elsewhere"))
    with pytest.raises(ValueError, match="target: is no longer held"):
        _picture(session, Settings(), "elsewhere")
    first = session.make_target(TargetRequest(settings=Settings()))["target"]
    for _ in range(8):
        session.make_target(TargetRequest(settings=Settings()))
    with pytest.raises(ValueError, match="target: is no longer held"):
        session.fit(FitRequest(settings=Settings(), target=first))


def test_a_fit_of_a_made_target(session):
    made = session.make_target(TargetRequest(settings=TURNED, noise=0.01, seed=3))
    # The material of the sliders does not matter, their light does.
    asked = Settings(azimuth=-20.0, diffuse=(0, 1, 0))
    answer = session.fit(FitRequest(settings=asked, target=made["target"]))
    assert len(answer["rows"]) == 10 and answer["differs"] == []
    for row in answer["rows"]:
        value, error = float(row["value"]), float(row["error"].removeprefix("± "))
        assert error > 0 and abs(value - float(row["truth"])) < 4 * error
        assert row["off"].endswith(" σ") and row["note"] == ""
    assert answer["head"].startswith("Converged") and answer["warnings"] == []
    assert answer["settings"]["shininess"] == pytest.approx(9, rel=0.1)
    assert len(answer["settings"]["diffuse"]) == 3
    for name in ("fitted", "residual"):
        assert answer[name].startswith("data:image/png;base64,")
    assert 0.01 < answer["scale"] < 0.06


@pytest.mark.extended
def test_what_is_not_identifiable(session):
    """Where no light falls there is no highlight, and nothing diffuse."""
    dark = Settings(intensity=(0, 0, 0))
    made = session.make_target(TargetRequest(settings=dark))
    answer = session.fit(FitRequest(settings=dark, target=made["target"]))
    notes = {row["label"]: row["note"] for row in answer["rows"]}
    assert notes["shininess"] == notes["diffuse.red"] == "not identifiable"
    assert notes["ambient.red"] == ""
    assert any("not identifiable" in words for words in answer["warnings"])
    assert set(answer["settings"]) == {"ambient"}


def test_what_a_fit_assumes_otherwise():
    truth = Settings(light="none", azimuth=-20.0, diffuse=(0, 0, 0))
    assert differences(Settings(light="none"), truth) == []
    assert differences(Settings(specular_model="phong", ambient_light=0.5), truth) == [
        "kind of light",
        "ambient light",
        "highlight",
    ]
    assert differences(Settings(light="none", surface="mesh"), truth) == ["surface"]


@pytest.mark.slow
def test_a_light_whose_place_is_unknown(session):
    made = session.make_target(TargetRequest(settings=TURNED))
    asked = FitRequest(
        settings=Settings(azimuth=-10.0, elevation=20.0),
        target=made["target"],
        options=FitOptions(light_too=True),
    )
    answer = session.fit(asked)
    assert answer["settings"]["azimuth"] == pytest.approx(-20, abs=0.5)
    assert answer["settings"]["elevation"] == pytest.approx(30, abs=0.5)
    names = {row["name"]: row["truth"] for row in answer["rows"]}
    assert names["light direction y"] == "0.5"


def test_no_light_has_no_place(session):
    made = session.make_target(TargetRequest(settings=Settings(light="none")))
    asked = FitRequest(
        settings=Settings(light="none"),
        target=made["target"],
        options=FitOptions(light_too=True),
    )
    with pytest.raises(ValueError, match="light: there is no light"):
        session.fit(asked)


def test_a_photograph_and_its_mask(session):
    settings = Settings(centre_x=40.0, centre_y=50.0, radius=30.0)
    shape = (40, 60)
    loaded = session.add_photograph("dark.png", _png(_dark(shape)), "linear")
    assert loaded["photograph"] and (loaded["height"], loaded["width"]) == shape
    assert loaded["brighten"] == pytest.approx(0.8 * 255 / 51)
    assert _picture(session, settings, loaded["target"]).shape == (*shape, 3)
    mask = np.zeros(shape, np.uint8)
    rows, columns = np.mgrid[:40, :60] + 0.5
    mask[(rows - 20) ** 2 + (columns - 24) ** 2 < 12**2] = 1
    masked = session.add_mask(loaded["target"], "mask.png", _png(mask))
    assert masked["centre_x"] == pytest.approx(40, abs=0.1)
    assert masked["centre_y"] == pytest.approx(50, abs=0.1)
    assert masked["radius"] == pytest.approx(30, abs=0.1)
    asked = PictureRequest(settings=settings, target=masked["target"])
    corners = np.array(re.findall(r"([\d.]+) ([\d.]+)", session.outline(asked)["path"]))
    # Of a circle around 40 % and 50 % of the frame, with 30 % of its height.
    away = np.hypot(*(corners.astype(float) - (24, 20)).T)
    np.testing.assert_allclose(away, 12, atol=0.7)
    with pytest.raises(ValueError, match=r"small.png: expected .*, got \(4, 4\)"):
        session.add_mask(loaded["target"], "small.png", _png(mask[:4, :4]))
    with pytest.raises(ValueError, match="empty.png: it leaves no pixel"):
        session.add_mask(loaded["target"], "empty.png", _png(0 * mask))


def test_a_dark_photograph_and_what_stands_beside_it_are_brightened_alike(session):
    dim, none = (0.1, 0.1, 0.1), (0.0, 0.0, 0.0)
    settings = Settings(ambient=none, diffuse=dim, specular=none)
    dark, bright = (
        session.add_photograph("a.png", _png(k * _dark((48, 48))), "linear")
        for k in (1, 4)
    )
    assert (dark["brighten"], bright["brighten"]) == (pytest.approx(4), 1)
    shown, plain = (
        np.asarray(decode(_picture(session, settings, one["target"]) / 255, "srgb"))
        for one in (dark, bright)
    )
    assert 0.05 < plain.max() < 0.2
    np.testing.assert_allclose(shown, 4 * plain, atol=0.02)


def test_a_mask_says_what_is_to_be_seen(session):
    image = np.zeros((40, 60, 3), np.uint8)
    image[10:13, 20:24] = 204
    mask = np.where(image[..., 0], 1, 0).astype(np.uint8)
    loaded = session.add_photograph("small.png", _png(image), "linear")
    assert loaded["brighten"] == MOST_BRIGHTENED
    masked = session.add_mask(loaded["target"], "mask.png", _png(mask))
    assert masked["brighten"] == 1


def test_an_outline_that_the_frame_cuts_off():
    mask = np.zeros((20, 30), bool)
    mask[5:15, 20:] = True
    path = outline_path(mask)
    assert path.count("M") == 1 and path.startswith("M29.5 ")
    assert path.endswith(("29.5 5.0", "29.5 15.0"))
    assert outline_path(np.ones((20, 30), bool)) == ""
    assert outline_path(np.ones((1, 30), bool)) == ""
    with pytest.raises(ValueError, match="target: expected one"):
        Session(8).outline(PictureRequest(settings=Settings()))


def _dark(shape: tuple[int, int]) -> np.ndarray:
    return np.full((*shape, 3), 51, np.uint8)
