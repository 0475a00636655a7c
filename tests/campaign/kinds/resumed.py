"""Maps that were begun, or finished, and damaged since: never a wrong map."""

import contextlib
import functools
import json
import shutil
from pathlib import Path
from unittest import mock

import numpy as np

from phongfit.commands.maps import TILES
from phongfit.files.outputs import WORK
from phongfit.maps.folder import ARRAYS_FILE, NORMALS_FILE, RECORD_FILE, load_folder
from tests.campaign.cases import Case, Kind, Refused, Wrong, command
from tests.campaign.damage import damaged
from tests.campaign.kinds.records import VALUES, changed

STOCK = "resumed"
COMMAND = ["maps", "in", "--unknowns", "diffuse", "--noise", "0.01",
           "--known", "in/truth.json", "--tile-pixels", "512",
           "--no-pictures"]  # fmt: skip
FINISHED = (RECORD_FILE, ARRAYS_FILE, NORMALS_FILE)


@functools.cache
def _whole(stock: Path) -> dict[str, np.ndarray]:
    """What the maps are."""
    return _arrays(stock / STOCK / "maps")


def _arrays(folder: Path) -> dict[str, np.ndarray]:
    with np.load(folder / ARRAYS_FILE, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays}


def _check_same(found: dict[str, np.ndarray], wanted: dict[str, np.ndarray]) -> None:
    if found.keys() != wanted.keys():
        raise Wrong("other maps")
    for name, array in wanted.items():
        if found[name].tobytes() != array.tobytes():
            raise Wrong(f"other numbers in {name}")


def _harm(random: np.random.Generator, folder: Path) -> None:
    """Something happens to the tiles, or to what lies beside them."""
    tiles = [path for path in sorted((folder / TILES).rglob("*")) if path.is_file()]
    path = tiles[int(random.integers(len(tiles)))]
    other = tiles[int(random.integers(len(tiles)))]
    match int(random.integers(9)):
        case 0 | 1:
            path.write_bytes(damaged(random, path.read_bytes())[1])
        case 2:
            path.write_bytes(other.read_bytes())
        case 3:
            path.unlink()
        case 4:
            path.unlink()
            path.mkdir()
        case 5:
            if other != path:
                path.unlink()
                path.symlink_to(other)
        case 6:
            path = folder / TILES / "zarr.json"
            if path.is_file():
                path.write_bytes(_changed(random, path.read_bytes()))
        case 7:
            path = folder / TILES / str(random.choice(["c", "x", WORK]))
            path.write_bytes(other.read_bytes())
        case _:
            name = str(random.choice([WORK, RECORD_FILE, "x", "flags.png"]))
            (folder / name).write_text(str(random.choice(VALUES[:30])))


def _changed(random: np.random.Generator, data: bytes) -> bytes:
    """A record with another value; one that is none any more, with more damage."""
    try:
        return changed(random, json.loads(data))[1]
    except ValueError:
        return damaged(random, data)[1]


def _of_tiles(random: np.random.Generator, stock: Path) -> Case:
    """A run that goes on from tiles that were damaged."""
    seed, times = int(random.integers(2**32)), int(random.choice([1, 1, 2, 4]))
    overwrite = ["--overwrite"] if random.random() < 0.3 else []

    def arrange(folder: Path) -> None:
        shutil.copytree(stock / STOCK / "in", folder / "in")
        shutil.copytree(stock / STOCK / "begun", folder / "out", symlinks=True)
        draw = np.random.default_rng(seed)
        for _ in range(times):
            _harm(draw, folder / "out")

    def act(folder: Path) -> None:
        with contextlib.chdir(folder):
            command(*COMMAND, *overwrite, "-o", "out")
        _check_same(_arrays(folder / "out"), _whole(stock))

    # Tiles are done again before what lies beside them is in the way.
    title = f"tiles, {times} damages of seed {seed}"
    return Case(title, arrange, act, ("out",), (f"out/{TILES}",))


def _of_inputs(random: np.random.Generator, stock: Path) -> Case:
    """A run that goes on with another photograph: refused, or done with that one."""
    number = int(random.integers(1, 5))

    def arrange(folder: Path) -> None:
        shutil.copytree(stock / STOCK / "in", folder / "in")
        shutil.copytree(stock / STOCK / "begun", folder / "out")
        other = folder / "in" / f"00{number % 4 + 1}.png"
        (folder / "in" / f"00{number}.png").write_bytes(other.read_bytes())

    def act(folder: Path) -> None:
        with contextlib.chdir(folder):
            command(*COMMAND, "-o", "out")
        raise Wrong("tiles of other photographs were taken")

    return Case(f"photograph {number} is another", arrange, act, ("out",))


def _of_finished(random: np.random.Generator, stock: Path) -> Case:
    """A folder of maps one file of which was damaged, read by what comes next."""
    name = str(random.choice(FINISHED))
    whole = (stock / STOCK / "maps" / name).read_bytes()
    if name == RECORD_FILE and random.random() < 0.7:
        what, data = changed(random, json.loads(whole))
    else:
        what, data = damaged(random, whole)
    words = [
        ["relight", "maps", "--lights", "in.lp", "--no-shadows", "-o", "out"],
        ["export", "maps", "-o", "out.mtl"],
        ["view", "maps", "-o", "out.html"],
        [],
    ][int(random.integers(4))]

    def arrange(folder: Path) -> None:
        shutil.copytree(stock / STOCK / "maps", folder / "maps")
        (folder / "in.lp").write_text("1\na.png 0 0 1\n")
        (folder / "maps" / name).write_bytes(data)

    def act(folder: Path) -> None:
        with contextlib.chdir(folder):
            if words:
                command(*words)
            else:
                maps = load_folder(Path("maps"))[0]
                _ = maps.identified, maps.chi_squared, str(maps)

    told = " ".join(words[:1]) or "load"
    return Case(f"{told}, {name}: {what}", arrange, act, ("out*",))


def make(random: np.random.Generator, stock: Path) -> Case:
    makers = [_of_tiles, _of_inputs, _of_finished]
    return makers[int(random.choice(3, p=[0.55, 0.05, 0.4]))](random, stock)


def prepare(stock: Path) -> None:
    """A data set, its maps, and a run of them that was ended before the end."""
    folder = stock / STOCK
    options = ["--material", "preset:brass", "--resolution", "48", "--lights", "4"]
    command("synth", folder / "in", *options, "--noise", "0.01")
    with contextlib.chdir(folder):
        command(*COMMAND, "-o", "maps")
        # Stopped when all tiles are there, and what is made of them is not.
        stop = OSError("stopped before the end")
        with mock.patch("phongfit.commands.maps.save", side_effect=stop):
            with contextlib.suppress(Refused):
                command(*COMMAND, "-o", "begun")
    if len(list((folder / "begun" / TILES / "ledger").rglob("0"))) < 3:
        raise Wrong("no tiles were left by a run that was stopped")


KIND = Kind(make, prepare, seconds=60.0, megabytes=2500.0, share=0.3)
