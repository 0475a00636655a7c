"""Agreement with OpenGL (Mesa) and POV-Ray, by images of theirs."""

import json
import shutil

import numpy as np
import pytest

from experiments.conformance import Agreement, compare, main
from experiments.references import REFERENCES, find_references, read_reference
from phongfit.cli import run
from tests.helpers import near

PATHS = sorted(REFERENCES.glob("*/*.json"))
FLAT = REFERENCES / "opengl" / "scene11.json"


@pytest.mark.extended
@pytest.mark.parametrize("path", PATHS, ids=lambda p: f"{p.parent.name}/{p.stem}")
def test_agreement(path):
    agreement = compare(read_reference(path))
    assert agreement.agrees, agreement
    assert (agreement.vertex_colors is None) == (path.parent.name == "povray")


@pytest.mark.extended
def test_by_default_those_that_come_with_the_project(capsys):
    assert run(main, []) == 0
    assert f"{len(PATHS)} of {len(PATHS)} scenes agree" in capsys.readouterr().out


@pytest.fixture
def folder(tmp_path):
    for suffix in ("json", "npz"):
        shutil.copy(FLAT.with_suffix(f".{suffix}"), tmp_path / f"scene.{suffix}")
    return tmp_path


FOG = {"GL_FOG_MODE": "GL_EXP", "GL_FOG_DENSITY": 1e-3}


def change(folder, **changes):
    """Write the scene with other arrays or other parameters."""
    path = folder / "scene.npz"
    with np.load(path) as file:
        arrays = dict(file)
    said = json.loads((folder / "scene.json").read_text())
    for name, new in changes.items():
        if name in arrays:
            arrays[name] = new(arrays[name])
        elif new is None:
            del said[name]
        else:
            said[name] = new
    np.savez(path, **arrays)
    (folder / "scene.json").write_text(json.dumps(said))


def test_the_command(folder, capsys):
    numbers = folder / "numbers.json"
    out = folder / "out"
    out.mkdir()
    assert run(main, [str(folder), "--json", str(out / numbers.name)]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].split() == [
        "scene",
        "vertex",
        "median",
        "q",
        "99.9",
        "within",
        "bound",
        "coverage",
    ]
    assert printed[1].startswith(str(folder / "scene")) and "agrees" in printed[1]
    assert printed[-1] == "1 of 1 scenes agree"
    written = json.loads((out / numbers.name).read_text())
    assert written["agree"] is True
    assert set(Agreement._fields) < set(written["scenes"][0])


@pytest.mark.parametrize(
    "changes",
    [
        dict(image=lambda image: image + 2e-4),
        dict(vertex_colors=lambda colors: colors + 3e-5),
        dict(depth=lambda depth: np.where(np.arange(256) < 140, 1, depth)),
        dict(up=[0.2, 1.0, 0.0]),
        pytest.param(dict(shade_model="GL_SMOOTH"), marks=pytest.mark.extended),
        pytest.param(dict(fog=FOG), marks=pytest.mark.extended),
    ],
)
def test_a_scene_that_falls_short(folder, capsys, changes):
    change(folder, **changes)
    assert run(main, [str(folder)]) == 1
    printed = capsys.readouterr().out
    assert "FALLS SHORT" in printed and "0 of 1 scenes agree" in printed


@pytest.mark.parametrize(
    "changes, said",
    [
        (dict(eye=None), "'eye' is missing"),
        (dict(lights=[{"GL_COLOUR": 1}]), "light: it has no GL_COLOUR"),
        (
            dict(
                projection=dict(kind="orthographic", left=-1, right=2, bottom=-1, top=1)
            ),
            "projection: expected a centred one, got one off the axis",
        ),
        (dict(width=128), "expected shape (256, 128, 3), got"),
    ],
)
def test_a_scene_that_cannot_be_read(folder, capsys, changes, said):
    change(folder, **changes)
    assert run(main, [str(folder)]) == 2
    assert said in capsys.readouterr().err


def test_files_that_are_not_there(tmp_path, folder, capsys):
    empty = tmp_path / "empty"
    empty.mkdir()
    assert run(main, [str(empty)]) == 2
    assert "no NAME.json" in capsys.readouterr().err
    (folder / "scene.npz").unlink()
    assert run(main, [str(folder)]) == 2
    assert "scene.npz" in capsys.readouterr().err


def test_what_references_hold():
    assert [path.stem for path in find_references(REFERENCES / "povray")] == [
        "scene00",
        "scene01",
    ]
    reference = read_reference(REFERENCES / "povray" / "scene01.json")
    assert reference.scene.shadows and len(reference.scene.lights) == 2
    assert reference.material.diffuse.shape == (4, 3)
    assert reference.scene.surface.materials == 4
    near(reference.material.shininess[0, 0], 118.8105653, 1e-6)
