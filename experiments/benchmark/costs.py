"""Time of renders and fits by pixel, image, light and unknown; time of cold starts."""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

import phongfit as pf
from experiments.benchmark.timing import seconds
from phongfit.fitting.problem.specification import DEFAULT_UNKNOWNS

MATERIAL = pf.Material((0.6, 0.3, 0.2), 0.3, 60.0, 0.5)
# Width and height of rendered images, pixels.
SIZES = (128, 256, 512, 1024, 2048)


def scene_of(size: int = 128, lights: int = 1) -> pf.Scene:
    """A ball in `size` × `size` pixels, under lights spread around the camera.

    However many they are, their intensities add up to 1.
    """
    # 2.4 radians are the golden angle, which spreads any number.
    angles = 2.4 * np.arange(lights)
    towards = [(np.cos(a), np.sin(a), 2.0) for a in angles]
    return pf.Scene(
        pf.Sphere(),
        pf.OrthographicCamera(size, size),
        [pf.DirectionalLight(d, intensity=1 / lights) for d in towards],
        ambient=0.3,
    )


def photograph(scene: pf.Scene, seed: int = 0) -> np.ndarray:
    """Image of a scene with noise of 0.01, clipped to [0, 1]."""
    light = np.asarray(pf.render(scene, MATERIAL))
    noise = np.random.default_rng(seed).normal(0, 0.01, light.shape)
    return np.clip(light + noise, 0, 1).astype(light.dtype)


def fit_seconds(scenes: Any, images: Any, **options: Any) -> float:
    """Median seconds of `pf.fit`, once its programs are compiled."""
    return seconds(lambda: pf.fit(scenes, images, **options), 5)


def render_costs(sizes: tuple[int, ...] = SIZES) -> dict[str, float]:
    """Seconds for each pixel to render a scene that is traced already, by size."""
    costs = {}
    for size in sizes:
        scene = scene_of(size)
        gbuffer = scene.trace()

        def shade(
            scene: pf.Scene = scene, gbuffer: pf.geometry.GBuffer = gbuffer
        ) -> None:
            jax.block_until_ready(pf.render(scene, MATERIAL, gbuffer=gbuffer))

        costs[str(size)] = seconds(shade, 15) / size**2
    return costs


def growth(sizes: tuple[int, ...] = (64, 128, 256, 512)) -> dict[str, dict[str, float]]:
    """Seconds of fits by what grows (pixels, images, lights, unknowns), and by number.

    **Arguments:** `sizes`: widths of the images whose pixels grow.
    """
    times: dict[str, dict[str, float]] = {"pixels": {}, "images": {}, "lights": {}}
    for size in sizes:
        scene = scene_of(size)
        times["pixels"][str(size**2)] = fit_seconds(scene, photograph(scene))
    for count in (1, 4, 16):
        scenes = [scene_of(lights=1) for _ in range(count)]
        images = [photograph(scene, k) for k, scene in enumerate(scenes)]
        times["images"][str(count)] = fit_seconds(scenes, images)
        lit = scene_of(lights=count)
        times["lights"][str(count)] = fit_seconds(lit, photograph(lit))
    scene = scene_of()
    image = photograph(scene)
    times["unknowns"] = {
        str(count): fit_seconds(scene, image, **options)
        for count, options in (
            (4, {"per_channel": ()}),
            (10, {}),
            (12, {"per_channel": DEFAULT_UNKNOWNS}),
        )
    }
    return times


def first_and_warm(size: int = 64) -> dict[str, float]:
    """Seconds of a first fit in this process, which compiles, and of a later one."""
    scene = scene_of(size)
    image = photograph(scene)
    jax.clear_caches()
    begin = time.perf_counter()
    pf.fit(scene, image)
    first = time.perf_counter() - begin
    return {"first": first, "warm": fit_seconds(scene, image)}


def cold_starts(size: int = 256) -> dict[str, float]:
    """Seconds of `phongfit fit` and of importing JAX and optimistix, in new processes.

    **Returns:** `first_fit` starts with an empty cache of compiled programs; `fit` and
    `import` are medians of three later processes.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scene = scene_of(size)
        pf.save_scene(folder / "scene.json", scene)
        pf.write_image(folder / "ball.png", photograph(scene), encoding="linear")
        imports = [sys.executable, "-c", "import jax, optimistix; jax.devices()"]
        command = [sys.executable, "-m", "phongfit", "fit", str(folder / "ball.png")]
        command += ["--scene", str(folder / "scene.json"), "--encoding", "linear"]
        command += ["--report", "none", "--overwrite", "-o", str(folder / "out")]
        times = {"import": [_process(imports, folder) for _ in range(4)][1:]}
        times["fit"] = [_process(command, folder) for _ in range(4)]
    return {
        "import": float(np.median(times["import"])),
        "first_fit": times["fit"][0],
        "fit": float(np.median(times["fit"][1:])),
    }


def _process(command: list[str], cache: Path) -> float:
    """Seconds of a command, which keeps compiled programs below the folder `cache`.

    **Raises:** `RuntimeError` with its error output, if it fails.
    """
    environment = os.environ | {"XDG_CACHE_HOME": str(cache / "cache")}
    begin = time.perf_counter()
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    taken = time.perf_counter() - begin
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command[1:4])}: {done.stderr.strip()}")
    return taken
