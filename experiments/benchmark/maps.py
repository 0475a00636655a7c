"""A material per pixel, next to one fit after the other.

A map of a synthetic stack against `vmap`ped stock Levenberg-Marquardt of optimistix and
a loop over SciPy's `least_squares`, both on a part of the pixels; the time a pixel
takes from few pixels to millions; and the peak memory of a map whose images are
memory-mapped, in a process of its own.
"""

import dataclasses
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import scipy.optimize

import phongfit as pf
from data_synth.lights import spread_directions

AMBIENT = 0.3
NOISE = 0.01
FREE = pf.Film(clamp=False)
# What a pixel's unknowns are in the peers: ρ_a, ρ_d, ρ_s of three channels, and log f.
UNKNOWNS = 10


@dataclasses.dataclass(frozen=True)
class Stack:
    """Scenes, images (L, H, W, 3), and each pixel's true unknowns."""

    scenes: tuple[pf.Scene, ...]
    images: np.ndarray
    truth: np.ndarray
    normals: np.ndarray
    directions: np.ndarray


def make_stack(
    pixels: int, lights: int, *, folder: Path | None = None, seed: int = 0
) -> Stack:
    """About so many pixels, each of a random material; memory-mapped if in a folder."""
    rng = np.random.default_rng(seed)
    height = int(np.sqrt(pixels))
    width = pixels // height
    normals = np.ones((height, width, 3), np.float32)
    normals[..., :2] = rng.uniform(-0.4, 0.4, (height, width, 2))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    surface = pf.NormalMap(normals)
    camera = pf.OrthographicCamera(width, height)
    directions = spread_directions(lights).astype(np.float32)
    scenes = tuple(
        pf.Scene(surface, camera, pf.DirectionalLight(d), ambient=AMBIENT)
        for d in directions
    )
    truth = np.empty((height, width, UNKNOWNS), np.float32)
    truth[..., :3] = rng.uniform(0.2, 0.6, (height, width, 3))
    truth[..., 3:6] = rng.uniform(0.15, 0.4, (height, width, 3))
    truth[..., 6:9] = rng.uniform(0.2, 0.4, (height, width, 3))
    truth[..., 9] = rng.uniform(np.log(6), np.log(30), (height, width))
    shape = (lights, height, width, 3)
    if folder is None:
        images = np.empty(shape, np.float32)
    else:
        path = folder / "stack.npy"
        images = np.lib.format.open_memmap(path, "w+", np.float32, shape)
    noise = rng.normal(0, NOISE, (height, width, 3)).astype(np.float32)
    for image, direction in zip(images, directions, strict=True):
        image[:] = _light(np, truth, normals, direction)
        # Fresh noise for every image costs more than all else: it is shifted.
        image += np.roll(noise, rng.integers(0, noise.size // 3), axis=(0, 1))
    return Stack(scenes, images, truth, normals, directions)


def _light(xp, unknowns, normals, direction):
    """Blinn's model for one light and a distant viewer, in NumPy or JAX."""
    half = direction + xp.asarray([0, 0, 1], direction.dtype)
    half = half / xp.sqrt((half**2).sum())
    cosine = xp.maximum((normals * half).sum(-1), 1e-6)
    lit = (normals * direction).sum(-1)
    lobe = xp.where(lit > 0, xp.exp(xp.exp(unknowns[..., 9]) * xp.log(cosine)), 0)
    return (
        AMBIENT * unknowns[..., :3]
        + xp.maximum(lit, 0)[..., None] * unknowns[..., 3:6]
        + lobe[..., None] * unknowns[..., 6:9]
    )


def seconds(work: Callable[[], object], runs: int = 3) -> float:
    """The median of some runs, after one that compiles."""
    work()
    taken = []
    for _ in range(runs):
        start = time.perf_counter()
        work()
        taken.append(time.perf_counter() - start)
    return float(np.median(taken))


def map_seconds(stack: Stack, runs: int = 3) -> float:
    """Time of a whole map."""
    return seconds(lambda: pf.fit_maps(stack.scenes, stack.images, film=FREE), runs)


def scaling(
    sizes: tuple[int, ...] = (10_000, 100_000, 1_000_000, 4_000_000), lights: int = 24
) -> dict[int, float]:
    """Seconds a pixel for maps of several sizes."""
    return {
        size: map_seconds(make_stack(size, lights), 1 if size > 200_000 else 3) / size
        for size in sizes
    }


def lm_seconds(stack: Stack, pixels: int) -> float:
    """Seconds a pixel of `vmap`ped stock Levenberg-Marquardt, from f = 8."""
    targets, normals = _some(stack, pixels)
    directions = jnp.asarray(stack.directions)
    start = jnp.asarray(_start(), jnp.float32)

    @jax.jit
    def solve(targets, normals):
        def one(target, normal):
            def residual(y, args):
                del args
                light = jax.vmap(lambda d: _light(jnp, y, normal, d))(directions)
                return light - target

            solver = optx.LevenbergMarquardt(rtol=1e-4, atol=1e-4)
            found = optx.least_squares(
                residual, solver, start, max_steps=100, throw=False
            )
            return found.value

        return eqx.filter_vmap(one)(targets, normals)

    return seconds(lambda: jax.block_until_ready(solve(targets, normals)), 1) / pixels


def scipy_seconds(stack: Stack, pixels: int) -> float:
    """Seconds a pixel of a loop over SciPy's `least_squares` in the same box."""
    targets, normals = (np.asarray(a, float) for a in _some(stack, pixels))
    half = stack.directions + np.array([0, 0, 1.0])
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    low, high = np.zeros(UNKNOWNS), np.append(np.ones(9), np.log(1000))
    start = time.perf_counter()
    for target, normal in zip(targets, normals, strict=True):
        lit = np.maximum(stack.directions @ normal, 0)[:, None]
        logarithm = np.log(np.maximum(half @ normal, 1e-6))[:, None]

        def residual(y, target=target, lit=lit, logarithm=logarithm):
            lobe = np.where(lit > 0, np.exp(np.exp(y[9]) * logarithm), 0)
            return (AMBIENT * y[:3] + lit * y[3:6] + lobe * y[6:9] - target).ravel()

        scipy.optimize.least_squares(residual, _start(), bounds=(low, high))
    return (time.perf_counter() - start) / pixels


def _start() -> np.ndarray:
    return np.array([0.4] * 3 + [0.3] * 3 + [0.3] * 3 + [np.log(8)])


def _some(stack: Stack, pixels: int) -> tuple[np.ndarray, np.ndarray]:
    lights, *_ = stack.images.shape
    targets = stack.images.reshape(lights, -1, 3)[:, :pixels].transpose(1, 0, 2)
    return np.ascontiguousarray(targets), stack.normals.reshape(-1, 3)[:pixels]


def against_peers(
    pixels: int = 16_000, lights: int = 96, lm: int = 500, scipy: int = 20
) -> dict[str, float]:
    """Seconds a pixel of a map and of its peers."""
    stack = make_stack(pixels, lights)
    return {
        "map": map_seconds(stack) / stack.truth[..., 0].size,
        "vmapped_lm": lm_seconds(stack, lm),
        "scipy_loop": scipy_seconds(stack, scipy),
    }


def peak_memory(pixels: int = 4_000_000, lights: int = 24) -> dict[str, float]:
    """Gigabytes at the peak of a process that maps a memory-mapped stack."""
    with tempfile.TemporaryDirectory() as folder:
        code = "from experiments.benchmark.maps import {}; {}"
        make = f"_write({folder!r}, {pixels}, {lights})"
        use = f"_map({folder!r})"
        subprocess.run([sys.executable, "-c", code.format("_write", make)], check=True)
        command = [sys.executable, "-c", code.format("_map", use)]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        gigabytes, taken = map(float, done.stdout.split())
    return {"peak_gigabytes": gigabytes, "seconds_per_pixel": taken / pixels}


def _write(folder: str, pixels: int, lights: int) -> None:
    stack = make_stack(pixels, lights, folder=Path(folder))
    np.save(Path(folder) / "normals.npy", stack.normals)


def _map(folder: str) -> None:
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
    assert maps.told.mean() > 0.9
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(peak * (1 if sys.platform == "darwin" else 1024) / 1e9, taken)
