"""Benchmark of maps of photographs that do not fit into memory.

A ball under many lights is photographed in 20 megapixels, as JPEG files and as a zarr
array of the same levels. `phongfit maps` makes a store of maps of either in one
process, and the files are read once in another.

    python -m experiments.benchmark.photographs
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import phongfit as pf
from data_synth.lights import spread_directions
from experiments.benchmark.maps import peak_bytes
from experiments.benchmark.stack import AMBIENT, cosines
from phongfit.files.images import to_levels
from phongfit.files.scenes import save_scene
from phongfit.files.schema import ImageRecord

VIEW = 1.2
"""World units from the lower to the upper edge, of a ball of radius 1."""

NOISE = 0.005
"""Standard deviation of the noise in linear light, where white is 1."""


def make_photographs(folder: Path, megapixels: float, lights: int) -> pf.Scene:
    """Write photographs of a ball whose colours vary over its surface.

    They are sRGB `.jpg` files with a `scene.json`, and the array `zarr/stack.zarr` of
    the values before JPEG compression.

    **Arguments:** `folder`: an existing one; `lights`: number of photographs, each
    under one lamp.

    **Returns:** the scene with all lamps.
    """
    import zarr

    height = round(np.sqrt(megapixels * 1e6 / 1.5))
    width = round(1.5 * height)
    camera = pf.OrthographicCamera(width, height, view_height=VIEW)
    directions = spread_directions(lights).astype(np.float32)
    lamps = tuple(pf.DirectionalLight(d) for d in directions)
    scene = pf.Scene(pf.Sphere(), camera, lamps, ambient=AMBIENT)
    records = [ImageRecord(file=f"{k:03}.jpg", lights=[k]) for k in range(lights)]
    save_scene(folder, scene, film=pf.Film(encoding="srgb"), images=records)
    (folder / "zarr").mkdir()
    save_scene(folder / "zarr", scene, film=pf.Film(encoding="srgb"), images=records)
    shape, chunks = (lights, height, width, 3), (1, 512, 512, 3)
    array = zarr.create_array(
        folder / "zarr" / "stack.zarr", shape=shape, dtype="u1", chunks=chunks
    )
    array.attrs["encoding"] = "srgb"
    rng = np.random.default_rng(0)
    noise = rng.normal(0, NOISE, (height, width, 3)).astype(np.float32)
    # The 8-bit sRGB level of linear light in steps of 16 bits, since a table is faster.
    table = to_levels(np.arange(2**16) / (2**16 - 1), "srgb", 8)
    for number, direction in enumerate(directions):
        image = np.empty((height, width, 3), np.uint8)
        # Some rows at a time, since twenty megapixels take much memory.
        for start in range(0, height, 256):
            rows = slice(start, min(start + 256, height))
            light = _light(camera, rows, direction)
            # One array of noise, shifted by another number of columns in each image.
            light += np.roll(noise, 7919 * number, axis=1)[rows]
            image[rows] = table[(np.clip(light, 0, 1) * (2**16 - 1)).astype(np.uint16)]
        Image.fromarray(image).save(
            folder / f"{number:03}.jpg", quality=95, subsampling=0
        )
        array[number] = image
    return scene


def _light(
    camera: pf.OrthographicCamera, rows: slice, direction: np.ndarray
) -> np.ndarray:
    """Render some rows of the striped ball by Blinn's model, linear, not clamped.

    **Arguments:** `direction`: unit vector to the lamp.
    """
    pixel = VIEW / camera.height
    x = (np.arange(camera.width, dtype=np.float32) + 0.5 - camera.width / 2) * pixel
    y = (camera.height / 2 - np.arange(rows.start, rows.stop) - 0.5) * pixel
    x, y = np.meshgrid(x, y.astype(np.float32))
    inside = x**2 + y**2 < 1
    normals = np.stack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1)
    lit, logarithm = cosines(normals, direction)
    # ρ_d is `paint`, ρ_a 0.4 times that, ρ_s 0.2, and f varies from 10 to 30.
    paint = np.stack([0.35 + 0.1 * np.sin(k * 5 * x + y) for k in (1, 2, 3)], axis=-1)
    lobe = np.where(lit > 0, np.exp((20 + 10 * np.sin(4 * y)) * logarithm), 0)
    light = AMBIENT * 0.4 * paint + lit[..., None] * paint + 0.2 * lobe[..., None]
    return np.where(inside[..., None], light, 0).astype(np.float32)


def measure(folder: Path) -> dict[str, Any]:
    """Seconds and peak memory of reading and of fitting, for each file format.

    **Arguments:** `folder`: with the files of [`make_photographs`][].
    """
    numbers: dict[str, Any] = {}
    for kind, source in (("jpeg", folder), ("zarr", folder / "zarr" / "stack.zarr")):
        out = folder / f"{kind}_maps.zarr"
        read, read_bytes = _process("_read", str(source))
        fitted, fit_bytes = _process("_fit", str(source), str(out))
        numbers[kind] = {
            "seconds_to_read": read,
            "seconds_to_fit": fitted,
            "ratio": fitted / read,
            "gigabytes_to_read": read_bytes / 1e9,
            "gigabytes_to_fit": fit_bytes / 1e9,
        }
        maps = pf.StoredMaps(out)
        numbers[kind]["identified"] = maps.counts["identified"] / maps.counts["fitted"]
    return numbers


def _process(function: str, *arguments: str) -> tuple[float, int]:
    """Seconds and peak bytes of a function of this module, run in a new process.

    The function prints its peak memory last.
    """
    code = f"from {__spec__.name} import {function}; {function}(*{arguments!r})"
    command = [sys.executable, "-c", code]
    start = time.perf_counter()
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    taken = time.perf_counter() - start
    return taken, int(done.stdout.split()[-1])


def _read(source: str) -> None:
    """Read all photographs of a zarr array or a folder, and print the peak memory."""
    if source.endswith(".zarr"):
        stack = pf.ZarrStack(source)
        _, height, width = stack.shape
        for start in range(0, height, 512):
            rows = slice(start, min(start + 512, height))
            stack.read_coded((rows, slice(0, width)))
    else:
        for path in sorted(Path(source).glob("*.jpg")):
            pf.read_image(path, "srgb")
    print(peak_bytes())


def _fit(source: str, out: str) -> None:
    """Run `phongfit maps` into the store `out`, and print the peak memory."""
    from phongfit.cli import main

    status = main(["maps", source, "-o", out, "--max-memory", "2G"])
    assert status == 0
    print(peak_bytes())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--megapixels", type=float, default=20.0)
    parser.add_argument("--lights", type=int, default=50)
    parser.add_argument("--folder", type=Path, help="keep the photographs there")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        if not (folder / "scene.json").exists():
            folder.mkdir(parents=True, exist_ok=True)
            make_photographs(folder, options.megapixels, options.lights)
        print(json.dumps(measure(folder), indent=2))
