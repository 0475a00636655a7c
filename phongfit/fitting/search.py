"""From samples to the solution: a scan, a few samples, then all of them."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from phongfit.fitting.leaves import LEAVES
from phongfit.fitting.losses import AbstractLoss
from phongfit.fitting.noise import median_deviation
from phongfit.fitting.problem import Evaluation, Problem, evaluate
from phongfit.fitting.samples import Samples
from phongfit.fitting.solution import Solution, solve
from phongfit.fitting.start import choose, scan, scan_bands
from phongfit.fitting.unknowns import Unknowns
from phongfit.programs import program

# A pass solves with the noise level that the pass before left over.
MOST_PASSES = 8
# Of each start of a robust fit: at its own noise level, and at last at a common one.
ROBUST_PASSES = 3
# Where numbers of the scenes are unknown, the cost can have several valleys.
STARTS = 16


class Found(eqx.Module):
    """The solution, the problem with its final noise level, and how it ended."""

    problem: Problem
    y: Float[Array, " n"]
    converged: Bool[Array, ""]
    steps: Int[Array, ""]


class _Stand(NamedTuple):
    """Where a search stands: the noise level is that of a sample of weight 1."""

    y: Float[Array, " n"]
    sigma: Float[Array, ""]
    converged: Bool[Array, ""]
    steps: Int[Array, ""]


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

    Nobody waits for it: one program after the other takes over what the last one found.

    **Arguments:**

    - `few`: of the samples, where a share is enough to begin with.
    - `gather`: gives all of them; asked while JAX is at work on the few.
    """
    first = gather() if few is None else few
    y = unknowns.start
    # Before the noise is known the clamp is a hard one. A number of NumPy's serves:
    # to make an array of JAX's takes longer.
    level = 1.0 if noise_given else float(np.finfo(y.dtype).eps)
    sigma: Any = np.asarray(level, y.dtype)
    problem = Problem(first, unknowns, sigma, loss, clamp)
    if unknowns.of_scene or unknowns.exposed:
        y = _best_of_several(problem, noise_given, max_steps)
    if loss.robust:
        stand = _best_valley(problem, y, noise_given, min(max_steps, 50))
    elif unknowns.of_scene or unknowns.exposed:
        stand = _look(problem, y, noise_given)
    else:
        stand = _begin(problem, y, noise_given)
    if few is not None:
        samples = gather()
        if not loss.robust:
            # One pass comes near enough.
            stand = _settle(problem, stand, max_steps, noise_given, True)
        problem = Problem(samples, unknowns, sigma, loss, clamp)
    y, sigma, converged, steps = _settle(problem, stand, max_steps, noise_given)
    # Named by hand: to replace one field of a module takes long.
    problem = Problem(problem.samples, unknowns, sigma, loss, clamp)
    return Found(problem, y, converged, steps)


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


@program("noise_given")
def _begin(problem: Problem, y: Float[Array, " n"], noise_given: bool) -> _Stand:
    """Where the scan ends, and the noise level there."""
    return _look(problem, scan(problem, y), noise_given)


@program("noise_given")
def _look(problem: Problem, y: Float[Array, " n"], noise_given: bool) -> _Stand:
    """The noise level where a search begins, which outliers may be near."""
    sigma = jnp.asarray(problem.sigma)
    if not noise_given:
        sigma = _robust_noise(problem, evaluate(problem, y))
    return _Stand(y, sigma, jnp.array(False), jnp.array(0))


@program("noise_given", "steps")
def _best_valley(
    problem: Problem, y: Float[Array, " n"], noise_given: bool, steps: int
) -> _Stand:
    """The best of the ends that starts with narrow and wide highlights lead to.

    A robust cost has several valleys: what one explanation rejects, another explains.
    The end of each at its own noise level says little, since rejecting more makes it
    smaller: they go on, and are compared, at the smallest of them.

    ??? cite "Source"
        Yohai, *High breakdown-point and high efficiency robust estimates for
        regression*, Ann. Statist. 15(2), 1987: an M-estimate at the scale of the most
        robust one.
    """
    unknowns = problem.unknowns

    def noise(here: Problem, y: Array) -> Array:
        return here.sigma if noise_given else _robust_noise(here, evaluate(here, y))

    def end(at: tuple[Array, Array]) -> tuple[Array, Array]:
        here = dataclasses.replace(problem, sigma=at[1])
        y = solve(here, at[0], steps).y
        return y, noise(here, y)

    def again(
        at: tuple[Array, Array], last: Array
    ) -> tuple[tuple[Array, Array], Array]:
        common = jnp.nanmin(at[1])
        sigmas = jnp.where(last, common, at[1])
        return jax.lax.map(end, (at[0], sigmas)), common

    starts = scan_bands(problem, y)
    problem = dataclasses.replace(problem, sigma=jnp.asarray(problem.sigma))
    sigmas = jax.lax.map(lambda y: noise(problem, y), starts)
    last = jnp.arange(ROBUST_PASSES) == ROBUST_PASSES - 1
    (ends, _), common = jax.lax.scan(again, (starts, sigmas), last)
    common = dataclasses.replace(problem, sigma=common[-1])
    costs = jax.lax.map(common.costs, ends)
    if unknowns.of_scene or unknowns.exposed:
        # What the scenes are belongs to one end as a whole.
        total = jnp.sum(jnp.where(jnp.isfinite(costs), costs, jnp.inf), axis=(1, 2))
        y = ends[jnp.argmin(total)]
    else:
        y = choose(unknowns, y, ends, costs)
    return _Stand(y, noise(common, y), jnp.array(False), jnp.array(0))


@program("max_steps", "noise_given", "once")
def _settle(
    problem: Problem,
    stand: _Stand,
    max_steps: int,
    noise_given: bool,
    once: bool = False,
) -> _Stand:
    """Solve until the noise level that the solution rests on is what it leaves."""

    def again(stand: _Stand) -> _Stand:
        here = dataclasses.replace(problem, sigma=stand.sigma)
        solution = solve(here, stand.y, max_steps)
        sigma = stand.sigma if noise_given else _noise(here, solution)
        steps = stand.steps + solution.steps
        return _Stand(solution.y, sigma, solution.converged, steps)

    if once or noise_given:
        return again(stand)

    def is_unsettled(stands: tuple[_Stand, _Stand]) -> Bool[Array, ""]:
        before, now = stands
        falls = now.sigma <= 0.97 * before.sigma
        return falls & (now.steps <= MOST_PASSES * max_steps)

    def step(stands: tuple[_Stand, _Stand]) -> tuple[_Stand, _Stand]:
        return stands[1], again(stands[1])

    unknown = stand._replace(sigma=jnp.full_like(stand.sigma, jnp.inf))
    return jax.lax.while_loop(is_unsettled, step, (unknown, stand))[1]


def _noise(problem: Problem, solution: Solution) -> Float[Array, ""]:
    """Standard deviation of a sample of weight 1, before rounding."""
    if problem.loss.robust:
        return _robust_noise(problem, evaluate(problem, solution.y))
    left = solution.left
    variance = left.squares / jnp.maximum(left.share - solution.y.size, 1)
    return _unrounded(problem, variance, left.floor)


def _robust_noise(problem: Problem, at: Evaluation) -> Float[Array, ""]:
    """The same from the median, which outliers do not reach."""
    left = at.difference * jnp.sqrt(problem.samples.weight)
    deviation = median_deviation(left, problem.unclipped(), at.floor)
    return _unrounded(problem, deviation**2, at.floor)


def _unrounded(
    problem: Problem, variance: Float[Array, ""], floor: Float[Array, ""]
) -> Float[Array, ""]:
    """The standard deviation without what rounding adds to a variance."""
    samples = problem.samples
    if samples.step is not None:
        count = jnp.sum(samples.weight > 0).astype(variance.dtype)
        variance -= jnp.sum(samples.step**2 * samples.weight) / count / 12
    return jnp.sqrt(jnp.maximum(variance, floor**2))
