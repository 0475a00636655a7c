import dataclasses
import json
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest

from experiments.finding import Experiment, Finding, Table
from experiments.style import page
from phongfit.cli import run

ABOUT = """Question: how long is
a piece of string?

It is measured.
Twice.
"""


def experiment(**changes: Any) -> Experiment:
    def find(small: bool) -> Finding:
        fields: dict[str, Any] = dict(
            answer="Twice its [half].",
            numbers={"length": np.array([1.0, 2.0]), "small": small},
            figure=page(1.0),
            alt="a string",
            table=Table(("end", "cm"), (("left", "0"), ("right", "2"))),
        )
        return Finding(**(fields | changes))

    return Experiment("string", ABOUT, find)


def test_question_and_method():
    assert experiment().question == "How long is a piece of string?"
    assert experiment().method == "It is measured. Twice."


def test_the_command(tmp_path, capsys):
    picture, numbers = tmp_path / "new" / "string.png", tmp_path / "string.json"
    args = ["--small", "--picture", str(picture), "--json", str(numbers)]
    assert run(experiment().command(), args) == 0
    printed = capsys.readouterr().out
    assert "Twice its [half]." in printed and "right" in printed
    assert str(picture) in printed and picture.stat().st_size > 0
    assert json.loads(numbers.read_text()) == {"length": [1, 2], "small": True}


def test_help_says_what_is_asked(capsys):
    assert run(experiment().command(), ["--help"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "How long is a piece of string? It is measured. Twice." in printed
    assert "Where the figure goes" in printed


def test_what_should_hold_and_does_not(tmp_path, capsys):
    args = ["--picture", str(tmp_path / "string.png")]
    assert run(experiment(failed_checks=("it is too short",)).command(), args) == 1
    assert "! it is too short" in capsys.readouterr().out


def test_an_animation_beside_the_picture(tmp_path):
    frames = np.linspace(0, 1, 4)[:, None, None, None] * np.ones((4, 6, 8, 3))
    args = ["--picture", str(tmp_path / "string.png")]
    assert run(experiment(frames=frames).command(), args) == 0
    read = iio.imread(tmp_path / "string_animation.gif", plugin="pillow")
    assert read.shape == (4, 6, 8, 3)
    assert np.all(np.diff(read.mean(axis=(1, 2, 3))) > 0)
    assert [path.name for path in tmp_path.glob(".*")] == []


@pytest.mark.parametrize(
    "option, name, words",
    [
        ("--picture", "file/a.png", "is a file, expected a folder"),
        ("--picture", "file/new/a.png", "is a file, expected a folder"),
        ("--picture", "a.xyz", "got '.xyz'"),
        ("--picture", ".", "is a folder"),
        ("--json", "file/a.json", "is a file, expected a folder"),
        ("--json", "../" * 40, "is a folder"),
    ],
)
def test_what_cannot_be_written_is_told_first(tmp_path, capsys, option, name, words):
    (tmp_path / "file").touch()

    def never(small: bool) -> Finding:
        raise AssertionError("nothing is computed in vain")

    one = dataclasses.replace(experiment(), find=never)
    args = ["--picture", f"{tmp_path}/new/a.png", option, f"{tmp_path}/{name}"]
    assert run(one.command(), args) == 2
    told = capsys.readouterr().err
    assert words in told and told.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
