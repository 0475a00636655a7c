"""Question: what do maps cost on a cluster, and when its workers die?

`python -m experiments.cluster` starts a cluster on this machine, with one thread for
each worker. The workers render a stack of 24 images of a ball and fit it from zarr to
zarr: one worker and two, twice in turns; four of which one is killed every ten seconds,
which must give the same bits; and sizes from 1 to 100 megapixels. `--small` runs all of
this on smaller stacks.
"""

import contextlib
import dataclasses
import itertools
import os
import resource
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from rich.console import Console
from rich.table import Table

import phongfit as pf
from data_synth.lights import spread_directions
from experiments.output import JsonFile, check_outputs, save_numbers
from phongfit.cli import run
from phongfit.files.zarrs import make_array, open_group, writable, write_window
from phongfit.geometry.cameras import WindowCamera
from phongfit.maps import cluster
from phongfit.maps.blocks import Place, fit_block

LIGHTS = 24
SIDE, SMALL = 384, 192
"""Pixels along a shard's side, and with `--small`.

A shard is the part of a zarr array that is written as a whole: here a square of all
images. 24 images of 384² pixels are 42 MB as float32.
"""

NOISE = 0.005
"""Standard deviation of the images' noise, where white is 1."""


def scenes(height: int, width: int) -> tuple[pf.Scene, ...]:
    """Scenes of a ball that fills the image, one for each of 24 lamps."""
    camera = pf.OrthographicCamera(width, height, view_height=0.9)
    return tuple(
        pf.Scene(pf.Sphere(), camera, pf.DirectionalLight(direction))
        for direction in spread_directions(LIGHTS)
    )


def make_shard(path: str, number: int) -> None:
    """Render one shard of a stack; every pixel has a random material.

    **Arguments:** `path`: the zarr group; `number`: of the shard, row by row from the
    upper left.
    """
    array: Any = writable(open_group(path, "r+"), "images")
    _, height, width, _ = array.shape
    # The array's chunks, of shape (lights, side, side, 3), are the shards.
    side = array.chunks[1]
    columns = width // side
    top, left = side * (number // columns), side * (number % columns)
    rng = np.random.default_rng(number)
    material = pf.Material(
        diffuse=rng.uniform(0.2, 0.5, (side, side, 3)),
        specular=rng.uniform(0.2, 0.4, (side, side, 3)),
        shininess=rng.uniform(8, 40, (side, side, 1)),
    )
    whole = scenes(height, width)
    camera = WindowCamera(whole[0].camera, left, top, side, side)
    film = pf.Film(clamp=False)
    gbuffer = pf.geometry.trace(whole[0].surface, camera)
    images = [
        pf.render(
            dataclasses.replace(scene, camera=camera),
            material,
            film=film,
            gbuffer=gbuffer,
        )
        for scene in whole
    ]
    light = np.stack(images) + NOISE * rng.normal(size=(LIGHTS, side, side, 3))
    numbers = np.round(np.clip(light, 0, 1) * 65535).astype(np.uint16)
    rows, along = slice(top, top + side), slice(left, left + side)
    write_window(array, (slice(None), rows, along), numbers)


def make_stack(client: Any, folder: Path, rows: int, columns: int, side: int) -> Path:
    """Create a stack of `rows` × `columns` shards, which Dask's workers render.

    **Arguments:** `client`: of the Dask cluster; `side`: pixels along a shard's side.

    **Returns:** path of the stack.
    """
    path = folder / f"{rows}x{columns}.zarr"
    shape = (LIGHTS, rows * side, columns * side, 3)
    group = open_group(path, "a")
    make_array(group, "images", shape, "uint16", (LIGHTS, side, side, 3))
    count = rows * columns
    client.gather(client.map(make_shard, [str(path)] * count, range(count)))
    return path


def count_begun(folder: Path) -> int:
    """Number of times that a block was begun, also by workers that died.

    **Arguments:** `folder`: with one file for each, from [`counted_block`][].
    """
    return sum(1 for _ in folder.iterdir())


def counted_block(place: Place, number: int) -> Any:
    """Call [`fit_block`][], after creating an empty file that records the beginning."""
    marks = Path(place.output).with_suffix(".begun")
    (marks / f"{number}-{os.getpid()}-{time.monotonic_ns()}").touch()
    return fit_block(place, number)


def time_fit(client: Any, stack: Path, output: Path) -> float:
    """Fit the maps of a stack into the store `output`; returns the seconds it took."""
    images = pf.ZarrStack(stack)
    _, height, width = images.shape
    output.with_suffix(".begun").mkdir()
    start = time.perf_counter()
    # One block for each shard: by default small shards share a block.
    _, *block, _ = images.array.chunks
    pf.fit_maps(
        scenes(height, width),
        images,
        out=output,
        load=False,
        client=client,
        block=(block[0], block[1]),
        progress=False,
    )
    return time.perf_counter() - start


@contextlib.contextmanager
def kill_workers(client: Any, every: float) -> Iterator[list[int]]:
    """Kill a worker every `every` seconds in this context.

    Yields a list of process ids, which grows with every killed worker.
    """
    killed: list[int] = []
    ended = threading.Event()

    def work() -> None:
        while not ended.wait(every):
            # Only workers that answer: one that is still starting has no work to lose.
            workers = sorted(client.run(os.getpid, on_error="ignore").values())
            if workers:
                killed.append(workers[len(killed) % len(workers)])
                os.kill(killed[-1], signal.SIGKILL)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        yield killed
    finally:
        ended.set()
        thread.join(every + 60)


def peak_memory() -> int:
    """Peak memory of this process, bytes."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def cpu_seconds(client: Any) -> float:
    """Sum of the CPU seconds of all workers."""
    return sum(client.run(time.process_time).values())


def same_bits(a: Path, b: Path) -> bool:
    """Whether two stores contain the same maps, bit for bit."""
    groups = open_group(a), open_group(b)
    names: Any = groups[0].attrs["arrays"]
    pairs = ((writable(group, name) for group in groups) for name in names)
    return all(np.asarray(x).tobytes() == np.asarray(y).tobytes() for x, y in pairs)


def size_of(path: Path) -> int:
    """Bytes of all files of a store."""
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


def overhead(client: Any, count: int) -> float:
    """Seconds of scheduling for each block: the time for `count` blocks without work.

    [`empty_block`][] must have taken the place of [`fit_block`][].
    """
    # Blocks without work read and write nothing, so they need no paths.
    place = Place("", b"", "")
    start = time.perf_counter()
    done = sum(1 for _ in cluster._spread(client, place, count))
    assert done == count
    return (time.perf_counter() - start) / count


def empty_block(place: Place, number: int) -> dict[str, int]:
    """Do nothing in place of [`fit_block`][]; returns counts of no pixels."""
    del place, number
    return {}


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the command.

    Args:
        small: Less of everything, for a first look.
        every: Seconds between two kills of workers. Workers need some seconds to
            start: if it is too short, none finishes a block on a busy machine.
        folder: Folder for the stacks, tens of gigabytes for 100 megapixels; they are
            removed at the end. Default: that of temporary files.
        json: File for the numbers.
    """

    small: bool = False
    every: float = 10.0
    folder: Path | None = None
    json: JsonFile = None


def main(options: Options) -> int:
    """Time `fit_maps` on a local Dask cluster, also while workers are killed.

    Exit status 1 if killed workers change any bit of the maps.

    For example:
      python -m experiments.cluster --small
    """
    check_outputs(None, options.json)
    # Files count the blocks that processes begin, even processes that are killed.
    with (
        patch.object(cluster, "fit_block", counted_block),
        tempfile.TemporaryDirectory(dir=options.folder) as scratch,
    ):
        numbers = measure(Path(scratch), options.small, options.every)
    show(numbers)
    save_numbers(options.json, numbers)
    return 0 if numbers["deaths"]["same_bits"] else 1


def measure(folder: Path, small: bool, every: float) -> dict[str, Any]:
    """Measure everything that [`show`][] prints.

    **Arguments:** `folder`: for the stacks and maps; `every`: seconds between kills.
    """
    console = Console(stderr=True)
    outputs = (folder / f"maps{k}.zarr" for k in itertools.count())
    grid, side = ((3, 4), SMALL) if small else ((6, 8), SIDE)
    numbers: dict[str, Any] = {"small": small, "lights": LIGHTS}
    stack = folder / f"{grid[0]}x{grid[1]}.zarr"
    numbers["scaling"], whole = measure_scaling(stack, grid, side, outputs, console)
    console.print(numbers["scaling"])
    console.print(f"four, one killed every {every:g} seconds …")
    with cluster.dask_client("local:4") as client:
        n_blocks = grid[0] * grid[1]
        numbers["deaths"] = measure_deaths(
            client, stack, whole, next(outputs), n_blocks, every
        )
        with patch.object(cluster, "fit_block", empty_block):
            numbers["scheduling"] = {"seconds_per_block": overhead(client, 200)}
    console.print(numbers["deaths"], numbers["scheduling"])
    sizes = [(1, 2), (2, 4)] if small else [(2, 4), (6, 11), (21, 33)]
    numbers["sizes"] = measure_sizes(folder, sizes, side, outputs, console)
    return numbers


def measure_scaling(
    stack: Path,
    grid: tuple[int, int],
    side: int,
    outputs: Iterator[Path],
    console: Console,
) -> tuple[dict[str, Any], Path]:
    """Time one worker and two on the same stack, which is made if it is missing.

    **Arguments:** `grid`: shards along each axis; `side`: pixels along a shard's side;
    `outputs`: paths for stores of maps, one of which each fit takes.

    **Returns:** the numbers, and the path of the last maps.
    """
    folder, n_blocks = stack.parent, grid[0] * grid[1]
    shortest: dict[int, tuple[float, float]] = {}
    # Each number is timed twice, and the shorter time counts: other work only adds.
    for workers in (1, 2, 1, 2):
        console.print(f"{workers} of one core …")
        with cluster.dask_client(f"local:{workers}") as client:
            if not stack.exists():
                make_stack(client, folder, *grid, side)
            warm_up(client, folder, next(outputs), side)
            output = next(outputs)
            before, computed = time.process_time(), cpu_seconds(client)
            seconds = time_fit(client, stack, output)
            scheduler = time.process_time() - before
            run = (seconds, cpu_seconds(client) - computed)
            shortest[workers] = min(run, shortest.get(workers, run))
            peaks: Any = client.run(peak_memory)
            peak = max(peaks.values())
    wall = {workers: seconds for workers, (seconds, _) in shortest.items()}
    pixels = n_blocks * side**2
    numbers = {
        "pixels": pixels,
        "seconds": wall,
        "cpu_seconds": {workers: cpu for workers, (_, cpu) in shortest.items()},
        "ratio": wall[1] / wall[2],
        "pixels_per_worker_second": pixels / wall[1],
        "bytes_read_per_pixel": size_of(stack) / pixels,
        "bytes_written_per_pixel": size_of(output) / pixels,
        "peak_memory_of_a_worker": peak,
        "scheduler_cpu_seconds_per_block": scheduler / n_blocks,
    }
    return numbers, output


def measure_deaths(
    client: Any, stack: Path, expected: Path, output: Path, n_blocks: int, every: float
) -> dict[str, Any]:
    """Fit while workers are killed, and compare the maps with those at `expected`.

    In the result `work` is the number of blocks begun over that of blocks: 1 if no work
    was lost.
    """
    with kill_workers(client, every) as killed:
        seconds = time_fit(client, stack, output)
    begun = count_begun(output.with_suffix(".begun"))
    return {
        "killed": len(killed),
        "every": every,
        "seconds": seconds,
        "blocks": n_blocks,
        "begun": begun,
        "work": begun / n_blocks,
        "same_bits": same_bits(expected, output),
    }


def measure_sizes(
    folder: Path,
    sizes: list[tuple[int, int]],
    side: int,
    outputs: Iterator[Path],
    console: Console,
) -> list[dict[str, float]]:
    """Time stacks of several sizes, given as shards along each axis.

    **Returns:** megapixels, and microseconds a pixel, of each.
    """
    rows = []
    with cluster.dask_client("local:2") as client:
        warm_up(client, folder, next(outputs), side)
        for size in sizes:
            pixels = size[0] * size[1] * side**2
            console.print(f"{pixels / 1e6:.1f} megapixels …")
            stack, output = make_stack(client, folder, *size, side), next(outputs)
            seconds = time_fit(client, stack, output)
            rows.append(
                {
                    "megapixels": pixels / 1e6,
                    "microseconds_per_pixel": 1e6 * seconds / pixels,
                }
            )
            for path in (stack, output):
                shutil.rmtree(path)
    return rows


def warm_up(client: Any, folder: Path, output: Path, side: int) -> None:
    """Fit a small stack, so that every worker has compiled before times are taken."""
    stack = folder / "1x4.zarr"
    if not stack.exists():
        make_stack(client, folder, 1, 4, side)
    time_fit(client, stack, output)


def show(numbers: dict[str, Any]) -> None:
    """Print the numbers that `main` saves as one table, next to the aims.

    The keys of `seconds` and `cpu_seconds` are numbers of workers.
    """
    scaling, deaths = numbers["scaling"], numbers["deaths"]
    table = Table("what", "measured", "aim")
    wall_1, wall_2 = scaling["seconds"][1], scaling["seconds"][2]
    table.add_row(
        "two workers against one",
        f"{scaling['ratio']:.2f}× ({wall_1:.1f} s, {wall_2:.1f} s)",
        "≥ 1.8×",
    )
    cpu_1, cpu_2 = scaling["cpu_seconds"][1], scaling["cpu_seconds"][2]
    table.add_row("their CPU seconds", f"{cpu_1:.1f}, {cpu_2:.1f}", "the same")
    table.add_row("pixels per CPU second", f"{scaling['pixels'] / cpu_1:,.0f}", "")
    per_worker = scaling["pixels_per_worker_second"]
    table.add_row("pixels per second and worker", f"{per_worker:,.0f}", "")
    for what in ("read", "written"):
        table.add_row(
            f"bytes {what} per pixel", f"{scaling[f'bytes_{what}_per_pixel']:.0f}", ""
        )
    memory = scaling["peak_memory_of_a_worker"]
    table.add_row("peak memory of a worker, MB", f"{memory / 1e6:.0f}", "")
    scheduler = scaling["scheduler_cpu_seconds_per_block"]
    table.add_row(
        "scheduler and client, CPU ms per block", f"{1e3 * scheduler:.0f}", ""
    )
    empty = numbers["scheduling"]["seconds_per_block"]
    table.add_row("an empty block, ms", f"{1e3 * empty:.1f}", "")
    table.add_row(
        f"one worker killed every {deaths['every']:g} s ({deaths['killed']} in all)",
        f"{deaths['work']:.2f}× ({deaths['begun']} of {deaths['blocks']} blocks begun)",
        "≤ 1.3×",
    )
    table.add_row(
        "the same bits as without kills", "yes" if deaths["same_bits"] else "no", "yes"
    )
    fastest = min(row["microseconds_per_pixel"] for row in numbers["sizes"])
    for row in numbers["sizes"]:
        per_pixel = row["microseconds_per_pixel"]
        table.add_row(
            f"{row['megapixels']:.1f} megapixels, µs per pixel (× the fastest)",
            f"{per_pixel:.1f} ({per_pixel / fastest:.2f}×)",
            "≤ 1.5×",
        )
    Console().print(table)


if __name__ == "__main__":
    raise SystemExit(run(main, prog="python -m experiments.cluster"))
