"""Benchmark of one image of one material, next to stock solvers on the same residuals.

One RGB image of a ball, 1 % noise, ten unknowns. All methods take turns in one process:

- phongfit: the whole of `pf.fit`, from arrays to error bars, without a starting guess;
  and the part of it that finds the solution, which is what the others do;
- stock Levenberg-Marquardt of optimistix on the same residuals, from f = 8, with its
  default linear solver, also with OpenBLAS on one thread, which suits that better, and
  with normal equations;
- Adam as differentiable renderers use it (learning rate 0.03, from f = 8), until f has
  come within 1e-3 of the answer: optax's, compiled into one loop, and PyTorch's;
- lmfit's `leastsq`, from f = 8 in the same box, errors included.
"""

import dataclasses
import importlib.util
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float
from rich.console import Console

import phongfit as pf
from experiments.benchmark.single_peers import (
    ADAM_MOST,
    ADAM_RATE,
    lmfit_leastsq,
    torch_adam,
    written_out,
)
from experiments.benchmark.timing import medians
from phongfit.fitting.fit import set_up
from phongfit.fitting.problem.problem import Problem
from phongfit.fitting.problem.samples import gather, seen_pixels
from phongfit.fitting.problem.specification import Specification
from phongfit.fitting.solve.search import SearchResult, search
from phongfit.fitting.solve.start import choose_few

TRUTH = pf.Material((0.6, 0.3, 0.2), 0.3, 60.0, 0.5)
NOISE = 0.01
# Start of Adam and Levenberg-Marquardt: reflectances in mid-range, f = 8.
GUESS = (0.5, 8.0)


@dataclasses.dataclass(frozen=True)
class Row:
    """Time and accuracy of one method.

    **Fields:**

    - `name`, `key`: its name in the printed table, and in the JSON file.
    - `seconds`: median of its runs; `steps`: steps, or calls of the residuals for
        lmfit.
    - `distance`: largest difference of an estimate from that of `pf.fit`, in standard
        errors.
    """

    name: str
    key: str
    seconds: float
    steps: int
    distance: float


def target(resolution: int) -> tuple[pf.Scene, np.ndarray]:
    """The scene of the README, and a noisy image of `resolution` × `resolution` pixels.

    The image is linear and clipped to [0, 1].
    """
    camera = pf.OrthographicCamera(resolution, resolution)
    scene = pf.Scene(
        pf.Sphere(), camera, (pf.DirectionalLight((1, 1, 2)),), ambient=0.3
    )
    light = np.asarray(pf.render(scene, TRUTH, film=pf.Film(clamp=False)))
    noise = np.random.default_rng(0).normal(size=light.shape)
    return scene, np.clip(light + NOISE * noise, 0, 1).astype(light.dtype)


def start(problem: Problem) -> Float[Array, " n"]:
    """The starting guess of the other solvers, as phongfit's vector of unknowns.

    It has reflectances as they are, and log f.
    """
    reflectance, exponent = GUESS
    guess = np.where(problem.unknowns.logarithmic, np.log(exponent), reflectance)
    return jnp.asarray(guess.astype(problem.sigma.dtype))


def search_function(scene: pf.Scene, image: np.ndarray) -> Callable[[], SearchResult]:
    """A function that runs phongfit's search, from samples to the solution.

    It does as `pf.fit` does, with linear loss, unknown noise and at most 200 steps.
    """
    setting = set_up(Specification(), scene, image)
    seen = seen_pixels(setting.sources)
    subset = choose_few(setting.sources, seen)
    first = None if subset is None else gather(setting.sources, subset)
    samples = gather(setting.sources, seen)
    # Unknowns, loss, clamp, whether the noise is given, largest number of steps.
    settings = (setting.unknowns, pf.Linear(), setting.films[0].clamp, False, 200)
    return lambda: search(first, lambda: samples, *settings)


@eqx.filter_jit
def optimistix_lm(problem: Problem, y: Array, linear_solver: Any) -> optx.Solution:
    """Minimise phongfit's residuals by optimistix's Levenberg-Marquardt, from `y`.

    **Arguments:** `linear_solver`: lineax's solver of the steps.
    """
    return optx.least_squares(
        lambda y, problem: problem.residual(y).ravel(),
        optx.LevenbergMarquardt(1e-5, 1e-5, linear_solver=linear_solver),
        y,
        args=problem,
        max_steps=256,
        throw=False,
    )


def adam(problem: Problem, y: Array, answer: Array) -> Callable[[], Any]:
    """A function that minimises the mean square by optax's Adam, in one compiled loop.

    It ends when log f is within 1e-3 of that in `answer`, or after `ADAM_MOST` steps.

    **Arguments:** `y`: the starting guess, as [`start`][] returns it.

    **Returns:** the function, which returns unknowns and number of steps.
    """
    import optax

    rule = optax.adam(ADAM_RATE)
    # Index of log f, the only logarithm among the unknowns.
    f = int(np.flatnonzero(problem.unknowns.logarithmic)[0])

    def loss(y: Array, problem: Problem) -> Array:
        # Residuals are in units of σ, and renderers minimise differences of light.
        return jnp.mean((problem.residual(y) * problem.sigma) ** 2)

    @eqx.filter_jit
    def descend(problem: Problem, y: Array) -> tuple[Array, Array]:
        # The state: unknowns, Adam's moments, number of steps.
        def unfinished(state: Any) -> Array:
            return (state[2] < ADAM_MOST) & (jnp.abs(state[0][f] - answer[f]) > 1e-3)

        def step(state: Any) -> Any:
            y, memory, count = state
            update, memory = rule.update(jax.grad(loss)(y, problem), memory)
            return optax.apply_updates(y, update), memory, count + 1

        y, _, count = jax.lax.while_loop(unfinished, step, (y, rule.init(y), 0))
        return y, count

    return lambda: descend(problem, y)


def rows(resolution: int, runs: int, console: Console) -> list[Row]:
    """Time all methods, in turns; those that are not installed are left out.

    **Arguments:** `resolution`: width and height of the image, pixels; `runs`: timed
    runs of each method.
    """
    scene, image = target(resolution)
    fit = pf.fit(scene, image)
    problem, answer, y = (
        fit.solution.problem,
        fit.solution.y,
        start(fit.solution.problem),
    )
    methods: dict[str, tuple[str, Callable[[], Any]]] = {
        "fit": ("phongfit, all of `pf.fit`", lambda: pf.fit(scene, image)),
        "search": ("phongfit, its search alone", search_function(scene, image)),
        "lm": ("optimistix LM", lambda: optimistix_lm(problem, y, lx.QR())),
        "lm_normal": (
            "optimistix LM, normal equations",
            lambda: optimistix_lm(problem, y, lx.Normal(lx.Cholesky())),
        ),
    }
    name = "LM with OpenBLAS on one thread"
    if installed("threadpoolctl", name, "pip install phongfit[benchmark]", console):
        methods["lm_one"] = f"optimistix {name}", on_one_thread(methods["lm"][1])
    rate = f"rate {ADAM_RATE}, to 1e-3 in f"
    if installed("optax", "Adam", "pip install phongfit[benchmark]", console):
        methods["adam"] = f"Adam (optax), {rate}", adam(problem, y, answer)
    start_values, answer_values = np.asarray(y), np.asarray(answer)
    if installed("torch", "PyTorch's Adam", "pip install torch", console):
        descent = torch_adam(written_out(problem), start_values, answer_values)
        methods["torch_adam"] = f"Adam (PyTorch), {rate}", descent
    if installed("lmfit", "lmfit", "pip install phongfit[benchmark]", console):
        low, high = problem.unknowns.lower, problem.unknowns.upper
        box = np.asarray(low), np.asarray(high)
        minimization = lmfit_leastsq(written_out(problem), start_values, *box)
        methods["lmfit"] = "lmfit `leastsq`", minimization
    timings = medians({key: method for key, (_, method) in methods.items()}, runs)

    def row(key: str) -> Row:
        # Solvers return their results in three forms.
        seconds, result = timings[key]
        if key in ("fit", "search"):
            end, steps = answer, result.steps
        elif key in ("lm", "lm_one", "lm_normal"):
            end, steps = result.value, result.stats["num_steps"]
        else:
            end, steps = result
        values = np.asarray(problem.unknowns.values(jnp.asarray(end, y.dtype)), float)
        distance = float(np.max(np.abs(values - fit.values) / fit.errors))
        return Row(methods[key][0], key, seconds, int(steps), distance)

    return [row(key) for key in methods]


def on_one_thread(work: Callable[[], Any]) -> Callable[[], Any]:
    """A function that runs `work` while OpenBLAS, which JAX uses, has one thread."""
    from threadpoolctl import threadpool_limits

    def limited() -> Any:
        with threadpool_limits(1, user_api="blas"):
            return jax.block_until_ready(work())

    return limited


def installed(module: str, name: str, cure: str, console: Console) -> bool:
    """Whether a Python module is installed; if not, a line about it is printed.

    **Arguments:** `name`: the method that needs it; `cure`: the command to install it.
    """
    is_installed = importlib.util.find_spec(module) is not None
    if not is_installed:
        console.print(f"{name} is left out: {cure}", markup=False)
    return is_installed
