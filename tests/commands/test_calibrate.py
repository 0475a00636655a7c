"""`phongfit calibrate`, from a folder of photographs to files and a picture."""

import json

import numpy as np
import pytest
from PIL import Image

import phongfit as pf
from phongfit.cli import main
from phongfit.files.images import to_levels
from phongfit.rendering.film import decode
from tests.calibration.studio import Studio, degrees, directions
from tests.files.test_photographs import exif
from tests.files.test_profiles import FROM_P3, P3, rgb_profile
from tests.files.test_raw import BLACK, WHITE, dng

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


def save_sideways(path, levels, setting):
    """As a camera does that was held upright: lying, with a note to turn it."""
    time, f_number, iso = setting
    note = exif(6, time=time, f_number=f_number, iso=iso)
    lying = Image.fromarray(levels).transpose(Image.Transpose.ROTATE_90)
    lying.save(path, exif=note, quality=95)


def save_in_display_p3(path, levels, setting):
    time, f_number, iso = setting
    note = exif(time=time, f_number=f_number, iso=iso)
    light = np.clip(decode(levels / 255.0, "srgb") @ np.linalg.inv(FROM_P3).T, 0, 1)
    numbers = np.round(light ** (1 / 2.2) * 255).astype(np.uint8)
    Image.fromarray(numbers).save(path, exif=note, icc_profile=rgb_profile(P3, 2.2))


def check_lamps(words, out, strengths=(1,) * 5):
    """The command finds the studio's lamps: where they are, and their colour."""
    assert main([*words, "-o", f"{out}"]) == 0
    found = pf.load_calibration(out)
    assert degrees([lamp.direction for lamp in found.lamps], LAMPS).max() < 0.5
    strength = found.lamps[1].intensity
    assert strength / strength[0] == pytest.approx([1, 0.9, 0.8], rel=0.03)
    ratio = [lamp.intensity.mean() for lamp in found.lamps] / np.array(strengths)
    assert np.abs(ratio / ratio.mean() - 1).max() < 0.015


def let_in(setting):
    time, f_number, iso = setting
    return time * iso / f_number**2


SETTINGS = [(1 / 60, 8, 100), (1 / 120, 8, 100), (1 / 60, 8, 25)]
SETTINGS += [(1 / 120, 4, 25), (1 / 60, 4, 50)]
SHARES = np.array([let_in(setting) / let_in(SETTINGS[0]) for setting in SETTINGS])
STRENGTHS = np.array([1.0, 0.9, 1.2, 1.1, 0.4])


def exposed(folder, save):
    """Lamps of unequal strength, each as time, f-number and ISO let in."""
    folder.mkdir()
    studio = Studio()
    for number, lamp in enumerate(LAMPS):
        strength = STRENGTHS[number] * SHARES[number]
        light = studio.photograph(lamp, strength, seed=number)
        save(folder, number, to_levels(light, "srgb", 8))
    options = ["--encoding", "srgb", "--fov", "20"]
    return ["calibrate", f"{folder}", *options, *circles(studio)]


def test_photographs_each_of_which_is_kept_otherwise(tmp_path, capsys):
    """In all formats, sideways, of other primaries, and of exposures that differ."""

    def save(folder, number, levels):
        if number == 1:
            return save_sideways(folder / "2.jpg", levels, SETTINGS[1])
        if number == 3:
            return save_in_display_p3(folder / "4.png", levels, SETTINGS[3])
        time, f_number, iso = SETTINGS[number]
        path = folder / f"{number + 1}.{('png', '', 'tif', '', 'jpg')[number]}"
        note = exif(time=time, f_number=f_number, iso=iso)
        Image.fromarray(levels).save(path, exif=note, quality=95)

    words = exposed(tmp_path / "photos", save)
    check_lamps(words, tmp_path / "out", STRENGTHS)
    said = " ".join(capsys.readouterr().out.split())
    assert "1.png 1/60 s, f/8, ISO 100, 2.jpg 1/120 s, f/8, ISO 100" in said
    assert "brought to common light, to some 5 %" in said


@pytest.mark.extended
def test_a_folder_of_raw_photographs(tmp_path):
    pytest.importorskip("rawpy", reason="rawpy is not installed here")
    studio, folder = Studio(), tmp_path / "photos"
    folder.mkdir()
    for number, lamp in enumerate(LAMPS, 1):
        light = studio.photograph(lamp, seed=number)
        sensor = BLACK + light * (0.5, 1, 0.8) * (WHITE - BLACK)
        mosaic = sensor[..., 1].copy()
        mosaic[::2, ::2] = sensor[::2, ::2, 0]
        mosaic[1::2, 1::2] = sensor[1::2, 1::2, 2]
        (folder / f"{number}.dng").write_bytes(dng(np.round(mosaic)))
    words = ["calibrate", f"{folder}", "--encoding", "linear", "--fov", "20"]
    check_lamps([*words, *circles(studio)], tmp_path / "out")


def bad_folder(folder, kind):
    """A folder with something wrong, and what is to be said of it."""
    studio = Studio()
    images = [studio.photograph(lamp, seed=n) for n, lamp in enumerate(LAMPS)]
    names = [f"{number}.png" for number in range(1, 6)]
    match kind:
        case "one photograph":
            images = images[:1]
            words = "expected several photographs, each under its own lamp, got one"
        case "a list of others":
            pf.write_lp(folder / "a.lp", ["7.png", *names[1:]], LAMPS)
            words = "1 of the 5 photographs in the list of lights are missing, 7.png"
        case _:
            lines = [f"{name} 0 0 0" for name in names]
            (folder / "a.lp").write_text("\n".join(["5", *lines]))
            words = "a.lp: line 2: 1.png: expected a vector to the lamp, got zeros"
    for name, image in zip(names, images, strict=False):
        pf.write_image(folder / name, image, "srgb")
    return words


@pytest.mark.parametrize(
    "kind", ["one photograph", "a list of others", "a lamp of zeros"]
)
def test_folders_that_are_no_capture(tmp_path, refused, kind):
    folder = tmp_path / "photos"
    folder.mkdir()
    words = bad_folder(folder, kind)
    out = tmp_path / "out"
    said = refused("calibrate", folder, "--encoding", "srgb", "-o", out)
    assert words in said and said.count("error: ") == 1 and not out.exists()


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
    photographs, tmp_path, refused, options, message
):
    _, folder = photographs
    out = tmp_path / "out"
    assert message in refused("calibrate", folder, "-o", out, *options)
    assert list(tmp_path.iterdir()) == []
