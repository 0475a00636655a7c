"""`phongfit calibrate`, from a folder of photographs to files and a picture."""

import json

import pytest

import phongfit as pf
from phongfit.cli import main
from tests.calibration.studio import Studio, degrees, directions

LAMPS = directions(5)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photographs")
    studio = Studio()
    for number, lamp in enumerate(LAMPS, 1):
        image = studio.photograph(lamp, seed=number)
        pf.write_image(folder / f"{number}.jpg", image, "srgb")
    return studio, folder


def circles(studio):
    words = []
    for circle in studio.circles("chrome"):
        words += ["--sphere", *(f"{number:.0f}" for number in circle)]
    return [*words, "--matte", *(f"{n:.0f}" for n in studio.circles("matte")[0])]


def test_lights_with_errors_and_a_picture(photographs, tmp_path, capsys):
    studio, folder = photographs
    out = tmp_path / "lights"
    assert (
        main(
            ["calibrate", str(folder), "-o", str(out), "--fov", "20"] + circles(studio)
        )
        == 0
    )
    said = capsys.readouterr().out
    assert "calibration.png, lights.json, lights.lp" in said
    assert "warning" not in said
    assert "assumed: no exposure times are stated" in said
    data = json.loads((out / "lights.json").read_text())
    found = [light["direction"] for light in data["lights"]]
    assert degrees(found, LAMPS).max() < 0.5
    assert [light["photograph"] for light in data["lights"]] == [
        f"{n}.jpg" for n in range(1, 6)
    ]
    assert {"intensity", "direction_error_degrees"} <= data["lights"][0].keys()
    listed = pf.read_lp(out / "lights.lp")
    assert degrees(listed.vectors, LAMPS).max() < 0.5
    assert pf.read_image(out / "calibration.png", "srgb").shape[1] > 1000


def test_several_circles_may_share_an_option(photographs, tmp_path, capsys):
    studio, folder = photographs
    numbers = [f"{n:.1f}" for circle in studio.circles("chrome") for n in circle]
    call = ["calibrate", str(folder), "-o", str(tmp_path / "a"), "--fov", "20"]
    assert main([*call, "--sphere", *numbers]) == 0
    assert "no matte sphere" in capsys.readouterr().out


@pytest.mark.parametrize(
    "options, message",
    [
        (["--sphere", "10", "20"], "sphere: expected x, y and radius, got 2 numbers"),
        (["--fov", "20", "--orthographic"], "fov: expected it or --orthographic"),
        (["--sphere", "1", "2", "30"], "lies wholly in the"),
        (["--ambient", "nowhere.jpg"], "nowhere.jpg: cannot be read"),
    ],
)
def test_errors_are_one_line_and_nothing_is_left(
    photographs, tmp_path, capsys, options, message
):
    _, folder = photographs
    out = tmp_path / "out"
    assert main(["calibrate", str(folder), "-o", str(out), *options]) == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
