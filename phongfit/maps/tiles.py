"""Fits of the maps of a job, tile by tile."""

import concurrent.futures
import dataclasses
import importlib.metadata
import os
import sys
import time
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

from phongfit.edge import shown
from phongfit.maps.ahead import ahead
from phongfit.maps.job import Job
from phongfit.maps.materials.bases import held
from phongfit.maps.materials.block import Given, fit_shared
from phongfit.maps.materials.finding import Materials, choose_sample, find_materials
from phongfit.maps.pixel.block import BLOCK, fit_block, fit_tile
from phongfit.maps.pixel.settings import MAP_PARAMETERS
from phongfit.maps.result import Layer, Maps, ParameterMaps, layers_of
from phongfit.maps.stacks import as_index

TILE_BYTES, CORE_BYTES, CPU_BYTES = 2**26, 2**24, 2**28
"""Bytes of light in a tile by default: on a GPU, and for each core of a CPU; and of
the tiles of all cores together.

Those of a core are few enough for its caches, and enough that the blocks of a second
pass, which may be nearly empty, take a small fraction of the time."""


class Team(NamedTuple):
    """Devices that fit tiles in turn, and the number of threads that read for them."""

    devices: Sequence[Any]
    threads: int


def as_team(devices: Sequence[Any] | None = None) -> Team:
    """The devices of a run; `None` for all local ones."""
    devices = jax.local_devices() if devices is None else list(devices)
    if not devices or not all(isinstance(one, jax.Device) for one in devices):
        raise ValueError(f"devices: expected devices of JAX, got {shown(devices)}")
    # XLA uses one core for a tile. On other devices one tile is read while the last is
    # fitted.
    cpu = devices[0].platform == "cpu"
    return Team(devices, (os.cpu_count() or 1) if cpu else 2 * len(devices))


def with_materials(job: Job, threads: int) -> tuple[Job, Materials | None]:
    """A job with the materials that its pixels share, the same for equal jobs.

    `None` stands for separate materials. If matte light alone explains the pixels best,
    it comes with a job without highlights.
    """
    if job.settings.materials is None:
        return job, None
    sample = choose_sample(job.pixels, len(job.scenes))
    blocks = [
        job.tile(sample[k : k + BLOCK], BLOCK) for k in range(0, len(sample), BLOCK)
    ]
    with concurrent.futures.ThreadPoolExecutor(threads) as workers:
        shared = find_materials(blocks, len(sample), job.outside, job.settings, workers)
    if len(shared.bases.shares):
        return job, shared
    dark = jnp.zeros_like(job.outside.known.specular)
    known = job.outside.known._replace(specular=dark)
    outside = job.outside._replace(known=known)
    return dataclasses.replace(job, settings=held(job.settings), outside=outside), None


def fit_job(
    job: Job,
    size: int,
    team: Team,
    shared: Materials | None = None,
    progress: bool = False,
) -> Maps:
    """Fit the maps of a job, tile by tile.

    **Arguments:**

    - `size`: pixels of a tile, for which the program is compiled.
    - `shared`: the materials that its pixels share, from [`with_materials`][].
    """
    among, fit = job.outside, fit_block
    if shared is not None:
        among, fit = Given(job.outside, shared.bases), fit_shared
    pixels = job.pixels
    tiles = [pixels[k : k + size] for k in range(0, len(pixels), size)]

    def work(number: int) -> dict[str, np.ndarray]:
        device = team.devices[number % len(team.devices)]
        inputs = jax.device_put((job.tile(tiles[number], size), among), device)
        fitted = fit_tile(*inputs, job.settings, fit)
        count = len(tiles[number])
        return {name: np.asarray(array)[:count] for name, array in fitted.items()}

    layers = layers_of(1 if job.settings.shared else 3)
    known = ("depth", "normals", "normals_stderr")
    for name in known[: 1 if job.settings.normals == "fit" else 3]:
        layers.pop(name)
    if shared is not None:
        layers["weights"] = Layer((len(shared.bases.shares),), 0)
    whole = {
        name: layer.full((job.geometry.mask.size,), job.outside.noise.dtype)
        for name, layer in layers.items()
    }
    for number, arrays in bar(
        ahead(work, len(tiles), team.threads), len(tiles), progress
    ):
        for name, values in arrays.items():
            whole[name][as_index(tiles[number])] = values
    return _maps_of(job, whole, shared)


def tile_size(pixels: int, images: int, wanted: int | None, team: Team) -> int:
    """Pixels of a tile, a multiple of a block's."""
    if wanted is None:
        cpu = team.devices[0].platform == "cpu"
        size = min(CORE_BYTES, CPU_BYTES // team.threads) if cpu else TILE_BYTES
        most = size // (images * 12 * BLOCK) * BLOCK
        # Tiles of equal size, since a partly filled one takes as long as a full one; in
        # a multiple of the number of cores, so that none idles.
        unit = team.threads if cpu else 1
        rounds = max(round(pixels / max(most, BLOCK) / unit), 1)
        wanted = -(-pixels // (rounds * unit))
    elif not isinstance(wanted, int) or wanted < 1:
        raise ValueError(f"tile_pixels: expected a whole number ≥ 1, got {wanted!r}")
    return -(-min(wanted, pixels) // BLOCK) * BLOCK


def versions() -> str:
    """Versions of the packages that compute maps."""
    names = ("phongfit", "jax", "jaxlib")
    return " ".join(f"{name} {importlib.metadata.version(name)}" for name in names)


def bar(
    items: Iterator[tuple[int, Any]], total: int, wanted: bool, what: str = "tiles"
) -> Iterator[tuple[int, Any]]:
    """Yield the items and show a progress bar, or occasional lines in a log."""
    console = Console(stderr=True)
    if not wanted:
        yield from items
        return
    if not console.is_terminal:
        yield from _lines(items, total, what)
        return
    columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(what, *columns, console=console, transient=True) as bar:
        yield from bar.track(items, total=total)


def _lines(
    items: Iterator[tuple[int, Any]], total: int, what: str, every: float = 30.0
) -> Iterator[tuple[int, Any]]:
    """Yield the items and print a line of progress every `every` seconds."""
    start = shown = time.monotonic()
    for k, item in items:
        now = time.monotonic()
        if k and now - shown >= every:
            shown, left = now, (now - start) * (total - k) / k
            words = f"{k} of {total} {what}, {left / 60:.1f} minutes left"
            print(f"maps: {words}", file=sys.stderr, flush=True)
        yield k, item


def _maps_of(job: Job, arrays: dict[str, np.ndarray], shared: Materials | None) -> Maps:
    """The maps of fitted arrays, whose first axis is all pixels."""
    settings, scene = job.settings, job.scenes[0]
    size = job.geometry.mask.shape
    normals, depth = job.geometry.seen(scene, arrays.pop("normals", None))
    maps: dict[str, Any] = {
        name: array.reshape(*size, *array.shape[1:]) for name, array in arrays.items()
    }
    errors = {name: maps.pop(f"stderr_{name}") for name in MAP_PARAMETERS}
    for name in job.unknowns:
        # Without ambient light ρ_a is not identified, and was left out of the fit.
        if name not in settings.names:
            errors[name][:] = np.inf
    given: Any = job.noise.given()
    if job.noise.varies:
        # Residuals are in units of each sample's own noise.
        maps["noise"] = maps["noise"] * given
    known = np.where(job.geometry.mask, 0, np.inf).astype(normals.dtype)
    maps.setdefault("normals_stderr", known)
    weights = maps.pop("weights", None)
    return Maps(
        **maps,
        stderr=ParameterMaps(**errors),
        normals=normals,
        unknowns=tuple(name for name in MAP_PARAMETERS if name in settings.names),
        noise_given=given,
        depth=depth,
        camera=scene.camera,
        specular_model=scene.specular_model,
        ambient_light=tuple(np.asarray(scene.ambient).tolist()),
        materials=None if shared is None else shared.basis(settings, weights),
    )
