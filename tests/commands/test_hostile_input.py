"""Broken, hostile and unlucky: one line, status 2, and nothing is left behind."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.commands.conftest import full_disk
from tests.helpers import png_promising, said

COMMANDS: dict[str, Callable[[Path, Path], list[str]]] = {
    "fit": lambda data, out: ["fit", f"{data}", "--report", "none", "-o", f"{out}"],
    "one": lambda data, out: [
        "fit", f"{data}/001.png", "--scene", f"{data}/scene.json", "-o", f"{out}",
    ],
    "maps": lambda data, out: ["maps", f"{data}", "--no-pictures", "-o", f"{out}"],
    "render": lambda data, out: ["render", f"{data}", "-o", f"{out}.png"],
    "predict": lambda data, out: [
        "predict", f"{data}", "--material", "preset:gold", "--noise", "0.01",
        "--json", f"{out}",
    ],
    "export": lambda data, out: [
        "export", "preset:gold", "--to", "gltf", "--scene", f"{data}/scene.json",
        "-o", f"{out}.glb",
    ],
}  # fmt: skip
"""A command that reads a data set and writes to `out`."""


def _edit(folder: Path, **changes: object) -> None:
    path = folder / "scene.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def _link(folder: Path, name: str) -> None:
    """A link in place of a file that leads to one outside of the folder."""
    (folder.parent / "secret.png").write_bytes((folder / name).read_bytes())
    (folder / name).unlink()
    (folder / name).symlink_to(folder.parent / "secret.png")


def _truncate(path: Path, size: int) -> None:
    path.write_bytes(path.read_bytes()[:size])


Damage = Callable[[Path], object]

# What else may be broken of them, and the words for it: tests/files.
DAMAGES: dict[str, tuple[Damage, str]] = {
    "a cut image": (lambda d: _truncate(d / "001.png", 300), "001.png: is broken"),
    "a bomb": (
        lambda d: (d / "001.png").write_bytes(png_promising(100_000, 100_000)),
        "got 100000 × 100000 pixels",
    ),
    "missing": (lambda d: (d / "001.png").unlink(), "001.png"),
    "a pipe": (
        lambda d: ((d / "001.png").unlink(), os.mkfifo(d / "001.png")),
        "001.png: is not a file",
    ),
    "a cut scene": (lambda d: _truncate(d / "scene.json", 200), "json: is no JSON"),
    "binary": (lambda d: (d / "scene.json").write_bytes(b"\xff"), "is no text"),
    "huge camera": (
        lambda d: _edit(d, camera={"kind": "orthographic", "width": 10**6,
                                   "height": 10**6}),
        "scene.json: camera.width: expected ... got 1000000 × 1000000 pixels",
    ),
    "an unknown key": (lambda d: _edit(d, shadow=1), "did you mean 'shadows'?"),
    "absolute": (
        lambda d: _edit(d, surface={"kind": "mesh_file", "file": "/etc/passwd"}),
        "scene.json: surface.file: expected ... got '/etc/passwd'",
    ),
    "a name": (
        lambda d: _edit(d, images=[{"file": "../secret.png"}]),
        "images[0]: expected the name of a file in this folder ... got '../secret.png'",
    ),
    "a mask": (
        lambda d: _edit(d, images=[{"file": "001.png", "mask": "/secret.png"}]),
        "images[0]: expected ... got '/secret.png'",
    ),
    "a link": (lambda d: _link(d, "002.png"), "'002.png': is a link that leads out"),
    "a linked scene": (lambda d: _link(d, "scene.json"), "'scene.json': is a link"),
}  # fmt: skip


def _tree(folder: Path) -> dict[str, object]:
    return {
        str(path.relative_to(folder)): (path.lstat().st_mtime_ns, path.is_dir())
        for path in folder.rglob("*")
    }


def _check(folder: Path, args: list[str], words: str, refused) -> None:
    """One line, status 2, and all below `folder` is what it was."""
    before = _tree(folder)
    told = refused(*args)
    assert said(words, told), told
    assert _tree(folder) == before


# All commands read images by the same function, and scenes.
CASES = [("fit", damage) for damage in DAMAGES]
CASES += [(command, "a cut image") for command in ("one", "maps")]
CASES += [(command, "an unknown key") for command in COMMANDS if command != "fit"]
CASES += [("maps", damage) for damage in ("a name", "a mask", "a link")]


@pytest.mark.parametrize("command, damage", CASES)
def test_damaged_data_sets(copy, tmp_path, refused, command, damage):
    harm, words = DAMAGES[damage]
    harm(copy)
    _check(tmp_path, COMMANDS[command](copy, tmp_path / "out"), words, refused)


@pytest.mark.parametrize("command", COMMANDS)
def test_an_output_that_is_in_the_way(brass, tmp_path, refused, command):
    args = COMMANDS[command](brass, tmp_path / "out")
    out = Path(args[-1])
    if command in ("fit", "one", "maps"):
        out.write_text("a file")
        _check(tmp_path, args, f"{out}: is a file, expected a folder", refused)
        out.unlink()
        out.mkdir()
        (out / "notes.txt").write_text("mine")
        _check(tmp_path, args, f"{out}: ", refused)
    else:
        out.mkdir()
        _check(
            tmp_path, args, f"{out}: is a folder, expected the name of a file", refused
        )


@pytest.mark.parametrize("command", COMMANDS)
def test_no_folder_and_no_rights(brass, tmp_path, refused, monkeypatch, command):
    args = COMMANDS[command](brass, brass / "scene.json" / "out")
    _check(tmp_path, args, "is a file, expected a folder", refused)
    # Who is root may write anywhere, so that rights are denied by hand.
    monkeypatch.setattr(os, "access", lambda *args, **kwargs: False)
    args = COMMANDS[command](brass, tmp_path / "out")
    _check(tmp_path, args, f"the folder {tmp_path} may not be written to", refused)


@pytest.mark.parametrize("command", COMMANDS)
def test_files_that_may_not_be_read(brass, tmp_path, refused, monkeypatch, command):
    def deny(path):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "read_bytes", deny)
    args = COMMANDS[command](brass, tmp_path / "out")
    _check(tmp_path, args, "cannot be read: Permission denied", refused)


@pytest.mark.parametrize("command", ["render", "float", "predict", "export"])
def test_a_full_disk(brass, tmp_path, refused, command):
    if command == "float":
        args = ["render", str(brass), "-o", str(tmp_path / "out.exr")]
    else:
        args = COMMANDS[command](brass, tmp_path / "out")
    out = Path(args[-1])
    if out.suffix:
        out.write_text("old")
    before = _tree(tmp_path)
    with full_disk(200):
        err = refused(*args)
    assert err.startswith(f"error: {out}: cannot be written: "), err
    assert _tree(tmp_path) == before
