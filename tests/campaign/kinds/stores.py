"""Stores of zarr that were damaged: stacks, finished maps, and runs that go on."""

import functools
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import zarr

import phongfit as pf
from tests.campaign.cases import Case, Kind, Wrong, blaming
from tests.campaign.damage import damaged
from tests.campaign.kinds.records import changed

STOCK = "stores"
SIDE, BLOCK = 16, (8, 8)
QUICK: Any = {"unknowns": ("diffuse",), "film": pf.Film(clamp=False), "block": BLOCK}
APART: Any = QUICK | {"load": False, "progress": False}
# What metadata may say to make a reader take more than there is.
LARGE = [2**31, 2**40, 2**62, -1, 0, 1.5, "8", None, [], 10**30]


@functools.cache
def _scenes() -> list[pf.Scene]:
    surface = pf.NormalMap(np.broadcast_to([0.0, 0.0, 1.0], (SIDE, SIDE, 3)))
    camera = pf.OrthographicCamera(SIDE, SIDE)
    directions = [(0.0, 0.0, 1.0), (0.5, 0.0, 1.0), (0.0, 0.5, 1.0)]
    return [pf.Scene(surface, camera, pf.DirectionalLight(d)) for d in directions]


@functools.cache
def _whole(stock: Path) -> dict[str, np.ndarray]:
    """What the maps are."""
    return dict(pf.StoredMaps(stock / STOCK / "maps.zarr").load().pixel_arrays())


def _harm(random: np.random.Generator, store: Path) -> str:
    """Something happens to a file of a store, more often to one that describes it."""
    files = sorted(path for path in store.rglob("*") if path.is_file())
    records = [path for path in files if path.name == "zarr.json"]
    if not files:
        return "nothing left"
    chosen = records if records and random.random() < 0.5 else files
    path = chosen[int(random.integers(len(chosen)))]
    name = path.relative_to(store).as_posix()
    match int(random.integers(6)):
        case 0:
            path.unlink()
            return f"without {name}"
        case 1:
            path.unlink()
            path.mkdir()
            return f"{name} is a folder"
        case 2 | 3 if path.name == "zarr.json":
            what, data = _changed(random, path.read_bytes())
        case 4:
            other = files[int(random.integers(len(files)))]
            what, data = "is another", other.read_bytes()
        case _:
            what, data = damaged(random, path.read_bytes())
    path.write_bytes(data)
    return f"{name}: {what}"


def _changed(random: np.random.Generator, data: bytes) -> tuple[str, bytes]:
    """A record with another value, or with a length that is none."""
    try:
        record = json.loads(data)
    except ValueError:
        # It was damaged before.
        return damaged(random, data)
    if random.random() < 0.5:
        return changed(random, record)
    try:
        what = _enlarge(random, record)
    except (AttributeError, TypeError):
        return changed(random, record)
    return what, json.dumps(record).encode()


def _enlarge(random: np.random.Generator, record: dict[str, Any]) -> str:
    """A length in an array's description that is none."""
    places = [
        numbers
        for numbers in (
            record.get("shape"),
            record.get("chunk_grid", {}).get("configuration", {}).get("chunk_shape"),
            *(
                codec.get("configuration", {}).get("chunk_shape")
                for codec in record.get("codecs", [])
            ),
        )
        if isinstance(numbers, list)
    ]
    value = LARGE[int(random.integers(len(LARGE)))]
    if not places:
        record["node_type"] = value
        return f"node_type {value}"
    numbers = places[int(random.integers(len(places)))]
    numbers[int(random.integers(len(numbers)))] = value
    return f"a length of {value}"


def _of(
    random: np.random.Generator, stock: Path, name: str, act: Any, anyway: Any = ()
) -> Case:
    """A copy of a store that is harmed, and what is done with it."""
    seed, times = int(random.integers(2**32)), int(random.choice([1, 1, 1, 3]))

    def arrange(folder: Path) -> None:
        for other in ("stack.zarr", name):
            if not (folder / other).exists():
                shutil.copytree(stock / STOCK / other, folder / other)
        draw = np.random.default_rng(seed)
        for _ in range(times):
            _harm(draw, folder / name)

    return Case(f"{name}, {times} damages of seed {seed}", arrange, act, (), anyway)


def _of_stack(random: np.random.Generator, stock: Path) -> Case:
    """Read as maps read it, window by window."""
    name = str(random.choice(["stack.zarr", "shards.zarr", "group.zarr"]))

    def act(folder: Path) -> None:
        with blaming(name):
            stack = pf.ZarrStack(folder / name)
            count, height, width = stack.shape
            for row in range(0, min(height, 4 * SIDE), 8):
                window = slice(row, row + 8), slice(0, 8)
                part = stack.read_coded(window).light
                rows, columns = min(8, height - row), min(8, width)
                if part.shape != (count, rows, columns, 3):
                    raise Wrong(f"a window of {part.shape}")

    return _of(random, stock, name, act)


def _of_maps(random: np.random.Generator, stock: Path) -> Case:
    """Finished maps, looked at."""

    def act(folder: Path) -> None:
        with blaming("maps.zarr"):
            stored = pf.StoredMaps(folder / "maps.zarr")
            _ = stored.shape, stored.counts, str(stored)
            maps = stored.load(slice(0, 8), slice(0, 8))
        if maps.identified.shape != maps.flags.shape or not str(maps):
            raise Wrong("maps of different sizes")

    return _of(random, stock, "maps.zarr", act)


def _of_run(random: np.random.Generator, stock: Path) -> Case:
    """A run that goes on in a store that was damaged: the same bits, or a refusal."""

    def act(folder: Path) -> None:
        with blaming("zarr"):
            images, out = folder / "stack.zarr", folder / "maps.zarr"
            stored = pf.fit_maps(_scenes(), images, out=out, **APART)
            found = stored.load().pixel_arrays()
        for name, array in _whole(stock).items():
            if np.asarray(found[name]).tobytes() != np.asarray(array).tobytes():
                raise Wrong(f"other numbers in {name}")

    # A run begins with what it is about, and ends where that cannot be written.
    return _of(random, stock, "maps.zarr", act, ("maps.zarr", "maps.zarr/*"))


def make(random: np.random.Generator, stock: Path) -> Case:
    makers = [_of_stack, _of_maps, _of_run]
    return makers[int(random.choice(3, p=[0.5, 0.3, 0.2]))](random, stock)


def prepare(stock: Path) -> None:
    """Stacks with chunks, with shards and in a group; and maps of one."""
    folder = stock / STOCK
    light = np.random.default_rng(0).uniform(0.1, 0.9, (3, SIDE, SIDE, 3)).astype("f4")
    chunks = (1, 8, 8, 3)
    zarr.create_array(folder / "stack.zarr", data=light, chunks=chunks)
    levels = (light * 65535).astype(np.uint16)
    shards = (3, 16, 16, 3)
    zarr.create_array(folder / "shards.zarr", data=levels, chunks=chunks, shards=shards)
    group = zarr.open_group(folder / "group.zarr", mode="w")
    group.create_array("images", data=levels, chunks=chunks)
    images, out = folder / "stack.zarr", folder / "maps.zarr"
    pf.fit_maps(_scenes(), images, out=out, **APART)


KIND = Kind(make, prepare, seconds=60.0, megabytes=2500.0, share=0.3)
