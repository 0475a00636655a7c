"""`phongfit`: its commands, their help, and how they end."""

import json
import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

import phongfit as pf
from phongfit.cli import COMMANDS, main
from phongfit.commands import synth
from phongfit.files.fits import read_fit_record
from tests.commands.conftest import interrupt
from tests.helpers import said


def test_help_of_all(capsys):
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    options = ("--version", "--completion", "--max-memory")
    assert all(name in text for name in (*COMMANDS, *options))
    assert "phongfit fit out/brass -o out/fit" in text and "PHONGFIT_CACHE" in text
    assert main(["--version"]) == 0
    assert re.fullmatch(r"phongfit \d+\.\d+\.\d+\n", capsys.readouterr().out)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_reads_like_a_manual(command, capsys):
    assert main([command, "--help"]) == 0
    text = capsys.readouterr().out
    assert text.startswith(f"usage: phongfit {command} ")
    assert "\nFor example:\n" in text and f"\n  phongfit {command} " in text
    # A default of None says nothing to a user.
    assert "None" not in text
    # A line that ends where a sentence goes on was broken by the source, not the width.
    assert not re.search(r"│ +[a-z]\S* {50,}│\n│ +[a-z]", text)


def test_help_needs_no_jax():
    """It would take a second."""
    program = (
        "import sys; from phongfit.cli import main; status = main(['--help']); "
        "assert 'jax' not in sys.modules; raise SystemExit(status)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True)
    assert done.returncode == 0, done.stderr


def test_synth_without_its_package(tmp_path, monkeypatch, refused):
    monkeypatch.setattr(synth, "PACKAGE", "data_synth_that_is_absent")
    monkeypatch.setattr(synth, "main", synth.command())
    assert "data_synth_that_is_absent is not installed" in refused("synth")


@pytest.mark.parametrize(
    "place, args",
    [
        ("phongfit.commands.fit.fit", ["fit", "{data}", "-o", "{out}"]),
        ("phongfit.commands.render.render", ["render", "{data}", "-o", "{out}.png"]),
        (
            "phongfit.files.gltf._File.glb",
            ["export", "preset:gold", "--to", "gltf", "-o", "{out}.glb"],
        ),
    ],
)
def test_an_interrupt_leaves_nothing(brass, tmp_path, monkeypatch, capsys, place, args):
    monkeypatch.setattr(place, interrupt)
    filled = [word.format(data=brass, out=tmp_path / "out") for word in args]
    assert main(filled) == 130
    assert capsys.readouterr().err == "error: interrupted\n"
    assert not list(tmp_path.iterdir())


class _Deaf:
    """Whatever it raises is forgotten, as in a callback of the collector."""

    def __del__(self):
        raise KeyboardInterrupt


def test_an_interrupt_is_heeded_wherever_it_lands(brass, monkeypatch, capsys, tmp_path):
    ended = []

    def slow(*args, **kwargs):
        _Deaf()
        # An interrupt is heard between two of these.
        for _ in range(2000):
            time.sleep(0.01)
        ended.append(True)

    monkeypatch.setattr("phongfit.commands.fit.fit", slow)
    # A shell starts what it runs in the background deaf to interrupts.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert main(["fit", str(brass), "-o", str(tmp_path / "out")]) == 130
    finally:
        signal.signal(signal.SIGINT, before)
    assert capsys.readouterr().err.endswith("error: interrupted\n")
    assert not ended, "it was the interrupt that ended it"


def test_render(brass, tmp_path, capsys, refused):
    scene, truth = pf.load_scene(brass), pf.read_dataset(brass).truth
    assert truth is not None
    shown = np.asarray(pf.render(scene, truth))
    out = tmp_path / "a.png"
    assert main(["render", str(brass), "-o", str(out)]) == 0
    assert "16 × 16 pixels, srgb; " in capsys.readouterr().out
    np.testing.assert_allclose(pf.read_image(out, "srgb"), shown, atol=0.005)
    # One light, another material, and all the light there is.
    bright = tmp_path / "bright.mtl"
    pf.write_mtl(bright, {"bright": pf.Material(1.0, 1.0, 5.0, 1.0)})
    out = tmp_path / "a.exr"
    args = ["--material", str(bright), "--lights", "1", "-o", str(out)]
    assert main(["render", f"{brass}/scene.json", *args]) == 0
    second = pf.Scene(scene.surface, scene.camera, scene.lights[1], scene.ambient)
    light = pf.render(second, pf.read_mtl(bright)["bright"], film=pf.Film(clamp=False))
    assert np.max(light) > 1
    np.testing.assert_allclose(pf.read_image(out, "linear"), light, rtol=1e-5)
    assert "lights: expected different numbers from 0 to 2, got [3]" in refused(
        "render", brass, "--lights", "3", "-o", out
    )


@pytest.mark.parametrize(
    "options, words",
    [
        (["-o", "{}/a.bmp"], "expected ... got suffix '.bmp'"),
        (["-o", "{}/a.png", "--bits", "32"], "bits: expected 8 or 16, got 32"),
        (["-o", "{}/a.exr", "--encoding", "srgb"], "expected encoding 'linear', as"),
    ],
)
def test_where_an_image_goes_is_looked_at_first(
    brass, tmp_path, monkeypatch, refused, options, words
):
    monkeypatch.setattr("phongfit.commands.render.render", interrupt)
    filled = [word.format(tmp_path) for word in options]
    assert said(words, refused("render", brass, *filled))


def test_predict(brass, tmp_path, capsys, refused):
    args = ["predict", str(brass), "--material", "preset:brass", "--noise", "0.01"]
    fixed = ["--fixed", "shininess=30", "--json", f"{tmp_path}/a.json"]
    assert main([*args, *fixed]) == 0
    assert "diffuse.red" in capsys.readouterr().out
    data = pf.read_dataset(brass)
    expected = pf.predict_errors(
        data.scenes, pf.preset("brass"), 0.01, film=data.film, fixed={"shininess": 30}
    )
    numbers = json.loads((tmp_path / "a.json").read_text())
    assert tuple(numbers["labels"]) == expected.labels
    np.testing.assert_allclose(numbers["errors"], expected.errors, rtol=1e-6)
    assert "noise" in refused(*args[:-1], "-1")


@pytest.mark.extended
def test_a_fit_in_a_process_of_its_own(brass, tmp_path):
    """As a user starts it, its output not a terminal: no bar, no colour, no traces."""
    cache, out = tmp_path / "cache", tmp_path / "out"
    command = [sys.executable, "-m", "phongfit", "fit", str(brass), "-o", str(out)]
    environment = {k: v for k, v in os.environ.items() if "COMPILATION_CACHE" not in k}
    done = subprocess.run(
        [*command, "--report", "none"],
        env=environment | {"JAX_PLATFORMS": "cpu", "PHONGFIT_CACHE": str(cache)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == "" and "\x1b" not in done.stdout and "\r" not in done.stdout
    assert "diffuse.red" in done.stdout and str(out) in done.stdout
    assert read_fit_record(out / "fit.json").converged
    assert sum(path.name.startswith("jit_") for path in cache.iterdir()) > 10
