"""Data sets as folders, and the command that makes them."""

import dataclasses
import json
import subprocess
import sys

import imagecodecs
import jax
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

import phongfit as pf
from data_synth import make_dataset, make_lights, write_dataset
from data_synth.__main__ import Options, main, make
from data_synth.sheet import caption, contact_sheet
from phongfit.cli import run
from phongfit.files.datasets import read_dataset
from tests.helpers import said

SMALL = ["--resolution", "16", "--lights", "2"]
FILES = {"001.png", "002.png", "scene.json", "truth.json", "contact_sheet.png"}


def _contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_the_command(tmp_path, capsys):
    out = tmp_path / "new" / "set"
    words = ["--material", "preset:brass", "--noise", "0.01"]
    assert run(main, [str(out), *SMALL, *words]) == 0
    printed = capsys.readouterr()
    assert str(out) in printed.out and printed.err == ""
    assert "2 × 16 × 16 pixels, 8-bit srgb" in printed.out
    assert {path.name for path in out.iterdir()} == FILES


@pytest.mark.extended
def test_in_a_process_of_its_own(tmp_path):
    """As a user starts it."""
    command = [sys.executable, "-m", "data_synth", str(tmp_path / "set"), "--bits", "7"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("error: --bits: expected one of 8, 16")


def test_same_seed_same_bytes(tmp_path, capsys):
    for name, seed in (("a", "5"), ("b", "5"), ("c", "6")):
        args = [str(tmp_path / name), *SMALL, "--noise", "0.05", "--seed", seed]
        assert run(main, args) == 0
    a, b, c = (_contents(tmp_path / name) for name in "abc")
    assert a == b and a["001.png"] != c["001.png"]
    assert capsys.readouterr().err == ""


def test_overwrite_replaces_data_sets_only(tmp_path, capsys):
    args = [str(tmp_path / "set"), *SMALL, "--overwrite"]
    assert run(main, [*args, "--lights", "3"]) == 0
    capsys.readouterr()
    assert run(main, args[:-1]) == 2
    assert "the folder is not empty" in capsys.readouterr().err
    assert run(main, args) == 0
    assert {path.name for path in (tmp_path / "set").iterdir()} == FILES
    (tmp_path / "set" / "notes.txt").write_text("mine")
    capsys.readouterr()
    assert run(main, args) == 2
    assert "it holds notes.txt" in capsys.readouterr().err
    assert (tmp_path / "set" / "notes.txt").read_text() == "mine"


def test_interrupted_it_leaves_nothing(tmp_path, monkeypatch):
    def stop(*args, **kwargs):
        raise KeyboardInterrupt

    # The last thing that is written.
    monkeypatch.setattr("data_synth.writing.contact_sheet", stop)
    assert run(main, [str(tmp_path / "set"), *SMALL]) == 130
    assert not list(tmp_path.iterdir())


def test_options_arrive(tmp_path):
    options = Options(
        tmp_path / "set",
        material="preset:gold",
        shininess=(20.0,),
        diffuse=(0.1, 0.2, 0.3),
        model="phong",
        lights=3,
        light_kind="point",
        images=1,
        intensity=(2.0,),
        ambient_light=(0.1, 0.2, 0.3),
        center=(1.0, 2.0, 3.0),
        radius=2.0,
        camera="perspective",
        resolution=10,
        bits=16,
        encoding="linear",
    )
    made = make(options)
    (scene,) = made.scenes
    gold, truth = pf.preset("gold"), made.truth
    assert truth is not None and truth.shininess == 20
    np.testing.assert_allclose(truth.diffuse, [0.1, 0.2, 0.3], rtol=1e-6)
    assert np.array_equal(truth.specular, gold.specular)
    assert isinstance(scene.specular_model, pf.Phong)
    assert [type(light) for light in scene.lights] == [pf.PointLight] * 3
    np.testing.assert_allclose(scene.ambient, [0.1, 0.2, 0.3], rtol=1e-6)
    assert isinstance(scene.camera, pf.PerspectiveCamera)
    assert made.film == pf.Film(encoding="linear", bits=16)
    # The ball is in the middle and fills most of the image.
    mask = np.asarray(pf.geometry.trace(scene.surface, scene.camera).mask)
    assert np.array_equal(mask, mask[::-1, ::-1]) and 0.5 < mask.mean() < 0.8


@pytest.mark.parametrize(
    "args, message",
    [
        (["--bits", "7"], "--bits: expected one of 8, 16, got '7'"),
        (["--bitz", "8"], "--bitz"),
        (["--diffuse", "a"], "--diffuse"),
        (["--diffuse", "1", "2"], "diffuse: expected 1 or 3"),
        (["--diffuse", "-1"], "diffuse: expected ... got -1"),
        (["--noise", "-1"], "noise: expected ... got -1.0"),
        (["--noise", "nan"], "noise: expected ... got nan"),
        (["--material", "gold"], "material: expected ... got 'gold'"),
        (["--material", "preset:gould"], "did you mean 'gold'?"),
        (["--radius", "0"], "radius: expected ... got 0"),
        (["--lights", "0"], "lights: expected ... got 0"),
        (["--images", "9"], "images: expected ... got 9"),
        (["--intensity", "-1"], "intensity: "),
        (["--ambient-light", "9"], "ambient_light: "),
        (["--resolution", "0"], "resolution: expected ... got 0"),
        (["--resolution", "100000"], "resolution: expected ... got 100000"),
        (["--seed", "-1"], "seed: expected ... got -1"),
    ],
)
def test_bad_options(tmp_path, capsys, args, message):
    assert run(main, [str(tmp_path / "set"), "--resolution", "8", *args]) == 2
    output = capsys.readouterr()
    assert output.err.startswith("error: ") and said(message, output.err)
    assert output.err.count("\n") == 1 and output.out == ""
    assert not list(tmp_path.iterdir())


def test_masks_and_float_images(tmp_path):
    camera = pf.OrthographicCamera(12, 10)
    made = make_dataset(
        pf.Material(0.5),
        key=jax.random.key(0),
        camera=camera,
        lights=make_lights(2),
        bits=None,
        encoding="linear",
    )
    mask = np.zeros((10, 12), bool)
    mask[3:6] = True
    made = dataclasses.replace(made, masks=(mask, ~mask))
    write_dataset(made, tmp_path / "set")
    read = read_dataset(tmp_path / "set")
    assert np.array_equal(read.masks, made.masks) and read.film == made.film
    np.testing.assert_allclose(read.images, made.images, rtol=1e-6)


def test_the_contact_sheet(tmp_path):
    made = make_dataset(
        pf.preset("brass"),
        key=jax.random.key(0),
        camera=pf.OrthographicCamera(16, 16),
        lights=make_lights(7, intensity=0.2),
        images=6,
    )
    write_dataset(made, tmp_path / "set", noise=0.0, seed=0)
    truth = json.loads((tmp_path / "set" / "truth.json").read_text())
    assert truth["material"]["diffuse"] == [0.780392, 0.568627, 0.113725]
    figure = contact_sheet(made, noise=0.01, seed=3)
    FigureCanvasAgg(figure).draw()
    words = " ".join(text.get_text() for text in figure.texts)
    assert "diffuse 0.78 0.569 0.114" in words and "noise 0.01" in words
    # Everything that is written lies on the paper.
    for text in [*figure.texts, *(axes.xaxis.label for axes in figure.axes)]:
        box = text.get_window_extent()
        assert figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1, text
        assert figure.bbox.y0 <= box.y0 and box.y1 <= figure.bbox.y1, text
    sheet = imagecodecs.png_decode((tmp_path / "set/contact_sheet.png").read_bytes())
    assert sheet.shape[0] > 300 and sheet.std() > 20


def test_captions():
    one, two, three = make_lights(3, "mixed")
    assert caption((one,)) == "directional, from (0.28, 0.28, 0.92)"
    assert caption((two, three)).startswith("1 point + 1 spot lights")
    assert caption((one, one)) == "2 directional lights"
    assert caption(()) == "no light"
