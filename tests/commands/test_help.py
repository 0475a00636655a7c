"""What help texts say can be typed as it stands."""

import re
import shlex
import webbrowser
from pathlib import Path

import numpy as np
import pytest
import zarr

import phongfit as pf
from phongfit import cli
from phongfit.commands import lab
from phongfit.files.schema import ImageRecord
from tests.calibration.studio import Ball, Studio, directions
from tests.calibration.test_response import EXPOSURES, patches
from tests.fitting.texels.scenes import scenes

CUP = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
LAMPS = directions(4)
WIDTH, HEIGHT, FOV = 960, 720, 14.0
SPHERES = {(179, 565, 88): "chrome", (781, 565, 88): "chrome", (179, 155, 81): "matte"}
"""Where the examples say that they are, in pixels."""


def examples(command: str) -> list[list[str]]:
    """The words behind `phongfit` of each example of a command; of all for none."""
    about = cli._load(command).__doc__ if command else cli.ABOUT
    lines = re.findall(r"^ +phongfit (.*)$", about or "", flags=re.MULTILINE)
    return [shlex.split(line) for line in lines]


@pytest.mark.parametrize("command", ["", *cli.COMMANDS])
def test_examples_have_options_that_there_are(command):
    assert examples(command)
    for name, *words in examples(command):
        if words != ["--help"]:
            cli._parse(cli._load(name), words, f"phongfit {name}")


def capture(folder: Path) -> list[str]:
    """Photographs of chrome and matte spheres under near lamps; gives their names."""
    scale = HEIGHT / 2 / np.tan(np.radians(FOV / 2)) / 10
    balls = [
        Ball(kind, ((x - WIDTH / 2) / scale, (HEIGHT / 2 - y) / scale, -10), r / scale)
        for (x, y, r), kind in SPHERES.items()
    ]
    studio = Studio(WIDTH // 2, HEIGHT // 2, FOV, tuple(balls))
    folder.mkdir()
    names = []
    for number, towards in enumerate(LAMPS, 1):
        lamp = 8 * towards + [0, 0, -10]
        image = studio.photograph(lamp, 0.9, near=True, noise=0, seed=number)
        pf.write_image(
            folder / f"{number}.jpg", np.kron(image, np.ones((2, 2, 1))), "srgb"
        )
        names.append(f"{number}.jpg")
    return names


def dome(folder: Path) -> None:
    """Photographs of a hill under lamps that a list names."""
    camera = pf.OrthographicCamera(24, 24)
    lights = [pf.DirectionalLight(one, 0.9) for one in directions(8)]
    folder.mkdir()
    names = [f"{number}.jpg" for number in range(len(lights))]
    for name, light in zip(names, lights, strict=True):
        scene = pf.Scene(pf.Sphere(), camera, light)
        image = pf.render(scene, pf.Material(0.5, 0.3, 20.0, 0.0))
        pf.write_image(folder / name, image, "srgb")
    pf.write_lp(folder / "dome.lp", names, directions(8))
    images = np.stack([pf.read_image(folder / name, "srgb") for name in names])
    zarr.create_array(folder / "stack.zarr", data=images)


def textured(folder: Path) -> None:
    """A data set of a plate with uv."""
    scene = scenes()[0]
    folder.mkdir()
    pf.write_image(folder / "1.png", pf.render(scene, pf.Material(0.5)), "srgb")
    film, images = pf.Film(encoding="srgb", bits=8), [ImageRecord(file="1.png")]
    pf.save_scene(folder, scene, film=film, images=images)


def readers_own() -> None:
    """What the examples speak of and no command makes: whoever reads them has it."""
    Path("cup.obj").write_text(CUP)
    names = capture(Path("photos"))
    Path("ball.jpg").write_bytes(Path("photos/1.jpg").read_bytes())
    dome(Path("coin"))
    textured(Path("cup"))
    for name in ("dome.lp", "cup.lp"):
        pf.write_lp(name, names, LAMPS)
    Path("brackets").mkdir()
    for number, exposure in enumerate(EXPOSURES, 1):
        pf.write_image(
            f"brackets/{number}.jpg", np.clip(exposure * patches(), 0, 1), "srgb"
        )
    sparse = Path("sparse/0")
    sparse.mkdir(parents=True)
    (sparse / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} 900 900 480 360\n")
    lines = [f"{k} 1 0 0 0 0 0 5 1 {name}\n\n" for k, name in enumerate(names, 1)]
    (sparse / "images.txt").write_text("".join(lines))


@pytest.mark.slow
def test_examples_run_in_an_empty_folder(tmp_path, monkeypatch, capsys):
    """All of them, command after command, as `phongfit --help` lists them."""
    uvicorn = pytest.importorskip("uvicorn")

    def stop(server, sockets):
        raise KeyboardInterrupt

    monkeypatch.setattr(uvicorn.Server, "run", stop)
    monkeypatch.setattr(webbrowser, "open", lambda url: True)
    monkeypatch.setattr(lab, "leave_work_behind", lambda: None)
    monkeypatch.chdir(tmp_path)
    readers_own()
    ran = []
    for command in ("", *cli.COMMANDS):
        for words in examples(command):
            if words not in ran:
                ran.append(words)
                status = cli.main(words)
                assert not status, (words, capsys.readouterr().err)
    assert {words[0] for words in ran} == set(cli.COMMANDS)


@pytest.mark.parametrize("shell", cli.SHELLS)
def test_completion(capsys, shell):
    assert cli.main(["--completion", shell]) == 0
    text = capsys.readouterr().out
    assert "calibrate" in text and "per-channel" in text and "soft_l1" in text
