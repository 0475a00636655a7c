"""`phongfit response`, and its curve wherever an encoding is asked for."""

import json

import numpy as np
import pytest

import phongfit as pf
from phongfit.cli import main
from phongfit.commands.data import DataOptions, read_data
from phongfit.files.dataset import Photographs
from phongfit.files.scenes import open_scene_dataset
from phongfit.fitting.result import film_words
from phongfit.rendering.film import encode
from tests.calibration.studio import directions
from tests.calibration.test_response import EXPOSURES, patches
from tests.maps.hills import made

NUMBERS = np.linspace(0, 1, 257)
CAMERA = pf.ResponseCurve(NUMBERS**1.6)
LAMPS = directions(4)
TRUTH = pf.Material((0.8, 0.7, 0.6), 0.0, 1.0, 0.02)
CIRCLE = ("24", "18", "15")


@pytest.fixture(scope="module")
def bracket(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bracket")
    for number, exposure in enumerate(EXPOSURES, 1):
        pf.write_image(folder / f"{number}.png", exposure * patches(), CAMERA)
    return folder


@pytest.fixture(scope="module")
def curve(bracket, tmp_path_factory):
    """The file of the camera's curve, as the command makes it."""
    path = tmp_path_factory.mktemp("curve") / "response.json"
    words = ["response", f"{bracket}", "-o", f"{path}", "--exposures"]
    assert main([*words, *map(str, EXPOSURES)]) == 0
    return path


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """A ball under lamps that a list names, by the same camera."""
    folder = tmp_path_factory.mktemp("ball")
    camera = pf.OrthographicCamera(48, 36, view_height=36 / 15)
    for number, lamp in enumerate(LAMPS, 1):
        scene = pf.Scene(pf.Sphere(), camera, pf.DirectionalLight(lamp), ambient=1.0)
        pf.write_image(folder / f"{number}.png", pf.render(scene, TRUTH), CAMERA)
    pf.write_lp(folder / "lamps.lp", [f"{n}.png" for n in range(1, 5)], LAMPS)
    return folder


def test_a_bracket_gives_the_curve(curve):
    written = json.loads(curve.read_text())
    assert np.array(written["light"]) == pytest.approx(NUMBERS**1.6, abs=0.01)
    assert written["checks"]["linear"]["sigmas"] > 10
    assert written["checks"]["srgb"]["sigmas"] > 10


def test_a_matte_sphere_gives_it_too(photographs, tmp_path, capsys):
    out = tmp_path / "r.json"
    words = ["response", f"{photographs}", "-o", f"{out}", "--matte", *CIRCLE]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert said.count("does not fit") == 2 and f"use --encoding {out}" in said
    light = np.array(json.loads(out.read_text())["light"])
    scale = light[200] / NUMBERS[200] ** 1.6
    assert light[80:200] == pytest.approx(scale * NUMBERS[80:200] ** 1.6, abs=0.01)


def test_twelve_bits_in_files_of_sixteen(tmp_path, capsys):
    for number, exposure in enumerate(EXPOSURES, 1):
        levels = np.round(4095 * encode(np.clip(exposure * patches(), 0, 1), "srgb"))
        path = tmp_path / f"{number}.png"
        pf.write_image(path, levels / 65535, "linear", bits=16)
    out = tmp_path / "r.json"
    words = ["response", f"{tmp_path}", "-o", f"{out}", "--white", "4095"]
    assert main([*words, "--exposures", *map(str, EXPOSURES)]) == 0
    assert "use --encoding srgb" in capsys.readouterr().out


def test_a_fit_takes_the_curve(photographs, curve, tmp_path, asked_of):
    words = ["fit", photographs, "--sphere", *CIRCLE, "--encoding", curve]
    (scenes, images), options = asked_of("phongfit.commands.fit.fit", *words, "-o", "a")
    assert film_words(options["film"]) == "clamped, 8-bit response curve"
    # The photographs are in light again.
    for scene, image in zip(scenes, images, strict=True):
        shown = np.asarray(pf.render(scene, TRUTH))
        assert np.abs(shown - image).max() < 0.015 < shown.std()
    given = DataOptions(photographs, sphere=(24, 18, 15), encoding=str(curve))
    _, record = read_data(given)
    assert record.reading.encoding == str(curve) and curve.name in record.inputs


def test_a_data_set_keeps_the_curve(photographs, curve, tmp_path, monkeypatch):
    scene = photographs / "scene.json"
    words = ["scene", f"{photographs}", "--sphere", *CIRCLE, "--overwrite"]
    assert main([*words, "--encoding", f"{curve}"]) == 0
    written = json.loads(scene.read_text())["encoding"]
    assert written["kind"] == "response_curve" and len(written["light"]) == 257
    data: Photographs = open_scene_dataset(photographs)
    assert data.film.encoding == pf.ResponseCurve(written["light"])
    with_curve = data.read(0).image
    assert with_curve == pytest.approx(
        pf.read_image(photographs / "1.png", CAMERA), abs=0.01
    )
    # Maps keep it, too: what they are of does not matter here.
    monkeypatch.setattr("phongfit.commands.maps.fit_maps", lambda *_, **__: made())
    maps = ["maps", f"{photographs}", "--no-pictures", "-o", f"{tmp_path / 'm'}"]
    assert main(maps) == 0
    kept = json.loads((tmp_path / "m" / "maps.json").read_text())["encoding"]
    assert kept == written
    scene.unlink()


@pytest.mark.parametrize(
    "change, words",
    [
        ({"kind": "response_curve", "light": [0, 2, 1]}, "light: expected"),
        ({"kind": "response_curve"}, "encoding.light: is missing"),
        ("gamma", "encoding: expected 'linear' or 'srgb', or a response curve"),
    ],
)
def test_a_wrong_curve_in_a_scene_is_named(photographs, tmp_path, change, words):
    path = tmp_path / "scene.json"
    pf.save_scene(path, pf.Scene(pf.Sphere()))
    path.write_text(json.dumps(json.loads(path.read_text()) | {"encoding": change}))
    with pytest.raises(ValueError) as caught:
        pf.load_scene(path)
    assert words in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "options, words",
    [
        ([], "exposures: expected --exposures"),
        (["--exposures", "1", "2"], "exposures: expected 4, one for each of 1.png"),
        (["--matte", *CIRCLE], "lights: expected lights.json or an .lp"),
        (["--matte", *CIRCLE, "--exposures", "1"], "exposures: expected them or"),
        (["--lights", "a.lp"], "lights: expected --matte with them"),
    ],
)
def test_what_is_missing_is_one_line(bracket, tmp_path, refused, options, words):
    out = tmp_path / "r.json"
    err = refused("response", bracket, "-o", out, *options)
    assert err.startswith(f"error: {words}")
    assert not out.exists()


def test_an_encoding_that_is_none(photographs, tmp_path, refused):
    words = ["fit", f"{photographs}", "--sphere", *CIRCLE, "-o", f"{tmp_path / 'a'}"]
    assert "encoding: expected linear, srgb or the file of" in refused(
        *words, "--encoding", "gamma"
    )
    (tmp_path / "b.json").write_text('{"format": "phongfit response", "version": 1}')
    assert "b.json: light: is missing" in refused(
        *words, "--encoding", tmp_path / "b.json"
    )
