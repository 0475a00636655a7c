"""From samples to the solution: a scan, a few samples, then all of them."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from phongfit.fitting.problem.charts import spread_directions, tangents
from phongfit.fitting.problem.losses import AbstractLoss
from phongfit.fitting.problem.noise import median_deviation
from phongfit.fitting.problem.parameters import MATERIAL_PARAMETERS, moves_geometry
from phongfit.fitting.problem.problem import Evaluation, Problem, evaluate
from phongfit.fitting.problem.samples import Samples
from phongfit.fitting.problem.unknowns import Unknowns
from phongfit.fitting.solve.solution import Solution, solve
from phongfit.fitting.solve.start import choose, scan, scan_bands
from phongfit.programs import program, record

# A pass solves with the noise level that the pass before left over.
MOST_PASSES = 8
# Share of the samples that may be clipped before the noise level matters to the others.
CLIPPED = 1e-4
# Of each start of a robust fit: at its own noise level, and at last at a common one.
ROBUST_PASSES = 3
# Where numbers of the scenes are unknown, the cost can have several valleys.
STARTS = 16
# Directions that are moved one by one, to get out of valleys that others are not in.
MOST_MOVED = 8
# Samples above which a pass over a few of them comes first: below, it would save no
# time, and cost that of one more program, a quarter of a first fit's.
MANY = 2**14
# Share of the residuals' size that a pass may leave to the next one to find, where
# there is so much more noise than rounding.
NEAR, NOISY = 3e-4, 1e3


@record
class SearchResult:
    """The solution, the problem with its final noise level, and how it ended."""

    problem: Problem
    y: Float[Array, " n"]
    converged: Bool[Array, ""]
    steps: Int[Array, ""]


class _SearchState(NamedTuple):
    """Where a search stands: the noise level is that of a sample of weight 1.

    `pace` is how fast the solver's steps shrank last; 0 if that is not known.
    """

    y: Float[Array, " n"]
    sigma: Float[Array, ""]
    converged: Bool[Array, ""]
    steps: Int[Array, ""]
    pace: Float[Array, "2"]


def _first_state(y: Float[Array, " n"], sigma: Float[Array, ""]) -> _SearchState:
    """Where nothing has been solved yet."""
    return _SearchState(y, sigma, jnp.array(False), jnp.array(0), jnp.zeros(2, y.dtype))


def search(
    few: Samples | None,
    gather: Callable[[], Samples],
    unknowns: Unknowns,
    loss: AbstractLoss,
    clamp: bool,
    noise_given: bool,
    max_steps: int,
) -> SearchResult:
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
    if loss.robust:
        state = _best_valley(problem, y, noise_given, min(max_steps, 50))
    elif unknowns.of_scene or unknowns.exposed:
        state = _look(problem, y, noise_given)
    else:
        state = _begin(problem, y, noise_given)
    near = False
    if few is not None:
        samples = gather()
        several = bool(loss.robust or unknowns.of_scene or unknowns.exposed)
        near = several or samples.image.size > MANY
        if near and not several:
            # One pass comes near enough; several starts have come as near.
            state = _settle(problem, state, max_steps, noise_given, True)
        problem = Problem(samples, unknowns, sigma, loss, clamp)
    return _end(problem, state, max_steps, noise_given, near)


def search_on(
    found: SearchResult, samples: Samples, noise_given: bool, max_steps: int
) -> SearchResult:
    """From where a search ended, with other weights of the same samples."""
    old = found.problem
    state = _first_state(found.y, old.sigma)._replace(steps=found.steps)
    problem = Problem(samples, old.unknowns, old.sigma, old.loss, old.clamp)
    return _end(problem, state, max_steps, noise_given)


def _end(
    problem: Problem,
    state: _SearchState,
    max_steps: int,
    noise_given: bool,
    near: bool = False,
) -> SearchResult:
    y, sigma, converged, steps, _ = _settle(
        problem, state, max_steps, noise_given, near=near
    )
    samples, unknowns = problem.samples, problem.unknowns
    # Named by hand: to replace one field of a module takes long.
    problem = Problem(samples, unknowns, sigma, problem.loss, problem.clamp)
    return SearchResult(problem, y, converged, steps)


def _best_of_several(
    problem: Problem, noise_given: bool, max_steps: int
) -> tuple[Float[Array, " n"], Unknowns]:
    """The best end of several starts, for a noise that blurs small valleys away.

    **Returns:** also the unknowns, with directions relative to where that one started.
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
    """Points to start from, each with directions relative to its own bases."""

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

    # One after another: each takes its own number of steps, and compiles like one.
    ends = jax.lax.map(end, starts)
    best = jnp.argmin(jnp.where(jnp.isfinite(ends.cost), ends.cost, jnp.inf))
    return Starts(ends.y[best], starts.base[best], starts.across[best])


def _moved(unknowns: Unknowns, start: Starts, which: int) -> Starts:
    """A point, and the same with one direction all over the sphere."""
    y, base = (np.repeat(np.asarray(a, float)[None], STARTS, axis=0) for a in start[:2])
    index = unknowns.direction_indices[which]
    y[1:, index : index + 2] = 0
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
    near = [moves_geometry(kind) for kind in unknowns.y_parameter]
    starts = np.where(near, first + 0.1 * (moved - first), starts)
    stays = np.isin(unknowns.y_parameter, MATERIAL_PARAMETERS)
    stays |= unknowns.forms[unknowns.y_entry] == "direction"
    starts = np.where(stays, first, starts)
    starts[0] = first
    starts = np.clip(starts, low, high)
    base = np.repeat(np.asarray(unknowns.base, float)[None], count, axis=0)
    for k in range(base.shape[1]):
        base[1:, k] = rng.permutation(spread_directions(count - 1))
    return _starts(unknowns, starts, base)


@program("noise_given")
def _begin(problem: Problem, y: Float[Array, " n"], noise_given: bool) -> _SearchState:
    """Where the scan ends, and the noise level there."""
    return _look(problem, scan(problem, y), noise_given)


@program("noise_given")
def _look(problem: Problem, y: Float[Array, " n"], noise_given: bool) -> _SearchState:
    """The noise level where a search begins, which outliers may be near."""
    sigma = jnp.asarray(problem.sigma)
    if not noise_given:
        sigma = _robust_noise(problem, evaluate(problem, y))
    return _first_state(y, sigma)


@program("noise_given", "steps")
def _best_valley(
    problem: Problem, y: Float[Array, " n"], noise_given: bool, steps: int
) -> _SearchState:
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
    return _first_state(y, noise(common, y))


class _Pass(NamedTuple):
    """Passes over the noise level: in the last it is held, and then all is done."""

    now: _SearchState
    passes: Int[Array, ""]
    last: Bool[Array, ""]
    done: Bool[Array, ""]


@program("max_steps", "noise_given", "once", "near")
def _settle(
    problem: Problem,
    state: _SearchState,
    max_steps: int,
    noise_given: bool,
    once: bool = False,
    near: bool = False,
) -> _SearchState:
    """Solve until the noise level that the solution rests on is what it leaves.

    Where the solution depends on that level, the last solve is for the level stated.

    **Arguments:**

    - `once`: one solve is enough.
    - `near`: the end is near: a first solve need not reach what the next one will.
    """

    def again(
        state: _SearchState, last: Bool[Array, ""], coarse: Float[Array, ""]
    ) -> tuple[_SearchState, Bool[Array, ""]]:
        here = dataclasses.replace(problem, sigma=state.sigma)
        solution = solve(here, state.y, max_steps, state.pace, coarse)
        steps = state.steps + solution.steps
        sigma = state.sigma
        if not noise_given:
            sigma = jnp.where(last, sigma, _noise(here, solution))
        now = _SearchState(solution.y, sigma, solution.converged, steps, solution.pace)
        return now, _depends_on_noise(problem, solution)

    exact = jnp.zeros((), state.y.dtype)
    if once or noise_given:
        return again(state, jnp.array(False), exact)[0]

    def step(at: _Pass) -> _Pass:
        noisy = at.now.sigma > NOISY * jnp.finfo(state.y.dtype).eps
        first = near & noisy & (at.passes == 0)
        now, depends = again(at.now, at.last, jnp.where(first, NEAR, exact))
        change = now.sigma / at.now.sigma
        falls, same = change <= 0.97, jnp.abs(jnp.log(change)) < 0.03
        passes = at.passes + 1
        late = (passes >= MOST_PASSES) | (now.steps > MOST_PASSES * max_steps)
        done = at.last | ((late | ~falls) & ~depends & ~first)
        return _Pass(now, passes, late | same, done)

    none = jnp.array(False)
    first = _Pass(state, jnp.array(0), none, none)
    return jax.lax.while_loop(lambda at: ~at.done, step, first).now


def _depends_on_noise(problem: Problem, solution: Solution) -> Bool[Array, ""]:
    """Whether another noise level would move the solution, as it does beside priors."""
    samples = problem.samples
    rounded, known = samples.step is not None, any(problem.unknowns.has_prior)
    if rounded or known or problem.loss.robust:
        return jnp.array(True)
    count = jnp.sum(samples.weight > 0).astype(solution.residual_sums.share.dtype)
    return solution.residual_sums.share < (1 - CLIPPED) * count


def _noise(problem: Problem, solution: Solution) -> Float[Array, ""]:
    """Standard deviation of a sample of weight 1, before rounding."""
    if problem.loss.robust:
        return _robust_noise(problem, evaluate(problem, solution.y))
    left = solution.residual_sums
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
