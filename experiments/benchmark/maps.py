"""Benchmark of maps of a synthetic stack: time for each pixel, and peak memory.

From ten thousand pixels to millions; memory is that of a map of memory-mapped images,
measured in a separate process.
"""

import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import phongfit as pf
from data_synth.lights import spread_directions
from experiments.benchmark.stack import AMBIENT, FREE, Stack, make_stack
from experiments.benchmark.timing import seconds


def fit_stack(stack: Stack) -> pf.Maps:
    """Maps of a stack of images: estimates and standard errors of every pixel."""
    return pf.fit_maps(stack.scenes, stack.images, film=FREE)


def map_seconds(stack: Stack, runs: int = 3) -> float:
    """Median seconds of `runs` fits of the maps of a stack."""
    return seconds(lambda: fit_stack(stack), runs)


def scaling(
    sizes: tuple[int, ...] = (10_000, 100_000, 1_000_000, 4_000_000), lights: int = 24
) -> dict[int, float]:
    """Seconds for each pixel, for maps of about so many pixels."""
    return {
        size: map_seconds(make_stack(size, lights), 1 if size > 200_000 else 9) / size
        for size in sizes
    }


def peak_memory(pixels: int = 4_000_000, lights: int = 24) -> dict[str, float]:
    """Peak memory and time per pixel of `fit_maps` with memory-mapped images.

    The images are written and fitted in separate processes, so that the peak is that of
    the fit alone.
    """

    def run(call: str) -> str:
        """Output of a call of a function of this module in a new process."""
        code = f"from experiments.benchmark import maps; maps.{call}"
        command = [sys.executable, "-c", code]
        return subprocess.run(
            command, check=True, stdout=subprocess.PIPE, text=True
        ).stdout

    with tempfile.TemporaryDirectory() as folder:
        run(f"_write({folder!r}, {pixels}, {lights})")
        gigabytes, duration = map(float, run(f"_map({folder!r})").split())
    return {"peak_gigabytes": gigabytes, "seconds_per_pixel": duration / pixels}


def _write(folder: str, pixels: int, lights: int) -> None:
    """Write a stack's images and normals as `stack.npy` and `normals.npy`."""
    stack = make_stack(pixels, lights, folder=Path(folder))
    np.save(Path(folder) / "normals.npy", stack.normals)


def _map(folder: str) -> None:
    """Fit the stack in a folder; print peak memory in GB, and seconds."""
    images = np.load(Path(folder) / "stack.npy", mmap_mode="r")
    lights, height, width, _ = images.shape
    surface = pf.NormalMap(np.load(Path(folder) / "normals.npy"))
    camera = pf.OrthographicCamera(width, height)
    scenes = [
        pf.Scene(surface, camera, pf.DirectionalLight(d), ambient=AMBIENT)
        for d in spread_directions(lights)
    ]
    start = time.perf_counter()
    maps = pf.fit_maps(scenes, images, film=FREE)
    taken = time.perf_counter() - start
    assert maps.identified.mean() > 0.9
    print(peak_bytes() / 1e9, taken)


def peak_bytes() -> int:
    """Peak memory of this process, bytes."""
    status = Path("/proc/self/status")
    if status.exists():
        # On Linux, getrusage includes the peak of the parent process.
        (line,) = re.findall(r"VmHWM:\s*(\d+) kB", status.read_text())
        return 1024 * int(line)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak * (1 if sys.platform == "darwin" else 1024)
