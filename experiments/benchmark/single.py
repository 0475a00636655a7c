"""One image of one material, next to stock solvers on the same residuals.

One RGB image of a ball, 1 % noise, ten unknowns. All ways take turns in one process:

- phongfit: the whole of `pf.fit`, from arrays to error bars, without a starting guess;
  and of it the search for the solution alone, which is what the others do;
- stock Levenberg-Marquardt of optimistix on the same residuals, from f = 8, with its
  default linear solver and with normal equations;
- Adam as differentiable renderers use it (learning rate 0.03, from f = 8), until f has
  come within 1e-3 of the answer.
"""

import dataclasses
import importlib.util
import time
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
from phongfit.fitting.fit import set_up
from phongfit.fitting.problem import Problem
from phongfit.fitting.samples import gather, seen_pixels
from phongfit.fitting.search import Found, search
from phongfit.fitting.start import choose_few

TRUTH = pf.Material((0.6, 0.3, 0.2), 0.3, 60.0, 0.5)
NOISE = 0.01
# Where Adam and Levenberg-Marquardt start: reflectances in mid-range, f = 8.
GUESS = (0.5, 8.0)
ADAM_RATE, ADAM_MOST = 0.03, 4000


@dataclasses.dataclass(frozen=True)
class Row:
    """One way to the answer."""

    name: str
    key: str
    seconds: float
    steps: int
    off: float
    slower: float = 1.0


Row.__init__.__doc__ = """**Arguments:**

- `off`: largest distance from the fit's answer, standard errors.
- `slower`: how many times as long it takes.
"""


def target(resolution: int) -> tuple[pf.Scene, np.ndarray]:
    """The scene of the README, and a noisy image of it."""
    camera = pf.OrthographicCamera(resolution, resolution)
    scene = pf.Scene(
        pf.Sphere(), camera, (pf.DirectionalLight((1, 1, 2)),), ambient=0.3
    )
    light = np.asarray(pf.render(scene, TRUTH, film=pf.Film(clamp=False)))
    noise = np.random.default_rng(0).normal(size=light.shape)
    return scene, np.clip(light + NOISE * noise, 0, 1).astype(light.dtype)


def medians(
    ways: dict[str, Callable[[], Any]], runs: int
) -> dict[str, tuple[float, Any]]:
    """Median time and last result of each way, all taking turns after two warm runs."""
    for way in ways.values():
        for _ in range(2):
            way()
    times: dict[str, list[float]] = {key: [] for key in ways}
    results = {}
    for _ in range(runs):
        for key, way in ways.items():
            begin = time.perf_counter()
            results[key] = way()
            jax.block_until_ready(eqx.filter(results[key], eqx.is_array))
            times[key].append(time.perf_counter() - begin)
    return {key: (float(np.median(times[key])), results[key]) for key in ways}


def start(problem: Problem) -> Float[Array, " n"]:
    """The starting guess as the solver's vector."""
    reflectance, exponent = GUESS
    guess = np.where(problem.unknowns.logarithmic, np.log(exponent), reflectance)
    return jnp.asarray(guess.astype(problem.sigma.dtype))


def searching(scene: pf.Scene, image: np.ndarray) -> Callable[[], Found]:
    """From samples to the solution, without a starting guess."""
    setting = set_up(scene, image)
    seen = seen_pixels(setting.sources)
    few = choose_few(setting.sources, seen)
    first = None if few is None else gather(setting.sources, few)
    samples = gather(setting.sources, seen)
    settings = (setting.unknowns, pf.Linear(), setting.film.clamp, False, 200)
    return lambda: search(first, samples, *settings)


@eqx.filter_jit
def stock(problem: Problem, y: Array, linear_solver: Any) -> optx.Solution:
    """optimistix's own solver on the same residuals."""
    return optx.least_squares(
        lambda y, problem: problem.residual(y).ravel(),
        optx.LevenbergMarquardt(1e-5, 1e-5, linear_solver=linear_solver),
        y,
        args=problem,
        max_steps=256,
        throw=False,
    )


def adam(problem: Problem, y: Array, answer: Array) -> Callable[[], Any]:
    """Steps of Adam on the mean square, all of them compiled into one loop."""
    import optax

    rule = optax.adam(ADAM_RATE)
    f = int(np.flatnonzero(problem.unknowns.logarithmic)[0])

    def loss(y: Array, problem: Problem) -> Array:
        return jnp.mean((problem.residual(y) * problem.sigma) ** 2)

    @eqx.filter_jit
    def descend(problem: Problem, y: Array) -> tuple[Array, Array]:
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
    """All ways, timed in turns."""
    scene, image = target(resolution)
    fit = pf.fit(scene, image)
    problem, answer, y = fit.found.problem, fit.found.y, start(fit.found.problem)
    names = {
        "fit": "phongfit, all of `pf.fit`",
        "search": "phongfit, its search alone",
        "lm": "optimistix LM",
        "lm_normal": "optimistix LM, normal equations",
        "adam": "Adam (optax), rate 0.03, to 1e-3 in f",
    }
    ways = {
        "fit": lambda: pf.fit(scene, image),
        "search": searching(scene, image),
        "lm": lambda: stock(problem, y, lx.QR()),
        "lm_normal": lambda: stock(problem, y, lx.Normal(lx.Cholesky())),
    }
    if importlib.util.find_spec("optax") is None:
        console.print("Adam is left out: pip install phongfit[benchmark]")
    else:
        ways["adam"] = adam(problem, y, answer)
    found = medians(ways, runs)

    def row(key: str) -> Row:
        seconds, result = found[key]
        if key in ("fit", "search"):
            slower = seconds / found["fit"][0]
            return Row(names[key], key, seconds, result.steps, 0.0, slower)
        if key == "adam":
            end, steps = result
        else:
            end, steps = result.value, result.stats["num_steps"]
        values = np.asarray(problem.unknowns.values(jnp.asarray(end)), float)
        off = float(np.max(np.abs(values - fit.values) / fit.errors))
        return Row(names[key], key, seconds, int(steps), off, seconds / found["fit"][0])

    return [row(key) for key in ways]
