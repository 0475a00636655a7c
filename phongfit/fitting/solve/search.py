"""Search for the solution: a scan, a fit of a few samples, then of all of them."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from phongfit.fitting.problem.charts import spread_directions, tangents
from phongfit.fitting.problem.losses import AbstractLoss
from phongfit.fitting.problem.noise import median_deviation
from phongfit.fitting.problem.parameters import (
    MATERIAL_PARAMETERS,
    moves_geometry,
    scales_light,
)
from phongfit.fitting.problem.problem import Evaluation, Problem, evaluate
from phongfit.fitting.problem.samples import Samples
from phongfit.fitting.problem.unknowns import Unknowns
from phongfit.fitting.solve.guesses import Guesses
from phongfit.fitting.solve.solution import Solution, solve
from phongfit.fitting.solve.start import choose, scan, scan_bands
from phongfit.programs import program

# Most passes; each solves with the noise level of the previous pass's residuals.
MOST_PASSES = 8
# Fraction of clipped samples above which the solution depends on the noise level.
CLIPPED = 1e-4
# Passes of each start of a robust fit: at its own noise level, the last at a common
# one.
ROBUST_PASSES = 3
# Number of starts if parameters of scenes are unknown, since the cost can then have
# several minima.
STARTS = 16
# Each guess of lights gives a start with a wide and one with a narrow highlight:
# fractions of the range of log f.
BANDS = (0.0, 0.5), (0.5, 1.0)
# Most ends of starts that are solved for all samples; largest ratio of their cost, on a
# few samples, to the best; and least difference between them, in the solver's units.
MOST_POLISHED, WORSE, DIFFERENT = 3, 2.0, 0.05
# Most directions that are moved one by one, to leave local minima.
MOST_MOVED = 8
# Number of samples above which a pass over a few of them comes first. For fewer it
# saves no time, and its program costs a quarter of a first fit's compilation.
MANY = 2**14
# Relative tolerance of a first pass, if the noise is `NOISY` times the rounding or
# more.
NEAR, NOISY = 3e-4, 1e3


class SearchResult(eqx.Module):
    """The solution, the problem with its final noise level, and how the search ended.

    `rival` is the best other minimum that the search found, if there was one.
    """

    problem: Problem
    y: Float[Array, " n"]
    converged: Bool[Array, ""]
    steps: Int[Array, ""]
    rival: "Rival | None" = None


class Rival(NamedTuple):
    """A second minimum of the cost.

    - `entries`: its entries in the user's units.
    - `excess`: its χ² minus that of the solution, at the solution's noise level.
    """

    entries: Float[Array, " entries"]
    excess: Float[Array, ""]


class _SearchState(NamedTuple):
    """State of a search; the noise level is that of a sample of weight 1."""

    y: Float[Array, " n"]
    sigma: Float[Array, ""]
    converged: Bool[Array, ""]
    steps: Int[Array, ""]


def _first_state(y: Float[Array, " n"], sigma: Float[Array, ""]) -> _SearchState:
    """The state before the first solve."""
    return _SearchState(y, sigma, jnp.array(False), jnp.array(0))


def search(
    few: Samples | None,
    gather: Callable[[], Samples],
    unknowns: Unknowns,
    loss: AbstractLoss,
    clamp: bool,
    noise_given: bool,
    max_steps: int,
    guesses: Guesses | None = None,
    tolerance: float | None = None,
) -> SearchResult:
    """Minimise the cost, without a starting guess of the material.

    The programs are dispatched asynchronously; nothing is transferred to the host
    between them.

    **Arguments:**

    - `few`: some of the samples, if these are enough for a first pass.
    - `gather`: returns all samples; called while JAX computes the first pass.
    - `guesses`: see [`guess_places`][].
    - `tolerance`: see [`fit`][].
    """
    first = gather() if few is None else few
    y = unknowns.start
    # With a tiny noise level values are clipped sharply, as the noise is unknown yet.
    level = 1.0 if noise_given else float(np.finfo(y.dtype).eps)
    sigma = jnp.asarray(level, y.dtype)
    problem = Problem(first, unknowns, sigma, loss, clamp, None, tolerance)
    several = not set(unknowns.sought) <= set(MATERIAL_PARAMETERS)
    ways = [(problem, y)]
    if several:
        ways = _best_of_several(problem, noise_given, max_steps, guesses or {})
    states = [_first_look(*way, noise_given, several, max_steps) for way in ways]
    near, samples = False, first
    if few is not None:
        samples = gather()
        near = bool(loss.robust or several) or samples.image.size > MANY
        if near and not (loss.robust or several):
            # Solve once on few samples; with several starts that has been done.
            states = [_settle(problem, states[0], max_steps, noise_given, True)]
    ends = [
        _end(_posed_anew(here, samples, sigma), state, max_steps, noise_given, near)
        for (here, _), state in zip(ways, states, strict=True)
    ]
    return ends[0] if len(ends) == 1 else _best_end(ends)


def _first_look(
    problem: Problem,
    y: Float[Array, " n"],
    noise_given: bool,
    several: bool,
    max_steps: int,
) -> _SearchState:
    """The state after the search on few samples."""
    if problem.loss.robust:
        return _best_valley(problem, y, noise_given, min(max_steps, 50))
    return _look(problem, y if several else scan(problem, y), noise_given)


def _best_end(ends: list[SearchResult]) -> SearchResult:
    """The end with the least cost at the smallest noise level, and its rival."""
    sigma = min((end.problem.sigma for end in ends), key=float)
    costs = [_cost(end.problem, end.y, sigma) for end in ends]
    first, second = np.argsort(np.nan_to_num(np.array(costs, float), nan=np.inf))[:2]
    entries = ends[second].problem.unknowns.entries(ends[second].y)
    rival = Rival(entries, costs[second] - costs[first])
    return dataclasses.replace(ends[first], rival=rival)


@program()
def _cost(
    problem: Problem, y: Float[Array, " n"], sigma: Float[Array, ""]
) -> Float[Array, ""]:
    """Cost of samples and priors at a noise level."""
    problem = dataclasses.replace(problem, sigma=sigma)
    return jnp.sum(problem.costs(y)) - 2 * problem.log_prior(y)


def search_on(
    found: SearchResult, samples: Samples, noise_given: bool, max_steps: int
) -> SearchResult:
    """Continue a search with other weights of the same samples."""
    old = found.problem
    state = _first_state(found.y, old.sigma)._replace(steps=found.steps)
    problem = _posed_anew(old, samples, old.sigma)
    return _end(problem, state, max_steps, noise_given)


def _end(
    problem: Problem,
    state: _SearchState,
    max_steps: int,
    noise_given: bool,
    near: bool = False,
) -> SearchResult:
    y, sigma, converged, steps = _settle(
        problem, state, max_steps, noise_given, near=near
    )
    problem = _posed_anew(problem, problem.samples, sigma)
    return SearchResult(problem, y, converged, steps)


def _posed_anew(old: Problem, samples: Samples, sigma: Float[Array, ""]) -> Problem:
    """A problem with other samples and noise level, and without `scatter`."""
    # Made explicitly, since `dataclasses.replace` of a module takes long.
    return Problem(
        samples, old.unknowns, sigma, old.loss, old.clamp, None, old.tolerance
    )


def _best_of_several(
    problem: Problem, noise_given: bool, max_steps: int, guesses: Guesses
) -> list[tuple[Problem, Float[Array, " n"]]]:
    """The best ends of several starts, at a large noise that smooths out small minima.

    **Returns:** ends in different minima, the best one first. The unknowns of their
    problems have directions relative to where each started.
    """
    blurred = problem
    if not noise_given:
        blurred = dataclasses.replace(problem, sigma=jnp.full_like(problem.sigma, 0.05))
    unknowns, steps = problem.unknowns, min(max_steps, 50)
    ends = _ends(blurred, spread_starts(unknowns, STARTS, guesses), steps)
    # Some directions may end right and others not: these are started again.
    count = _n_sought_directions(unknowns)
    for which in range(count if 1 < count <= MOST_MOVED else 0):
        start = jax.tree.map(lambda of_all: of_all[0], ends.starts)
        moved = _ends(blurred, _moved(unknowns, start, which, guesses), steps)
        ends = _sorted(jax.tree.map(lambda *both: np.concatenate(both), ends, moved))
    ways = []
    for k in _valleys(unknowns, ends):
        y, base, across = (jnp.asarray(of_all[k]) for of_all in ends.starts[:3])
        here = dataclasses.replace(problem, unknowns=unknowns.aimed(base, across))
        ways.append((here, y))
    return ways


def _n_sought_directions(unknowns: Unknowns) -> int:
    """Number of unknown directions that may be anywhere; nuisances come after them."""
    nuisance = unknowns.table.nuisance[unknowns.direction_entries]
    return int(np.count_nonzero(~nuisance))


class Starts(NamedTuple):
    """Starting points, each with directions relative to its own bases.

    `band` is the band of exponents of each: see [`scan`][].
    """

    y: Float[Array, "*starts n"]
    base: Float[Array, "*starts directions 3"]
    across: Float[Array, "*starts directions 2 3"]
    band: Float[Array, "*starts 2"]


class _Ends(NamedTuple):
    """Ends of starts: points, their entries in the user's units, and costs."""

    starts: Starts
    entries: Float[Array, "*starts entries"]
    cost: Float[Array, "*starts"]


def _ends(problem: Problem, starts: Starts, steps: int) -> _Ends:
    """Solve from each start; the ends are sorted by cost."""
    return _sorted(jax.tree.map(np.asarray, _solved(problem, starts, steps)))


def _sorted(ends: _Ends) -> _Ends:
    """Ends sorted by cost."""
    order = np.argsort(np.where(np.isfinite(ends.cost), ends.cost, np.inf))
    return jax.tree.map(lambda of_all: of_all[order], ends)


@program("steps")
def _solved(problem: Problem, starts: Starts, steps: int) -> _Ends:
    """Solve from each start; the ends are in the order of the starts."""

    def end(start: Starts) -> _Ends:
        unknowns = problem.unknowns.aimed(start.base, start.across)
        here = dataclasses.replace(problem, unknowns=unknowns)
        solution = solve(here, scan(here, start.y, start.band), steps)
        entries = unknowns.entries(solution.y)
        return _Ends(start._replace(y=solution.y), entries, solution.cost)

    # Sequentially: each start takes its own number of steps, and compiles like one.
    return jax.lax.map(end, starts)


def _valleys(unknowns: Unknowns, ends: _Ends) -> list[int]:
    """Indices of the ends with the least cost that are different minima.

    Reflectances and intensities are not compared: light is linear in them, so they do
    not cause further minima.
    """
    strength = np.array([scales_light(name) for name in unknowns.table.parameter])
    strength |= unknowns.table.nuisance
    logarithm = unknowns.table.form == "logarithm"
    scaled = ends.entries / np.asarray(unknowns.scale)
    scaled = np.where(logarithm, np.log(np.where(logarithm, ends.entries, 1)), scaled)
    scaled = scaled[:, ~strength]
    chosen = [0]
    for k in np.flatnonzero(ends.cost <= WORSE * ends.cost[0]):
        off = np.abs(scaled[chosen] - scaled[k]).max(axis=1, initial=0)
        if len(chosen) < MOST_POLISHED and (off > DIFFERENT).all():
            chosen.append(int(k))
    return chosen


def _moved(unknowns: Unknowns, start: Starts, which: int, guesses: Guesses) -> Starts:
    """A start, and copies with one direction spread over the sphere or as guessed."""
    entry = int(unknowns.direction_entries[which])
    own = guesses.get(entry, np.zeros((0, 3)))
    own = np.repeat(own, len(BANDS), axis=0)
    count = STARTS + len(BANDS) * max(map(len, guesses.values()), default=0)
    spread = spread_directions(count - 1 - len(own))
    y, base = (np.repeat(np.asarray(a, float)[None], count, axis=0) for a in start[:2])
    index = unknowns.y_index[entry]
    y[1:, index : index + 2] = 0
    base[1:, which] = np.concatenate([spread, own])
    return _starts(unknowns, y, base, len(own) // len(BANDS))


def _starts(
    unknowns: Unknowns, y: np.ndarray, base: np.ndarray, guesses: int
) -> Starts:
    """Starts; the last ones are guesses, each with every band of exponents."""
    band = np.tile([0.0, 1.0], (len(y), 1))
    if guesses:
        band[-guesses * len(BANDS) :] = np.tile(BANDS, (guesses, 1))
    kind = unknowns.start.dtype
    arrays = (y, base, tangents(base), band)
    return Starts(*(jnp.asarray(a.astype(kind)) for a in arrays))


def spread_starts(unknowns: Unknowns, count: int, guesses: Guesses) -> Starts:
    """The scenes' values, and points around them in the box; directions are anywhere.

    After these `count` starts follow those with guesses of lights.
    """
    rng = np.random.default_rng(0)
    first = np.asarray(unknowns.start, float)
    shape = (count, len(first))
    low, high = (np.asarray(e, float) for e in (unknowns.lower, unknowns.upper))
    with np.errstate(invalid="ignore"):
        across = low + (high - low) * rng.random(shape)
    # Numbers of a scene are in units of their first values; light has no upper bound.
    scaled = first * np.exp(rng.normal(size=shape))
    moved = first + rng.normal(size=shape)
    starts = np.where(np.isfinite(across), across, np.where(low == 0, scaled, moved))
    # With a camera or surface far from its first position, no pixel sees the surface.
    near = [moves_geometry(kind) for kind in unknowns.y_parameter]
    starts = np.where(near, first + 0.1 * (moved - first), starts)
    stays = np.isin(unknowns.y_parameter, MATERIAL_PARAMETERS)
    stays |= unknowns.table.form[unknowns.y_entry] == "direction"
    stays |= unknowns.y_nuisance
    starts = np.where(stays, first, starts)
    starts[0] = first
    starts = np.clip(starts, low, high)
    base = np.repeat(np.asarray(unknowns.base, float)[None], count, axis=0)
    for k in range(_n_sought_directions(unknowns)):
        base[1:, k] = rng.permutation(spread_directions(count - 1))
    guessed = _guessed(unknowns, guesses)
    starts, base = (
        np.concatenate([one, np.repeat(more, len(BANDS), axis=0)])
        for one, more in zip((starts, base), guessed, strict=True)
    )
    return _starts(unknowns, starts, base, len(guessed[0]))


def _guessed(unknowns: Unknowns, guesses: Guesses) -> tuple[np.ndarray, np.ndarray]:
    """y and bases of the scenes' values with guessed lights."""
    count = max(map(len, guesses.values()), default=0)
    base = np.repeat(np.asarray(unknowns.base, float)[None], count, axis=0)
    entries = np.asarray(unknowns.entries(unknowns.start), float)
    entries = np.repeat(entries[None], count, axis=0)
    directions = unknowns.direction_entries.tolist()
    for entry, places in guesses.items():
        entries[:, entry : entry + 3] = places
        if entry in directions:
            base[:, directions.index(entry)] = places
    y = [unknowns.position(one) for one in entries]
    return np.reshape(y, (count, len(unknowns.start))), base


@program("noise_given")
def _look(problem: Problem, y: Float[Array, " n"], noise_given: bool) -> _SearchState:
    """The robust noise level at the start of a search."""
    if noise_given:
        return _first_state(y, problem.sigma)
    return _first_state(y, _robust_noise(problem, evaluate(problem, y)))


@program("noise_given", "steps")
def _best_valley(
    problem: Problem, y: Float[Array, " n"], noise_given: bool, steps: int
) -> _SearchState:
    """The best end of starts with highlights of several widths, for robust losses.

    A robust cost has several minima, which reject different samples. Costs at their own
    noise levels are not comparable, since rejecting more samples makes the level
    smaller. So all continue and are compared at the smallest level.

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
    sigmas = jax.lax.map(lambda y: noise(problem, y), starts)
    last = jnp.arange(ROBUST_PASSES) == ROBUST_PASSES - 1
    (ends, _), common = jax.lax.scan(again, (starts, sigmas), last)
    common = dataclasses.replace(problem, sigma=common[-1])
    costs = jax.lax.map(common.costs, ends)
    if unknowns.of_scene or unknowns.exposed:
        # The scenes' parameters are those of one end as a whole.
        total = jnp.sum(jnp.where(jnp.isfinite(costs), costs, jnp.inf), axis=(1, 2))
        y = ends[jnp.argmin(total)]
    else:
        y = choose(unknowns, y, ends, costs)
    return _first_state(y, noise(common, y))


class _Pass(NamedTuple):
    """State of the passes over the noise level; the last pass holds it."""

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
    """Solve until the noise level agrees with the residuals of the solution.

    If the solution depends on the level, the last solve is at the level stated.

    **Arguments:**

    - `once`: whether one solve is enough.
    - `near`: whether the start is near the end, so that the first solve may be coarse.
    """

    def again(
        state: _SearchState, last: Bool[Array, ""], coarse: Float[Array, ""]
    ) -> tuple[_SearchState, Bool[Array, ""]]:
        here = dataclasses.replace(problem, sigma=state.sigma)
        solution = solve(here, state.y, max_steps, coarse)
        steps = state.steps + solution.steps
        sigma = state.sigma
        if not noise_given:
            sigma = jnp.where(last, sigma, _noise(here, solution))
        now = _SearchState(solution.y, sigma, solution.converged, steps)
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
    """Whether the solution depends on the noise level, for example by priors."""
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
    free = int(np.count_nonzero(~problem.unknowns.y_nuisance))
    variance = left.squares / jnp.maximum(left.share - free, 1)
    return _unrounded(problem, variance, left.floor)


def _robust_noise(problem: Problem, at: Evaluation) -> Float[Array, ""]:
    """Robust standard deviation of a sample of weight 1, from the median."""
    left = at.difference * jnp.sqrt(problem.samples.weight)
    deviation = median_deviation(left, problem.unclipped(), at.floor)
    return _unrounded(problem, deviation**2, at.floor)


def _unrounded(
    problem: Problem, variance: Float[Array, ""], floor: Float[Array, ""]
) -> Float[Array, ""]:
    """Standard deviation from a variance minus that of rounding."""
    samples = problem.samples
    if samples.step is not None:
        count = jnp.sum(samples.weight > 0).astype(variance.dtype)
        variance -= jnp.sum(samples.step**2 * samples.weight) / count / 12
    return jnp.sqrt(jnp.maximum(variance, floor**2))
