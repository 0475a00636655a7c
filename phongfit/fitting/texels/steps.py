r"""Gauss–Newton steps that eliminate texels, with a small system for shared numbers.

The texels are many and hardly coupled, so a sparse solve eliminates them. The Schur
complement for the shared numbers remains.

??? cite "Source"
    Variable projection: Golub and Pereyra, *Separable nonlinear least squares*, Inverse
    Problems 19(2), 2003; the elimination is that of bundle adjustment, Triggs et al.,
    *Bundle adjustment: a modern synthesis*, 1999.
"""

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from phongfit.fitting.texels.equations import (
    ResidualSums,
    Sums,
    cost_of,
    costs,
    expected_differences,
    is_like_last,
    make_matrix,
    right_sides,
    sum_up,
    with_known,
)
from phongfit.fitting.texels.job import EXPONENTS, MIDDLE, RIDGE, Job, State
from phongfit.fitting.texels.solve import AbstractSystem, at_once, inverse_diagonal

SCAN = np.geomspace(2.0, 700.0, 11)
"""Exponents to try at the start, each together with its best texels."""

TOLERANCE = 1e-3
"""Tolerance of sparse solves, relative to their right-hand sides."""

PROBES = 8
"""Most random vectors from which a matrix's trace is estimated."""

LEAST = 1e-7
"""Least eigenvalue of the shared numbers' scaled information that identifies them."""


REACH = 1.0
"""Largest change of log f in a step."""

SETTLED = 0.05
"""A fit ends if the next change of texels' log f is smaller, in standard deviations,
root mean square."""

START = 2_000_000
"""Most pixels with which a start is sought; of more pixels every n-th is used."""


def find_start(
    job: Job, numbers: dict[str, np.ndarray], noise_given: bool
) -> tuple[State, float]:
    """A start: the best of some exponents, for each material.

    Each sample is taken to see only its nearest texel, so that texels are not coupled.
    If there are many pixels, only some are used, with larger texels. The texels of an
    exponent texture all start at the same exponent.
    """
    sigma = 1.0 if noise_given else 0.02
    linear, own = job.without_exponents(), "shininess" in job.names
    if own or len(linear.few) < len(job.few):
        together = own and job.grid.layers == 1
        found = _scan(_thinned(linear), numbers, sigma, together)
        numbers = numbers | {"shininess": found}
    state = _at_start(linear, numbers)
    if own:
        layers = np.log(numbers["shininess"])[: job.grid.layers]
        logs = np.repeat(layers, job.grid.texels // job.grid.layers)
        state = state._replace(exponents=logs)
    return step(linear, state, sigma).state, sigma


def _at_start(job: Job, numbers: dict[str, np.ndarray]) -> State:
    size = len(job.coloured) * job.grid.texels
    return State(np.full((3, size), MIDDLE), numbers)


def _thinned(job: Job) -> Job:
    """The job with at most about `START` pixels, and texels larger in proportion."""
    whole = job.images
    every = -(-sum(one.image[..., 0].size for one in whole.given) // START)
    if every == 1:
        return job
    grid = whole.grid.coarser(round(every**0.5))
    some = dataclasses.replace(whole, grid=grid, every=every)
    return dataclasses.replace(job, images=some, smoothness=None)


def _scan(
    job: Job, numbers: dict[str, np.ndarray], sigma: float, together: bool
) -> np.ndarray:
    """For each material, or all `together`, the exponent with the least cost."""
    best = numbers["shininess"]
    least = np.full(len(best), np.inf)
    for f in SCAN:
        tried = _at_start(job, numbers | {"shininess": np.full_like(best, f)})
        stepped = step(job, tried, sigma, nearest=True).state
        cost = costs(job, stepped, sigma)
        cost = np.full_like(cost, cost.sum()) if together else cost
        best, least = np.where(cost < least, f, best), np.minimum(cost, least)
    return best


class Equations(NamedTuple):
    """Normal equations, with right-hand sides and marks of free texels."""

    sums: Sums
    right: list[np.ndarray]
    free: list[np.ndarray]


def linearise(job: Job, state: State, sigma: float, nearest: bool = False) -> Equations:
    """Equations of a Gauss–Newton step; texels that push past a bound are not free."""
    sums = sum_up(job, state, sigma, nearest)
    rights, (low, high) = right_sides(job, sums, state), job.bounds(state)
    free = [
        ~((own <= low) & (right < 0) | (own >= high) & (right > 0))
        for own, right in zip(job.vectors(state), rights, strict=True)
    ]
    return Equations(sums, rights, free)


class System(NamedTuple):
    """Matrices from which errors are computed.

    - `alone`: variances of each system's texels if shared numbers are known.
    - `eliminated`: change of each system's texels by shared numbers, up to the sign.
    - `information`: information about shared numbers after texels are eliminated.
    - `freedom`: degrees of freedom, samples − unknowns that they determine.
    """

    left: ResidualSums
    alone: list[np.ndarray]
    eliminated: list[np.ndarray]
    information: np.ndarray
    freedom: float


def _matrices(
    job: Job, sums: Sums, damping: np.ndarray | None = None
) -> Iterator[tuple[int, AbstractSystem, bool]]:
    """Each system's index and matrix, and whether it differs from the previous matrix.

    Matrices take most of the memory. Each is freed before the next is made, provided
    that the caller deletes its own reference.
    """
    last: list[AbstractSystem] = []
    for s in range(len(job.systems)):
        new = not is_like_last(sums, s)
        if new:
            last.clear()
            last.append(make_matrix(job, sums, s, damping))
        yield s, last[0], new


def make_system(job: Job, state: State, sigma: float) -> System:
    """Matrices for errors at the solution, with the texels eliminated."""
    sums, _, free = linearise(job, state, sigma)
    information, eliminated = sums.dense.copy(), []
    alone, taken = [], []
    for s, matrix, new in _matrices(job, sums):
        if new:
            alone.append(inverse_diagonal(matrix, job.grid, len(job.systems[s])))
            taken.append(taken_by(job, matrix))
        else:
            alone.append(alone[-1])
            taken.append(taken[-1])
        solved = matrix.solve(sums.mixed[s], TOLERANCE, free[s])
        shared = job.of_system(s)
        information[np.ix_(shared, shared)] -= _products(sums.mixed[s], solved)
        eliminated.append(solved.astype(job.dtype, copy=False))
        del matrix
    information = (information + information.T) / 2
    freedom = _freedom(job, sums.left, sum(taken))
    return System(sums.left, alone, eliminated, information, freedom)


def _products(one: np.ndarray, solved: np.ndarray) -> np.ndarray:
    """Sums of products over texels; `solved` is 0 for texels that are not free."""
    return np.einsum("t...,tj->...j", one, solved, dtype=float)


class Stepped(NamedTuple):
    """State after a step; `left` and `taken` belong to the state before it.

    - `left`: residual sums. `taken`: number of unknowns that the texels determine.
    - `known`: inverse variance of each texel's log f if all else is known.
    - `settled`: for steps of exponents, whether the next step would be negligible.
    """

    state: State
    left: ResidualSums
    taken: float
    known: np.ndarray | None = None
    settled: bool | None = None


def step(
    job: Job,
    state: State,
    sigma: float,
    nearest: bool = False,
    damping: np.ndarray | None = None,
    reach: float | np.ndarray = REACH,
) -> Stepped:
    """One Gauss–Newton step within the bounds.

    **Arguments:** `damping`: added for each texel's exponent, relative to its diagonal;
    `reach`: largest change of log f, or of each material's.
    """
    sums, right, free = linearise(job, state, sigma, nearest)
    information, few_right = sums.dense.copy(), sums.few_right.copy()
    moves, eliminated = [], []
    for s, matrix, _ in _matrices(job, sums, damping):
        moves.append(matrix.solve(right[s][:, None], TOLERANCE, free[s])[:, 0])
        solved = matrix.solve(sums.mixed[s], TOLERANCE, free[s])
        shared = job.of_system(s)
        information[np.ix_(shared, shared)] -= _products(sums.mixed[s], solved)
        few_right[shared] -= _products(right[s], solved)
        eliminated.append(solved.astype(job.dtype, copy=False))
        del matrix
    information = (information + information.T) / 2
    change = _few_change(job, state, information, few_right, reach)
    vectors = []
    for s, (own, move) in enumerate(zip(job.vectors(state), moves, strict=True)):
        # Large arrays must have the photographs' precision, or they would be copied.
        by = change[job.of_system(s)].astype(job.dtype)
        move -= eliminated[s] @ by
        vectors.append(np.clip(own + move, *job.bounds(state)))
    numbers = {name: value.copy() for name, value in state.numbers.items()}
    for one, by in zip(job.few, change, strict=True):
        value = numbers[one.name]
        if one.name == "shininess":
            low, high = np.log(EXPONENTS)
            moved = np.clip(np.log(value[one.material]) + by, low, high)
            value[one.material] = np.exp(moved)
        else:
            at = slice(None) if one.channel is None else one.channel
            value[one.material, at] = np.clip(value[one.material, at] + by, 0, 1)
    following = job.at(vectors, state)._replace(numbers=numbers)
    known = None
    if "shininess" in job.names:
        known = RIDGE + next(_information(job, sums))[-1]
    return Stepped(following, sums.left, _taken(job, sums), known)


def descend(
    job: Job, state: State, sigma: float, damping: np.ndarray
) -> tuple[Stepped, np.ndarray]:
    """A step of texels' exponents, then of all other unknowns at the new exponents.

    Light is not linear in exponents. A step that would raise the cost is rejected, and
    texels around which the cost rises are damped, as by Levenberg and Marquardt.
    """
    stepped = step(job, state, sigma, damping=damping)
    assert state.exponents is not None and stepped.state.exponents is not None
    assert stepped.left.around is not None
    before = with_known(job, state, stepped.left.cost, stepped.left.around)
    wanted = stepped.state.exponents - state.exponents
    logs = state.exponents + np.clip(wanted, -REACH, REACH)
    tried = state._replace(exponents=logs)
    tried = step(job.without_exponents(), tried, sigma).state
    after = cost_of(job, tried, sigma)
    far = np.sqrt(np.mean((wanted * (1 + damping)) ** 2 * stepped.known))
    least = 1e-5 * max(before.whole, stepped.left.counted)
    settled = bool(far < SETTLED and abs(after.whole - before.whole) < least)
    if after.whole <= before.whole:
        return stepped._replace(state=tried, settled=settled), damping / 10
    worse = after.around > before.around
    damping = np.where(worse, np.maximum(10 * damping, 0.1), damping)
    return stepped._replace(state=state, settled=settled), damping


def _taken(job: Job, sums: Sums) -> float:
    """First estimate of the number of unknowns that samples determine."""
    return sum(
        float((own / (own + RIDGE)).sum(dtype=float))
        for fields in _information(job, sums)
        for own in fields
    )


def _information(job: Job, sums: Sums) -> Iterator[list[np.ndarray]]:
    """Each system's diagonal of the information about texels, field by field."""
    for blocks, fields in zip(sums.blocks, job.systems, strict=True):
        own = [blocks[p, p][0] for p in range(len(fields))]
        if sums.unit is not None:
            own[-1] = own[-1] * sums.unit[-job.grid.texels :] ** 2
        yield own


def _few_change(
    job: Job,
    state: State,
    information: np.ndarray,
    right: np.ndarray,
    reach: float | np.ndarray,
) -> np.ndarray:
    """Step of the shared numbers; 0 for those that would leave a bound.

    An exponent that would change by more than `reach` changes by `reach`, and the other
    numbers make the best of that.
    """
    free = np.diag(information) > 0
    limits = np.full(len(job.few), np.inf)
    materials = len(state.numbers["shininess"])
    for k, one in enumerate(job.few):
        value = state.value(one)
        low, high = EXPONENTS if one.name == "shininess" else (0.0, 1.0)
        if (value <= low and right[k] < 0) or (value >= high and right[k] > 0):
            free[k] = False
        if one.name == "shininess":
            limits[k] = np.broadcast_to(reach, materials)[one.material]
    change = _change_of(free, information, right)
    far = np.abs(change) > limits
    if far.any():
        held = np.where(far, np.clip(change, -limits, limits), 0)
        change = held + _change_of(free & ~far, information, right - information @ held)
    return np.clip(change, -limits, limits)


def _change_of(
    free: np.ndarray, information: np.ndarray, right: np.ndarray
) -> np.ndarray:
    """Step of the numbers that are `free`, 0 for the others.

    Combinations that the photographs do not determine keep their values.
    """
    change, at = np.zeros(len(free)), np.flatnonzero(free)
    if at.size:
        scale = np.sqrt(np.diag(information)[at])
        scaled = information[np.ix_(at, at)] / np.outer(scale, scale)
        inverse = np.linalg.pinv(scaled, rcond=LEAST, hermitian=True)
        change[at] = inverse @ (right[at] / scale) / scale
    return change


def solve(
    job: Job, state: State, sigma: float, noise_given: bool, max_steps: int
) -> tuple[State, float, System, bool, int]:
    """Take steps until nothing changes, and estimate the noise after each one.

    If a step of a shared exponent goes back on the one before, the next is at most
    half as long. Otherwise, without a clear highlight, steps could alternate for ever.
    """
    damping = np.zeros(job.grid.texels)
    reach = np.full_like(state.numbers["shininess"], REACH)
    last = np.zeros_like(reach)

    def following(state: State, damping: np.ndarray) -> tuple[Stepped, np.ndarray]:
        if "shininess" in job.names:
            return descend(job, state, sigma, damping)
        return step(job, state, sigma, reach=reach), damping

    (state, left, taken, *_), damping = following(state, damping)
    cost, converged, steps = np.inf, False, 1
    while steps < max_steps and not converged:
        if not noise_given:
            sigma = _noise(job, left, taken, sigma)
        (moved, left, taken, _, settled), damping = following(state, damping)
        now = left.cost * sigma**2
        least = 1e-5 * max(now, left.counted * job.floor**2)
        same = abs(cost - now) < least if settled is None else settled
        changes = _relative_changes(state, moved)
        largest = max(float(abs(one).max()) for one in changes.values())
        converged = same and largest < 1e-3
        change = changes["shininess"]
        turned = change * last < 0
        reach = np.where(turned, np.abs(change) / 2, np.minimum(2 * reach, REACH))
        last = change
        state, cost, steps = moved, now, steps + 1
    if not noise_given:
        sigma = _noise(job, left, taken, sigma)
        # Residuals at the last state, as `left` belongs to the one before.
        left, freedom = _left_over(job, state, sigma)
        sigma = max(sigma * float(np.sqrt(left.squares / freedom)), job.floor)
    return state, sigma, make_system(job, state, sigma), converged, steps


def _left_over(job: Job, state: State, sigma: float) -> tuple[ResidualSums, float]:
    """Residual sums and degrees of freedom at `state`."""
    sums = sum_up(job, state, sigma)
    taken = []
    for _, matrix, new in _matrices(job, sums):
        taken.append(taken_by(job, matrix) if new else taken[-1])
        del matrix
    return sums.left, _freedom(job, sums.left, sum(taken))


def _relative_changes(one: State, other: State) -> dict[str, np.ndarray]:
    """Changes of the logarithms of materials' parameters, by name; finite from 0 on."""
    return {
        name: np.log(other.numbers[name] + 1e-3) - np.log(value + 1e-3)
        for name, value in one.numbers.items()
    }


def _noise(job: Job, left: ResidualSums, taken: float, sigma: float) -> float:
    """A first estimate of the samples' standard deviation."""
    freedom = max(left.counted - taken - len(job.few), 0.1 * left.counted, 1.0)
    return max(sigma * float(np.sqrt(left.squares / freedom)), job.floor)


def _freedom(job: Job, left: ResidualSums, taken: float) -> float:
    """Degrees of freedom, samples − unknowns that they determine; at least 1."""
    return max(left.counted - taken - len(job.few), 1.0)


def taken_by(job: Job, matrix: AbstractSystem) -> float:
    """Number of one system's texels that the samples determine.

    It is the trace of the hat matrix, estimated with random probes.

    ??? cite "Source"
        Hutchinson, *A stochastic estimator of the trace of the influence matrix*,
        Commun. Stat. Simul. Comput. 19(2), 1990.
    """
    size = len(matrix.scale)
    # With more texels fewer probes are needed.
    shape = size, min(PROBES, at_once(size))
    probes = np.random.default_rng(1).choice([-1.0, 1.0], shape)
    prior = RIDGE * probes
    if job.smoothness is not None:
        by = [expected_differences(job, one) for one in probes.T]
        prior += np.stack(by, axis=1)
    return size - float((prior * matrix.solve(probes, 1e-3)).sum()) / shape[1]
