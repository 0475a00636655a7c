"""Benchmark of a material per pixel, next to one small fit for each pixel.

`vmap`ped stock Levenberg-Marquardt of optimistix, on all pixels at once as the map has
them, and a loop over SciPy's `least_squares` on a few of them. Both are given each
pixel's cosines, which the map works out itself, and start from f = 8. Their results are
compared with the map and with the truth.
"""

import dataclasses
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import scipy.optimize
from jaxtyping import Array, Float

import phongfit as pf
from experiments.benchmark.maps import fit_stack, map_seconds
from experiments.benchmark.stack import AMBIENT, UNKNOWNS, Stack, cosines, make_stack

# Start of the other solvers: ρ_a, ρ_d, ρ_s of three channels in mid-range, and log f.
START = np.array([0.4] * 3 + [0.3] * 3 + [0.3] * 3 + [np.log(8)])
TOLERANCE, MOST_STEPS = 1e-4, 100


@dataclasses.dataclass(frozen=True)
class Samples:
    """The first pixels of a stack, as the other solvers take them.

    - `target`: linear light, (pixels, lights, 3).
    - `lit`, `logarithm`: (pixels, lights), as [`cosines`][] returns them.
    """

    target: np.ndarray
    lit: np.ndarray
    logarithm: np.ndarray


@dataclasses.dataclass(frozen=True)
class MethodResult:
    """Results of one method for the first pixels of a stack.

    - `seconds`: time for each pixel.
    - `values`: estimates, (pixels, 10), in the order of `START`.
    - `converged`: (pixels,).
    """

    seconds: float
    values: np.ndarray
    converged: np.ndarray


@dataclasses.dataclass(frozen=True)
class Row:
    """Time and accuracy of one method to fit a map.

    - `name`, `key`: its name in the printed table, and in the JSON file.
    - `seconds`: time for each pixel; `pixels`: number of those that it fitted.
    - `converged`: fraction of its pixels that converged.
    - `as_map`: fraction of its pixels where every unknown is within half a standard
        error of the map's.
    - `near_truth`: fraction of its unknowns within two standard errors of the truth:
        95 % is right.
    """

    name: str
    key: str
    seconds: float
    pixels: int
    converged: float
    as_map: float
    near_truth: float


def samples(stack: Stack, pixels: int) -> Samples:
    """The samples of a stack's first pixels."""
    lights = len(stack.images)
    target = stack.images.reshape(lights, -1, 3)[:, :pixels].transpose(1, 0, 2)
    normals = stack.normals.reshape(-1, 1, 3)[:pixels]
    return Samples(np.ascontiguousarray(target), *cosines(normals, stack.directions))


@eqx.filter_jit
def _vmapped(
    target: Float[Array, "pixels lights 3"],
    lit: Float[Array, "pixels lights"],
    logarithm: Float[Array, "pixels lights"],
) -> tuple[Array, Array]:
    """Fit each pixel by optimistix's Levenberg-Marquardt.

    **Arguments:** as in [`Samples`][].

    **Returns:** estimates, (pixels, 10), in the order of `START`; whether each pixel
    converged.
    """
    start = jnp.asarray(START, target.dtype)

    def residual(y: Array, args: tuple[Array, Array, Array]) -> Array:
        # y[9] is log f, and the lobe is exp(f log n·h).
        target, lit, logarithm = args
        lobe = jnp.where(lit > 0, jnp.exp(jnp.exp(y[9]) * logarithm), 0)
        light = (
            AMBIENT * y[None, :3] + lit[:, None] * y[None, 3:6]
            + lobe[:, None] * y[None, 6:9]
        )  # fmt: skip
        return light - target

    def one(*args: Array) -> tuple[Array, Array]:
        solver = optx.LevenbergMarquardt(TOLERANCE, TOLERANCE)
        result = optx.least_squares(
            residual, solver, start, args=args, max_steps=MOST_STEPS, throw=False
        )
        return result.value, result.result == optx.RESULTS.successful

    return eqx.filter_vmap(one)(target, lit, logarithm)


def vmapped_lm(stack: Stack, pixels: int) -> MethodResult:
    """Fit the first `pixels` pixels at once by optimistix's solver under `vmap`.

    All pixels take as many steps as the slowest one. The linear solver is the default
    one; normal equations take twice as long.
    """
    part = samples(stack, pixels)
    target, lit, logarithm = (
        jnp.asarray(a, float) for a in (part.target, part.lit, part.logarithm)
    )
    jax.block_until_ready(_vmapped(target, lit, logarithm))
    begin = time.perf_counter()
    values, converged = map(np.asarray, _vmapped(target, lit, logarithm))
    taken = time.perf_counter() - begin
    return MethodResult(taken / len(values), values, converged)


def scipy_loop(stack: Stack, pixels: int) -> MethodResult:
    """Fit the first `pixels` pixels by a loop over SciPy's `least_squares`, in float64.

    The bounds are those of maps: [0, 1] for reflectances, [1, 1000] for f.
    """
    part = samples(stack, pixels)
    low, high = np.zeros(UNKNOWNS), np.append(np.ones(9), np.log(1000))
    values, converged = [], []
    begin = time.perf_counter()
    for target, lit, logarithm in zip(
        np.asarray(part.target, float),
        np.asarray(part.lit, float)[..., None],
        np.asarray(part.logarithm, float)[..., None],
        strict=True,
    ):
        # Defaults bind this pixel's arrays: a closure would see the loop's last ones.
        def residual(y, target=target, lit=lit, logarithm=logarithm):
            lobe = np.where(lit > 0, np.exp(np.exp(y[9]) * logarithm), 0)
            return (AMBIENT * y[:3] + lit * y[3:6] + lobe * y[6:9] - target).ravel()

        result = scipy.optimize.least_squares(residual, START, bounds=(low, high))
        values.append(result.x)
        converged.append(result.success)
    taken = time.perf_counter() - begin
    return MethodResult(taken / len(values), np.stack(values), np.array(converged))


def rows(pixels: int = 16_000, lights: int = 96, *, scipy: int = 200) -> list[Row]:
    """Fit a map by all methods.

    **Arguments:** `pixels`: of the map, about; `scipy`: number of them that the SciPy
    loop fits, since it is slow.
    """
    stack = make_stack(pixels, lights)
    maps = fit_stack(stack)
    values, errors = as_rows(maps)
    identified = maps.identified & ~maps.flagged(pf.Flag.NOT_CONVERGED)
    ours = MethodResult(
        map_seconds(stack, 15) / identified.size, values, identified.ravel()
    )
    methods = {
        "map": ("phongfit, `fit_maps`", ours),
        "vmapped_lm": ("optimistix LM, `vmap`", vmapped_lm(stack, pixels)),
        "scipy_loop": ("SciPy `least_squares`, a loop", scipy_loop(stack, scipy)),
    }
    truth = stack.truth.reshape(-1, UNKNOWNS)
    return [
        judge(name, key, result, values, errors, truth)
        for key, (name, result) in methods.items()
    ]


def as_rows(maps: pf.Maps) -> tuple[np.ndarray, np.ndarray]:
    """A map's estimates and errors, (pixels, 10) each, in the order of `START`."""
    names = ("ambient", "diffuse", "specular", "shininess")
    values, errors = (
        np.concatenate([getattr(part, name) for name in names], axis=-1, dtype=float)
        for part in (maps, maps.stderr)
    )
    # From f to log f, whose standard error is that of f over f.
    errors[..., 9] /= values[..., 9]
    values[..., 9] = np.log(values[..., 9])
    return values.reshape(-1, UNKNOWNS), errors.reshape(-1, UNKNOWNS)


def judge(
    name: str,
    key: str,
    result: MethodResult,
    values: np.ndarray,
    errors: np.ndarray,
    truth: np.ndarray,
) -> Row:
    """Compare a method's results with the map and the truth, in the map's errors.

    **Arguments:** `values`, `errors`: the map's, from [`as_rows`][]; `truth`: (pixels,
    10). `result` has the first pixels of these.
    """
    count = len(result.values)
    values, errors, truth = (array[:count] for array in (values, errors, truth))
    identified = np.isfinite(errors).all(axis=1)
    from_map, from_truth = (
        np.abs(result.values - reference)[identified] / errors[identified]
        for reference in (values, truth)
    )
    return Row(
        name,
        key,
        result.seconds,
        count,
        float(np.mean(result.converged)),
        float(np.mean((from_map < 0.5).all(axis=1))),
        float(np.mean(from_truth < 2)),
    )
