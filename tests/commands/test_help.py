"""What help texts say can be typed as it stands."""

import re
import shlex
from pathlib import Path

import pytest
from PIL import Image

from phongfit import cli

MADE_ELSEWHERE = set(
    "ballPNG brackets coin dome.lp out/lights/lights.json photos".split()
)
"""Photographs that the examples speak of, and that whoever reads them has."""

CUP = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def examples(command: str) -> list[list[str]]:
    """The words behind `phongfit` of each example of a command; of all for none."""
    about = cli._load(command).__doc__ if command else cli.ABOUT
    lines = re.findall(r"^ +phongfit (.*)$", about or "", flags=re.MULTILINE)
    return [shlex.split(line) for line in lines]


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_examples_have_options_that_there_are(command):
    assert examples(command)
    for name, *words in [*examples(command), *examples("")[:-1]]:
        cli._parse(cli._load(name), words, f"phongfit {name}")


@pytest.mark.slow
def test_examples_run_in_an_empty_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Image.new("RGB", (400, 300), "gray").save("ball.jpg")
    Path("cup.obj").write_text(CUP)
    ran = []
    for command in ("", *cli.COMMANDS):
        for words in examples(command):
            if words in ran or "lab" in words or MADE_ELSEWHERE & set(words):
                continue
            ran.append(words)
            status = cli.main(words)
            assert status == 0, (words, capsys.readouterr().err)
    assert len(ran) > 12


def test_everything_is_in_the_overview(capsys):
    assert cli.main(["--help"]) == 0
    text = capsys.readouterr().out
    for word in (*cli.COMMANDS, "--version", "--completion", "--max-memory"):
        assert word in text


@pytest.mark.parametrize("shell", cli.SHELLS)
def test_completion(capsys, shell):
    assert cli.main(["--completion", shell]) == 0
    text = capsys.readouterr().out
    assert "calibrate" in text and "per-channel" in text and "soft_l1" in text
