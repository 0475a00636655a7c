"""From samples to the solution: a scan, a few samples, then all of them."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.fitting.losses import AbstractLoss
from phongfit.fitting.problem import Evaluation, Problem, evaluate, solve
from phongfit.fitting.samples import Samples
from phongfit.fitting.start import choose_few, scan
from phongfit.fitting.unknowns import Unknowns

# A pass solves with the noise level that the pass before left over.
MOST_PASSES = 8


@dataclasses.dataclass(frozen=True)
class Found:
    """The solution, the problem with its final noise level, and how it ended."""

    problem: Problem
    y: Float[Array, " n"]
    converged: bool
    steps: int


def search(
    samples: Samples,
    unknowns: Unknowns,
    loss: AbstractLoss,
    clamp: bool,
    noise_given: bool,
    max_steps: int,
) -> Found:
    """The least cost, without a starting guess."""
    few = choose_few(samples)
    y = scan(few, unknowns, clamp)
    # Before the noise is known the clamp is a hard one.
    sigma = 1.0 if noise_given else float(np.finfo(y.dtype).eps)
    problem = Problem(few, unknowns, jnp.asarray(sigma, y.dtype), loss, clamp)
    found = _solve(problem, y, noise_given, max_steps)
    if few is samples:
        return found
    problem = dataclasses.replace(found.problem, samples=samples)
    last = _solve(problem, found.y, noise_given, max_steps)
    return dataclasses.replace(last, steps=found.steps + last.steps)


def _solve(
    problem: Problem, y: Float[Array, " n"], noise_given: bool, max_steps: int
) -> Found:
    """Solve until the noise level that the solution rests on is what it leaves."""
    if not noise_given:
        problem = _with_noise(problem, y, robust=True)
    steps = 0
    while True:
        solution = solve(problem, y, max_steps)
        y, steps = solution.y, steps + int(solution.steps)
        found = Found(problem, y, bool(solution.converged), steps)
        if noise_given or steps > MOST_PASSES * max_steps:
            return found
        before = float(problem.sigma)
        problem = _with_noise(problem, y, problem.loss.robust)
        if float(problem.sigma) > 0.97 * before:
            return dataclasses.replace(found, problem=problem)


def _with_noise(problem: Problem, y: Float[Array, " n"], robust: bool) -> Problem:
    """The problem with the noise level that the residuals at y show."""
    sigma = _noise_level(problem, evaluate(problem, y), len(y), robust)
    return dataclasses.replace(problem, sigma=jnp.asarray(sigma, problem.sigma.dtype))


def _noise_level(
    problem: Problem, at: Evaluation, unknowns: int, robust: bool
) -> float:
    """Standard deviation of a sample of weight 1, before rounding.

    Robust: from the median, which outliers do not reach.
    """
    weight = np.asarray(problem.samples.weight)
    used = weight > 0
    target = np.asarray(problem.samples.target)[used]
    difference = np.asarray(at.difference)[used] * np.sqrt(weight[used])
    rounding = float(
        np.mean(np.asarray(problem.samples.step)[used] ** 2 * weight[used])
    )
    # Below the resolution of the arithmetic nothing can be said.
    floor = 16 * np.finfo(difference.dtype).eps * max(float(np.abs(target).max()), 1e-3)
    inside = (target > 0) & (target < 1)
    if robust and problem.clamp and inside.sum() > unknowns:
        difference = difference[inside]
    if robust:
        variance = (1.4826 * float(np.median(np.abs(difference)))) ** 2
    else:
        free = float(np.sum(np.asarray(at.variance_share))) - unknowns
        variance = float(np.sum(difference.astype(float) ** 2)) / max(free, 1)
    return float(np.sqrt(max(variance - rounding / 12, floor**2)))
