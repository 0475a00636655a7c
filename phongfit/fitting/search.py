"""From samples to the solution: a scan, a few samples, then all of them."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from phongfit.fitting.charts import spread_directions, tangents
from phongfit.fitting.leaves import LEAVES, moves_geometry
from phongfit.fitting.losses import AbstractLoss
from phongfit.fitting.noise import median_deviation
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
# Directions that are moved one by one, to get out of valleys that others are not in.
MOST_MOVED = 8


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
        y, unknowns = _best_of_several(problem, noise_given, max_steps)
        problem = Problem(first, unknowns, sigma, loss, clamp)
        stand = _look(problem, y, noise_given)
    else:
        stand = _begin(problem, y, noise_given)
    if few is not None:
        samples = gather()
        # Without outliers, one pass comes near enough.
        stand = _settle(problem, stand, max_steps, noise_given, not loss.robust)
        problem = Problem(samples, unknowns, sigma, loss, clamp)
    y, sigma, converged, steps = _settle(problem, stand, max_steps, noise_given)
    # Named by hand: to replace one field of a module takes long.
    problem = Problem(problem.samples, unknowns, sigma, loss, clamp)
    return Found(problem, y, converged, steps)


def _best_of_several(
    problem: Problem, noise_given: bool, max_steps: int
) -> tuple[Float[Array, " n"], Unknowns]:
    """The best end of several starts, for a noise that blurs small valleys away.

    **Returns:** also the unknowns, with directions told around where that one started.
    """
    if not noise_given:
        problem = dataclasses.replace(problem, sigma=jnp.full_like(problem.sigma, 0.05))
    unknowns, steps = problem.unknowns, min(max_steps, 50)
    best = _best_end(problem, spread_starts(unknowns, STARTS), steps)
    # Started together, some end right and some do not: those can still be moved.
    several = 1 < len(unknowns.base) <= MOST_MOVED
    for which in range(len(unknowns.base) if several else 0):
        best = _best_end(problem, _moved(unknowns, best, which), steps)
    return best.y, unknowns.aimed(best.base, best.across)


class Starts(NamedTuple):
    """Points to start from, each with directions told around its own bases."""

    y: Float[Array, "*starts n"]
    base: Float[Array, "*starts directions 3"]
    across: Float[Array, "*starts directions 2 3"]


@program("steps")
def _best_end(problem: Problem, starts: Starts, steps: int) -> Starts:
    """The best of where these starts lead to."""

    def end(start: Starts) -> Solution:
        unknowns = problem.unknowns.aimed(start.base, start.across)
        here = dataclasses.replace(problem, unknowns=unknowns)
        return solve(here, scan(here, start.y), steps)

    ends = eqx.filter_vmap(end)(starts)
    best = jnp.argmin(jnp.where(jnp.isfinite(ends.cost), ends.cost, jnp.inf))
    return Starts(ends.y[best], starts.base[best], starts.across[best])


def _moved(unknowns: Unknowns, start: Starts, which: int) -> Starts:
    """A point, and the same with one direction all over the sphere."""
    y, base = (np.repeat(np.asarray(a, float)[None], STARTS, axis=0) for a in start[:2])
    place = unknowns.direction_places[which]
    y[1:, place : place + 2] = 0
    base[1:, which] = spread_directions(STARTS - 1)
    return _starts(unknowns, y, base)


def _starts(unknowns: Unknowns, y: np.ndarray, base: np.ndarray) -> Starts:
    kind = unknowns.start.dtype
    return Starts(*(jnp.asarray(a.astype(kind)) for a in (y, base, tangents(base))))


def spread_starts(unknowns: Unknowns, count: int) -> Starts:
    """What the scenes say, and points around it, in the box; directions anywhere."""
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
    # A camera or surface far from where it is said to be sees nothing, or is not seen.
    near = [moves_geometry(kind) for kind in unknowns.kinds]
    starts = np.where(near, first + 0.1 * (moved - first), starts)
    stays = np.isin(unknowns.kinds, LEAVES)
    stays |= unknowns.forms[unknowns.owned] == "direction"
    starts = np.where(stays, first, starts)
    starts[0] = first
    starts = np.clip(starts, low, high)
    base = np.repeat(np.asarray(unknowns.base, float)[None], count, axis=0)
    for k in range(base.shape[1]):
        base[1:, k] = rng.permutation(spread_directions(count - 1))
    return _starts(unknowns, starts, base)


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
    weight, target = problem.samples.weight, problem.samples.target
    chosen = weight > 0
    if problem.clamp:
        inside = chosen & (target > 0) & (target < 1)
        enough = jnp.sum(inside) > problem.unknowns.lower.size
        chosen = jnp.where(enough, inside, chosen)
    deviation = median_deviation(at.difference * jnp.sqrt(weight), chosen, at.floor)
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
