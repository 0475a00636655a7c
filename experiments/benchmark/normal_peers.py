"""Benchmark of normals with materials, next to stock Levenberg-Marquardt per pixel.

Both fit the same twelve numbers of a pixel by least squares: two of the normal, ρ_a,
ρ_d, ρ_s of three channels, and log f. The peer starts at a surface that faces the
viewer; `fit_maps` needs no start, and gives errors and flags as well. CPU time is
measured, which depends least on other programs.
"""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

import phongfit as pf
from experiments.benchmark.map_peers import MOST_STEPS, START, TOLERANCE
from experiments.benchmark.stack import AMBIENT, FREE, Stack, make_stack


@dataclasses.dataclass(frozen=True)
class Row:
    """Time and accuracy of one method to fit normals.

    - `name`, `key`: its name in the printed table, and in the JSON file.
    - `seconds`: CPU time for each pixel.
    - `degrees`: median angle between fitted and true normals.
    """

    name: str
    key: str
    seconds: float
    pixels: int
    degrees: float


@eqx.filter_jit
def _vmapped(
    target: Float[Array, "pixels lights 3"], directions: Float[Array, "lights 3"]
) -> Array:
    """Fit each pixel's normal and material by optimistix's Levenberg-Marquardt.

    **Arguments:** `directions`: unit vectors to the lamps; the viewer is at +z.

    **Returns:** (pixels, 12): n_x / n_z, n_y / n_z, then the unknowns of `START`: ρ_a,
    ρ_d, ρ_s of three channels each, and log f.
    """
    half = directions + jnp.asarray([0, 0, 1], directions.dtype)[None]
    half = half / jnp.linalg.norm(half, axis=-1, keepdims=True)
    start = jnp.concatenate([jnp.zeros(2), jnp.asarray(START)]).astype(target.dtype)

    def residual(y: Array, target: Array) -> Array:
        # y[11] is log f, and the lobe is exp(f log n·h).
        normal = jnp.concatenate([y[:2], jnp.ones_like(y[:1])])
        normal = normal / jnp.linalg.norm(normal)
        lit, cosine = jnp.maximum(directions @ normal, 0), half @ normal
        logarithm = jnp.log(jnp.maximum(cosine, 1e-6))
        lobe = jnp.where(lit > 0, jnp.exp(jnp.exp(y[11]) * logarithm), 0)
        light = (
            AMBIENT * y[None, 2:5] + lit[:, None] * y[None, 5:8]
            + lobe[:, None] * y[None, 8:11]
        )  # fmt: skip
        return light - target

    def one(target: Array) -> Array:
        solver = optx.LevenbergMarquardt(TOLERANCE, TOLERANCE)
        return optx.least_squares(
            residual, solver, start, args=target, max_steps=MOST_STEPS, throw=False
        ).value

    return eqx.filter_vmap(one)(target)


def _degrees(normals: np.ndarray, stack: Stack) -> float:
    """Median angle of the first pixels' unit normals, (pixels, 3), from the truth."""
    cosine = np.sum(normals * stack.normals.reshape(-1, 3)[: len(normals)], axis=-1)
    return float(np.rad2deg(np.median(np.arccos(np.clip(cosine, -1, 1)))))


def _timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """CPU time and result of the faster of two runs, after one that compiles."""
    work()
    times, result = [], None
    for _ in range(2):
        begin = time.process_time()
        result = jax.block_until_ready(work())
        times.append(time.process_time() - begin)
    return min(times), result


def rows(pixels: int = 16_000, lights: int = 49) -> list[Row]:
    """Fit normals by both methods, on the same pixels; about `pixels` of them."""
    stack = make_stack(pixels, lights)
    target = stack.images.reshape(lights, -1, 3).transpose(1, 0, 2)
    given = jnp.asarray(np.ascontiguousarray(target)), jnp.asarray(stack.directions)
    count = len(target)

    def ours() -> np.ndarray:
        maps = pf.fit_maps(
            stack.scenes,
            stack.images,
            film=FREE,
            normals="fit",
            passes=1,
            loss="linear",
            progress=False,
        )
        return maps.normals.reshape(-1, 3)

    def peer() -> np.ndarray:
        slopes = np.asarray(_vmapped(*given))[:, :2]
        normals = np.concatenate([slopes, np.ones((count, 1))], axis=-1)
        return normals / np.linalg.norm(normals, axis=-1, keepdims=True)

    result_rows = []
    for name, key, method in (
        ('phongfit, `fit_maps(normals="fit")`', "normals", ours),
        ("optimistix LM, `vmap`", "vmapped_lm_of_normals", peer),
    ):
        taken, normals = _timed(method)
        result_rows.append(
            Row(name, key, taken / count, count, _degrees(normals, stack))
        )
    return result_rows
