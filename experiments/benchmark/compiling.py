"""`python -m experiments.benchmark.compiling`: how long do first fits compile?

Fits of 1, 4, 12 and 48 images, each in a separate process: with an empty compile cache,
and again with the cache filled. All images but the first have an unknown exposure or
light intensity.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from typing import Any

import numpy as np
from rich.console import Console

import phongfit as pf
from experiments.benchmark.costs import MATERIAL
from phongfit.cli import run

# Names of the unknowns in `pf.fit`, by the kind in the table.
KINDS = {
    "exposure": "exposure",
    "strength": "scene.lights[0].intensity",
}
IMPORTS = "import jax, optimistix; jax.devices()"


def problem(images: int, kind: str, size: int) -> tuple[Any, ...]:
    """Scenes, images and options of a fit with `images` − 1 unknowns of a kind.

    The exposure or strength of the first image is fixed, since a common factor of all
    is not identifiable.

    **Arguments:** `kind`: a key of `KINDS`; `size`: width and height, pixels.
    """
    angles = 2 * np.pi * np.arange(images) / images
    camera = pf.OrthographicCamera(size, size)
    scenes = [
        pf.Scene(
            pf.Sphere(),
            camera,
            pf.DirectionalLight((np.cos(a), np.sin(a), 1.5)),
            ambient=0.3,
        )
        for a in angles
    ]
    rng = np.random.default_rng(0)
    # Not clamped: light is multiplied by the exposure below, and a film clamps after
    # that.
    film = pf.Film(clamp=False)
    light = [np.asarray(pf.render(scene, MATERIAL, film=film)) for scene in scenes]
    noisy = [
        strength * one + rng.normal(0, 0.003, one.shape)
        for strength, one in zip(np.linspace(0.6, 0.8, images), light, strict=True)
    ]
    if images == 1:
        return scenes, noisy, {}
    name = KINDS[kind]
    # Label of the first image's entry.
    first = name.replace("scene.", "scenes[0].") if "." in name else f"{name}[0]"
    unknowns = ("ambient", "diffuse", "specular", "shininess", name)
    per_image = (name,) if "." in name else ()
    options = {"unknowns": unknowns, "per_image": per_image, "fixed": {first: 0.6}}
    return scenes, noisy, options


def time_here(images: int, kind: str, size: int) -> dict[str, float]:
    """Seconds of two fits in this process: `first` compiles, `warm` does not.

    `work` is CPU seconds of the first. Arguments as in [`problem`][].
    """
    scenes, noisy, options = problem(images, kind, size)
    begin, cpu_before = time.perf_counter(), _cpu_seconds()
    pf.fit(scenes, noisy, **options)
    first, work = time.perf_counter() - begin, _cpu_seconds() - cpu_before
    begin = time.perf_counter()
    pf.fit(scenes, noisy, **options)
    return {"first": first, "work": work, "warm": time.perf_counter() - begin}


def _cpu_seconds() -> float:
    """CPU seconds that this process has used."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def time_in_processes(images: int, kind: str, size: int) -> dict[str, dict[str, float]]:
    """Times of [`time_here`][] in two new processes.

    "empty": with an empty cache of compiled programs; "kept": with what that one kept.
    """
    code = (
        "import json; from experiments.benchmark.compiling import time_here; "
        f"print(json.dumps(time_here({images}, {kind!r}, {size})))"
    )
    with tempfile.TemporaryDirectory() as cache:
        return {
            name: json.loads(_output(code, cache).splitlines()[-1])
            for name in ("empty", "kept")
        }


def _output(code: str, cache: str) -> str:
    """Output of Python code in a new process that keeps programs in folder `cache`.

    **Raises:** `RuntimeError` with its error output, if it fails.
    """
    others = {k: v for k, v in os.environ.items() if "COMPILATION_CACHE" not in k}
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=others | {"PHONGFIT_CACHE": cache},
        capture_output=True,
        text=True,
    )
    if done.returncode != 0:
        raise RuntimeError(done.stderr.strip())
    return done.stdout


def imports() -> float:
    """Seconds to import JAX and optimistix in a new process: the least of three."""
    taken = []
    for _ in range(3):
        begin = time.perf_counter()
        subprocess.run([sys.executable, "-c", IMPORTS], check=True)
        taken.append(time.perf_counter() - begin)
    return min(taken)


def main(size: int = 128, images: tuple[int, ...] = (1, 4, 12, 48)) -> None:
    """How long does a first fit wait for compilers? Takes some five minutes.

    Prints a table in Markdown; leave the machine alone meanwhile.

    Args:
        size: Width and height of an image, pixels.
        images: Numbers of images; one fit for each.
    """
    unit = imports()
    console = Console()

    def show(line: str) -> None:
        console.print(line, soft_wrap=True, markup=False, highlight=False)

    show(f"importing jax and optimistix: {unit:.2f} s\n")
    show(
        "| unknown of each image | images | first fit | over import | its processors "
        "| second process | warm |\n|---|--:|--:|--:|--:|--:|--:|"
    )
    for kind in KINDS:
        for count in images:
            times = time_in_processes(count, kind, size)
            empty, kept = times["empty"], times["kept"]
            show(
                f"| {kind} | {count} | {empty['first']:.1f} s "
                f"| {empty['first'] / unit:.1f} × | {empty['work']:.1f} s "
                f"| {kept['first']:.1f} s | {kept['warm']:.2f} s |"
            )


if __name__ == "__main__":
    raise SystemExit(run(main, prog="python -m experiments.benchmark.compiling"))
