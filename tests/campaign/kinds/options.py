"""Commands with options that are wrong, missing, doubled or in another place."""

import contextlib
import glob
import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import numpy as np

from phongfit.cli import COMMANDS
from phongfit.files.strict_json import parse_json
from tests.campaign.cases import Case, Kind, Wrong, command

STOCK = "options"
OPTION = re.compile(r"(?<![\w-])--[a-z][\w-]*")
SMALL = ["--unknowns", "diffuse", "--noise", "0.01"]

# What is run, and how it is right.
RIGHT: list[list[str]] = [
    ["synth", "out", "--resolution", "16", "--lights", "2", "--noise", "0.01"],
    ["render", "in", "-o", "out.png", "--material", "preset:gold", "--lights", "0"],
    ["fit", "in", *SMALL, "--report", "none", "-o", "out"],
    ["fit", "in/001.png", "--scene", "in/scene.json", "--report", "none", "-o", "out"],
    ["fit", "photos", "--sphere", "8", "8", "7", "--lights", "photos/lights.lp",
     "--encoding", "srgb", "--report", "none", "-o", "out"],
    ["maps", "in", *SMALL, "--known", "in/truth.json", "--no-pictures", "-o", "out"],
    ["relight", "maps", "--lights", "photos/lights.lp", "--no-shadows", "-o", "out"],
    ["view", "maps", "-o", "out.html", "--title", "x"],
    ["calibrate", "photos", "--sphere", "8", "8", "7", "--encoding", "srgb",
     "-o", "out"],
    ["response", "photos", "--exposures", "1", "2", "4", "-o", "out.json"],
    ["scene", "--size", "9", "9", "--mesh", "a.obj", "--light", "1", "1", "2",
     "-o", "out.json"],
    ["scene", "in/001.png", "--sphere", "8", "8", "7", "--encoding", "srgb",
     "-o", "out.json"],
    ["predict", "in", "--material", "preset:gold", "--noise", "0.01",
     "--json", "out.json"],
    ["export", "fit", "-o", "out.mtl"],
    ["export", "maps", "-o", "out.glb"],
    ["export", "preset:gold", "--to", "opengl", "--nearest", "-o", "out.h"],
    ["lab", "--port", "0", "--no-browser", "--resolution", "16"],
]  # fmt: skip
OUTPUTS = ("-o", "--out", "--json")
FOLDERS = {"in", "fit", "maps", "photos", "missing", "missing/x"}
IN_FOLDERS = {"in/scene.json", "photos/scene.json"}

VALUES = [
    "", " ", "0", "1", "-1", "2", "0.5", "-0.5", "1e-320", "1e-45", "1e39", "1e308",
    "1e999", "-1e999", "nan", "inf", "-inf", "0x10", "1_000", "٣", "1,5", "3j",
    "4294967296", "-9223372036854775809", "9" * 400, "x", "None", "True", "fit",
    "linear", "srgb", "preset:", "preset:gold", "preset:none", "in", "in/001.png",
    "in/scene.json", "in/truth.json", "maps", "fit/fit.json", "photos",
    "photos/lights.lp", "a.obj", "missing", "missing/x", ".", "..", "/", "/dev/null",
    "/dev/zero", "/proc/self/mem", "~", "*", "\x1b[31m", "\n", "a\nb", "é" * 300,
    "x" * 5000, "\ud800", "--", "-", "-o", "--help", "@in/scene.json", "%s{}$(ls)",
    "diffuse", "shininess=1:5", "shininess=5:1", "shininess=nan:5", "diffuse=0:1e999",
    "diffuse=", "=", "=1:2", "diffuse.red=0.5", "diffuse.red=nan", "diffuse=1e400",
    "diffuse.green=diffuse.red", "diffuse.red=diffuse.red", "diffuse.red=1e999*x",
    "diffuse.red=0.1:0", "diffuse.red=0.1:-1", "diffuse.red=0.5:0.1", "exposure",
    "scene.lights[0].direction", "scene.lights[99999999999].direction",
    "scene.lights[0].__class__", "scene.camera.width", "scene.", "ambient", "4G", "1K",
]  # fmt: skip
# Where an output may go: nowhere that a user could mean and we should not.
PLACES = [
    "out", "out.png", "out.json", "out.mtl", "out.jpg", "out.exr", "out.glb", "out.ply",
    "out/deep/er.json", "out.xyz", "out\x1b.png", "out\udcff.json", "out/", "out/..",
    "out." + "x" * 300, ".", "in", "fit", "", "/dev/null", "/dev/full",
    "/proc/out.json", "in/001.png/out.json", "in/scene.json",
]  # fmt: skip


def _changed(
    random: np.random.Generator, words: list[str], options: list[str]
) -> list[str]:
    """A command with one thing wrong."""
    words = list(words)
    at = int(random.integers(1, len(words)))
    match int(random.integers(9)):
        case 0 | 1 | 2:
            words[at] = str(random.choice(VALUES))
            if words[at - 1] in OUTPUTS:
                words[at] = str(random.choice(PLACES))
        case 3 | 4 | 5:
            option = str(random.choice(options))
            values = VALUES if option not in OUTPUTS else PLACES
            count = int(random.choice([0, 1, 1, 1, 3]))
            words += [option, *(str(v) for v in random.choice(values, count))]
        case 6:
            del words[at]
        case 7:
            words.insert(at, words[int(random.integers(1, len(words)))])
        case _:
            words[at] = words[at][:-1] + str(random.choice(["", "x", "=", "=x", "é"]))
    return words


def make(random: np.random.Generator, stock: Path) -> Case:
    known = json.loads((stock / f"{STOCK}.json").read_text())
    words = RIGHT[int(random.integers(len(RIGHT)))]
    for _ in range(int(random.choice([1, 1, 1, 2, 4]))):
        words = words[:1] + _changed(random, words, known[words[0]])[1:]
    # What follows the name of an output, by whichever way it got there.
    outs = {
        after if before in OUTPUTS else before.partition("=")[2]
        for before, after in zip(words, [*words[1:], ""], strict=True)
        if before.partition("=")[0] in OUTPUTS
    }
    kept = {str(Path(out)) for out in outs if out} - {".", "in", "fit"}
    # What these two are given may be a folder that they write into.
    named = {
        word for word in words[1:] if word in FOLDERS or re.fullmatch(r"\w+", word)
    }
    kept |= {"synth": named, "scene": IN_FOLDERS}.get(words[0], set())
    # And folders that are made for it.
    kept |= {str(above) for out in kept for above in Path(out).parents} - {".", "in"}

    def act(folder: Path) -> None:
        with contextlib.chdir(folder), _without_server():
            said = command(*words)
            if "--help" not in words and not said and words[0] != "lab":
                raise Wrong("nothing was said")
            for path in Path("out").rglob("*.json"):
                parse_json(path.read_text())
            if re.search(r"\b(nan|inf) ±|± nan\b", said):
                raise Wrong(f"numbers that are none: {said[:500]}")

    def arrange(folder: Path) -> None:
        shutil.copytree(stock / STOCK, folder, dirs_exist_ok=True)

    shown = " ".join(word[:40] for word in words)
    allowed = ("out*", *map(glob.escape, sorted(kept)))
    return Case(f"{shown!a}", arrange, act, allowed)


@contextlib.contextmanager
def _without_server() -> Iterator[None]:
    """The page is made ready, and ends at once."""
    with (
        mock.patch("uvicorn.Server.run"),
        mock.patch("phongfit.lab.session.Session.warm_up"),
        mock.patch("phongfit.commands.lab.leave_work_behind"),
        mock.patch("webbrowser.open"),
    ):
        yield


def prepare(stock: Path) -> None:
    """A data set, what was fitted to it, photographs of a ball."""
    import phongfit as pf

    folder = stock / STOCK
    data, photos = folder / "in", folder / "photos"
    options = ["--material", "preset:brass", "--resolution", "16", "--lights", "4"]
    command("synth", data, *options, "--noise", "0.01")
    truth = ["--known", data / "truth.json"]
    command("fit", data, *SMALL, "--report", "none", "-o", folder / "fit")
    command("maps", data, *SMALL, *truth, "--no-pictures", "-o", folder / "maps")
    photos.mkdir()
    for number in (1, 2, 3):
        shutil.copy(data / f"00{number}.png", photos)
    vectors = [(0, 0, 1), (0.5, 0, 1), (0, 0.5, 1)]
    pf.write_lp(photos / "lights.lp", ["001.png", "002.png", "003.png"], vectors)
    (folder / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (stock / f"{STOCK}.json").write_text(json.dumps(_known_options()))


def _known_options() -> dict[str, list[str]]:
    """What each command's help names."""
    return {
        name: sorted(set(OPTION.findall(command(name, "--help")))) for name in COMMANDS
    }


KIND = Kind(make, prepare, seconds=60.0, megabytes=2500.0, share=0.2)
