"""From samples to the solution: a scan, a few samples, then all of them."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.fitting.leaves import LEAVES
from phongfit.fitting.losses import AbstractLoss
from phongfit.fitting.problem import Evaluation, Problem, evaluate
from phongfit.fitting.samples import Samples
from phongfit.fitting.solution import Solution, solve
from phongfit.fitting.start import scan
from phongfit.fitting.unknowns import Unknowns
from phongfit.programs import program

# A pass solves with the noise level that the pass before left over.
MOST_PASSES = 8
# Where numbers of the scenes are unknown, the cost can have several valleys.
STARTS = 16


@dataclasses.dataclass(frozen=True)
class Found:
    """The solution, the problem with its final noise level, and how it ended."""

    problem: Problem
    y: Float[Array, " n"]
    converged: bool
    steps: int


def search(
    few: Samples | None,
    gather: Callable[[], Samples],
    unknowns: Unknowns,
    loss: AbstractLoss,
    clamp: bool,
    noise_given: bool,
    max_steps: int,
) -> Found:
    """The least cost, without a starting guess of the material.

    **Arguments:**

    - `few`: of the samples, where a share is enough to begin with.
    - `gather`: gives all of them; asked while JAX is at work on the few.
    """
    first = gather() if few is None else few
    y = unknowns.start
    # Before the noise is known the clamp is a hard one.
    sigma = 1.0 if noise_given else float(np.finfo(y.dtype).eps)
    problem = Problem(first, unknowns, _number(sigma, y.dtype), loss, clamp)
    if unknowns.of_scene or unknowns.exposed:
        y = _best_of_several(problem, noise_given, max_steps)
        left = evaluate(problem, y)
    else:
        y, left = _begin(problem, y)
    samples = first if few is None else gather()
    if not noise_given:
        sigma = _robust_noise(problem, left)
    steps = 0
    if few is not None:
        # Without outliers, one pass comes near enough.
        found = _solve(problem, sigma, y, noise_given, max_steps, not loss.robust)
        y, steps, sigma = found.y, found.steps, float(found.problem.sigma)
        problem = Problem(samples, unknowns, problem.sigma, loss, clamp)
    last = _solve(problem, sigma, y, noise_given, max_steps)
    return dataclasses.replace(last, steps=steps + last.steps)


def _best_of_several(
    problem: Problem, noise_given: bool, max_steps: int
) -> Float[Array, " n"]:
    """The best end of several starts, for a noise that blurs small valleys away."""
    if not noise_given:
        problem = dataclasses.replace(problem, sigma=jnp.full_like(problem.sigma, 0.05))
    starts = jnp.asarray(spread_starts(problem.unknowns, STARTS))
    ends = _all_ends(problem, starts, min(max_steps, 50))
    costs = jnp.where(jnp.isfinite(ends.cost), ends.cost, jnp.inf)
    return ends.y[jnp.argmin(costs)]


@program("steps")
def _all_ends(
    problem: Problem, starts: Float[Array, "starts n"], steps: int
) -> Solution:
    return eqx.filter_vmap(lambda y: solve(problem, scan(problem, y), steps))(starts)


def spread_starts(unknowns: Unknowns, count: int) -> np.ndarray:
    """(count, n): what the scenes say, and points around it, in the box."""
    rng = np.random.default_rng(0)
    first = np.asarray(unknowns.start, float)
    shape = (count, len(first))
    low, high = (np.asarray(e, float) for e in (unknowns.lower, unknowns.upper))
    with np.errstate(invalid="ignore"):
        across = low + (high - low) * rng.random(shape)
    # Numbers of a scene are in units of what they were; light has no upper bound.
    scaled = first * np.exp(rng.normal(size=shape))
    moved = first + rng.normal(size=shape)
    starts = np.where(np.isfinite(across), across, np.where(low == 0, scaled, moved))
    starts = np.where(np.isin(unknowns.kinds, LEAVES), first, starts)
    starts[0] = first
    return np.clip(starts, low, high).astype(np.asarray(unknowns.start).dtype)


def _solve(
    problem: Problem,
    sigma: float,
    y: Float[Array, " n"],
    noise_given: bool,
    max_steps: int,
    once: bool = False,
) -> Found:
    """Solve until the noise level that the solution rests on is what it leaves."""
    steps, dtype = 0, problem.sigma.dtype
    while True:
        at = _number(sigma, dtype)
        solution, noise = _pass(problem, at, y, max_steps, noise_given)
        y, steps = solution.y, steps + int(solution.steps)
        settled = once or noise_given or steps > MOST_PASSES * max_steps
        if not noise_given:
            before, sigma = sigma, float(noise)
            if problem.loss.robust:
                sigma = _robust_noise(problem, evaluate(problem, y))
            settled |= sigma > 0.97 * before
        if settled:
            break
    # Named by hand: to replace one field of a module takes long.
    samples, unknowns = problem.samples, problem.unknowns
    known = _number(sigma, dtype)
    problem = Problem(samples, unknowns, known, problem.loss, problem.clamp)
    return Found(problem, y, bool(solution.converged), steps)


def _number(value: float, dtype: Any) -> Any:
    """A number for a program: the transfer to an array of JAX's takes longer."""
    return np.asarray(value, dtype)


@program("max_steps", "noise_given")
def _pass(
    problem: Problem,
    sigma: Float[Array, ""],
    y: Float[Array, " n"],
    max_steps: int,
    noise_given: bool,
) -> tuple[Solution, Float[Array, ""]]:
    """A solution for a noise level, and the noise level that its residuals show.

    Where that is the user's, or outliers would spoil it, nothing is looked at.
    """
    problem = dataclasses.replace(problem, sigma=jnp.asarray(sigma))
    solution = solve(problem, y, max_steps)
    if noise_given or problem.loss.robust:
        return solution, problem.sigma
    return solution, _noise(problem, solution.y)


@program()
def _begin(
    problem: Problem, y: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Evaluation]:
    """Where the scan ends, and what is left over there."""
    y = scan(problem, y)
    return y, evaluate(problem, y)


def _noise(problem: Problem, y: Float[Array, " n"]) -> Float[Array, ""]:
    """Standard deviation of a sample of weight 1, before rounding."""
    at, samples = evaluate(problem, y), problem.samples
    squares = jnp.sum(at.difference**2 * samples.weight)
    free = jnp.sum(at.variance_share) - y.size
    variance = squares / jnp.maximum(free, 1)
    if samples.step is not None:
        count = jnp.sum(samples.weight > 0).astype(y.dtype)
        variance -= jnp.sum(samples.step**2 * samples.weight) / count / 12
    return jnp.sqrt(jnp.maximum(variance, at.floor**2))


def _robust_noise(problem: Problem, left: Evaluation) -> float:
    """The same from the median, which outliers do not reach."""
    weight = np.asarray(problem.samples.weight)
    used = weight > 0
    target = np.asarray(problem.samples.target)[used]
    difference = np.asarray(left.difference)[used]
    difference = difference * np.sqrt(weight[used])
    inside = (target > 0) & (target < 1)
    if problem.clamp and inside.sum() > problem.unknowns.lower.size:
        difference = difference[inside]
    variance = (1.4826 * float(np.median(np.abs(difference)))) ** 2
    if problem.samples.step is not None:
        steps = np.asarray(problem.samples.step)[used]
        variance -= float(np.mean(steps**2 * weight[used])) / 12
    return float(np.sqrt(max(variance, float(left.floor) ** 2)))
