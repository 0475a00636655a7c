"""Nothing of the user's is lost: what was computed stays, and inputs are no outputs."""

import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from phongfit.cli import main
from phongfit.files.outputs import replacing_folder

RECORD = Path(__file__).parents[1] / "data" / "records" / "fit_version_1.json"
FIT = ["fit", "{data}", "-o", "{out}", "--report", "quick"]
MAPS = ["maps", "{data}", "-o", "{out}", "--unknowns", "diffuse"]


def _fill(args, data, out) -> list[str]:
    return [word.format(data=data, out=out) for word in args]


def test_two_runs_into_one_folder(brass, tmp_path, refused):
    out = tmp_path / "out"
    with replacing_folder(out) as folder:
        (folder / "mine.txt").write_text("mine")
        for args in (FIT, MAPS):
            err = refused(*_fill(args, brass, out))
            assert err == f"error: {out}: another run is writing there\n"
    assert os.listdir(out) == ["mine.txt"]


@pytest.mark.parametrize(
    "args, lost",
    [
        ("render {data} -o {data}/001.png", "001.png"),
        ("render {data} -o {data}/001_mask.png", "001_mask.png"),
        ("render {data}/scene.json -o {data}/link.png", "002.png"),
        (
            "predict {data} --material preset:gold --noise 0.01 "
            "--json {data}/scene.json",
            "scene.json",
        ),
        (
            "predict {data} --material {data}/truth.json --noise 0.1 "
            "--json {data}/truth.json",
            "truth.json",
        ),
        ("export {fit}/fit.json --to json -o {fit}/fit.json", "fit.json"),
        ("export {fit} --to json -o {fit}/fit.json", "fit.json"),
        ("export preset:gold --to gltf --scene {data}/scene.json -o {hard}.glb", ""),
    ],
)
def test_an_input_is_no_output(copy, tmp_path, refused, args, lost):
    fit = tmp_path / "fit"
    fit.mkdir()
    shutil.copy(RECORD, fit / "fit.json")
    scene = json.loads((copy / "scene.json").read_text())
    shutil.copy(copy / "001.png", copy / "001_mask.png")
    scene["images"][0]["mask"] = "001_mask.png"
    (copy / "scene.json").write_text(json.dumps(scene))
    (copy / "link.png").symlink_to(copy / "002.png")
    os.link(copy / "scene.json", tmp_path / "hard.glb")
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    words = args.format(data=copy, fit=fit, hard=tmp_path / "hard").split()
    err = refused(*words)
    assert re.match(r"error: \S+: is an input, expected another file", err)
    assert lost in err.replace("link.png", "002.png") and err.count("\n") == 1
    assert before == {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}


def test_a_terminal_that_knows_little(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    little = io.TextIOWrapper(io.BytesIO(), encoding="ascii", errors="strict")
    monkeypatch.setattr(sys, "stderr", little)
    assert main(["fit", "ρ.png", "-o", "out"]) == 2
    little.flush()
    assert b"\\u03c1.png: there is no such file" in little.buffer.getvalue()


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_told_to_end(brass, tmp_path, monkeypatch, capsys, name):
    number = getattr(signal, name)
    monkeypatch.setattr(
        "phongfit.commands.fit.fit", lambda *args, **kwargs: signal.raise_signal(number)
    )
    # Under nohup SIGHUP is ignored from the start, and the command leaves it so.
    before = signal.signal(number, signal.SIG_DFL)
    try:
        assert main(_fill(FIT, brass, tmp_path / "out")) == 128 + number
        assert capsys.readouterr().err == f"error: ended by {name}\n"
        assert not os.listdir(tmp_path)
        assert signal.getsignal(number) == signal.SIG_DFL
    finally:
        signal.signal(number, before)


@pytest.mark.extended
@pytest.mark.parametrize("args, words", [("", b""), ("['--version']", b"Interrupt")])
def test_an_interrupt_after_the_end_says_nothing(args, words):
    """Of the process that the command is; whoever calls it keeps what it had."""
    # A process in the background begins with this signal ignored.
    code = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    code += f"from phongfit.cli import main; main({args}); "
    code += "signal.raise_signal(signal.SIGINT)"
    command = [sys.executable, "-c", code, "--version"]
    done = subprocess.run(command, capture_output=True)
    assert done.stdout.startswith(b"phongfit ") and done.returncode == -signal.SIGINT
    assert words in done.stderr and bool(words) == bool(done.stderr)


def test_a_signal_that_is_ignored_stays_so(brass, tmp_path, monkeypatch, capsys):
    def hang_up(*args, **kwargs):
        signal.raise_signal(signal.SIGHUP)
        raise ValueError("went on")

    monkeypatch.setattr("phongfit.commands.fit.fit", hang_up)
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert main(_fill(FIT, brass, tmp_path / "out")) == 2
    finally:
        signal.signal(signal.SIGHUP, before)
    assert capsys.readouterr().err == "error: went on\n"
