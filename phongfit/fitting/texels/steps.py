r"""Gauss and Newton's steps: texels eliminated, a small system for what is shared.

The texels, which are many and hardly coupled, are eliminated by a sparse solve; what is
left is the Schur complement of the shared numbers.

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
    Left,
    Sums,
    costs,
    is_like_last,
    make_matrix,
    right_side,
    sum_up,
)
from phongfit.fitting.texels.job import EXPONENTS, PRIOR, Job, State
from phongfit.fitting.texels.solve import Preconditioned, at_once, inverse_diagonal

SCAN = np.geomspace(2.0, 700.0, 11)
"""Exponents among which a fit starts, each with the texels that suit it best."""

TOLERANCE = 1e-5
"""Of the sparse solves, relative to their right-hand sides."""

PROBES = 8
"""Random vectors that the trace of a large matrix is estimated from."""

LEAST = 1e-7
"""Eigenvalue of the shared numbers' scaled information that none is identified by."""


START = 4_000_000
"""Pixels of photographs among which a fit starts, at the most; then one of several."""


def find_start(
    job: Job, numbers: dict[str, np.ndarray], noise_given: bool
) -> tuple[State, float]:
    """Where to start: the best of some exponents, each material on its own.

    Each sample sees the nearest texel alone, which is then solved for at once. Of many
    photographs some of the pixels, and larger texels, do.
    """
    sigma = 1.0 if noise_given else 0.02
    seek = any(one.name == "shininess" for one in job.few)
    linear = dataclasses.replace(
        job, few=[one for one in job.few if one.name != "shininess"]
    )
    if seek:
        numbers = numbers | {"shininess": _scan(_thinned(linear), numbers, sigma)}
    state = State(np.full((3, job.size), PRIOR[0]), numbers)
    return step(linear, state, sigma).state, sigma


def _thinned(job: Job) -> Job:
    """Some of the pixels, and as many texels fewer."""
    whole = job.images
    every = -(-sum(one.image[..., 0].size for one in whole.given) // START)
    if every == 1:
        return job
    grid = whole.grid.coarser(round(every**0.5))
    some = dataclasses.replace(whole, grid=grid, every=every)
    return dataclasses.replace(job, images=some, smoothness=None)


def _scan(job: Job, numbers: dict[str, np.ndarray], sigma: float) -> np.ndarray:
    """The exponent of each material whose other numbers fit best."""
    best = numbers["shininess"]
    least = np.full(len(best), np.inf)
    texels = np.full((3, job.size), PRIOR[0])
    for f in SCAN:
        tried = State(texels, numbers | {"shininess": np.full_like(best, f)})
        stepped = step(job, tried, sigma, nearest=True).state
        cost = costs(job, stepped, sigma)
        best, least = np.where(cost < least, f, best), np.minimum(cost, least)
    return best


class Equations(NamedTuple):
    """Of the texels right-hand sides, and which are free to move; the rest in sums."""

    sums: Sums
    right: np.ndarray
    free: np.ndarray


def linearise(job: Job, state: State, sigma: float, nearest: bool = False) -> Equations:
    """The equations of a step of Gauss and Newton's; texels at a bound stay there."""
    sums = sum_up(job, state, sigma, nearest)
    right = right_side(job, sums, state)
    at_low = (state.texels <= 0) & (right < 0)
    at_high = (state.texels >= 1) & (right > 0)
    return Equations(sums, right, ~(at_low | at_high))


class System(NamedTuple):
    """What errors are made of.

    - `alone`: variances of each channel's texels, were the shared numbers known.
    - `eliminated`: how each channel's texels answer to the shared numbers.
    - `information`: of these, the texels being eliminated.
    - `freedom`: samples less the numbers that they determine.
    """

    left: Left
    alone: np.ndarray
    eliminated: list[np.ndarray]
    information: np.ndarray
    freedom: float


def _matrices(job: Job, sums: Sums) -> Iterator[tuple[int, Preconditioned, bool]]:
    """Each channel's matrix, and whether it is another than the last channel's.

    Matrices are what is largest: the last one goes before the next is made, where who
    takes them deletes them.
    """
    last: list[Preconditioned] = []
    for c in range(3):
        new = not is_like_last(sums, c)
        if new:
            last.clear()
            last.append(make_matrix(job, sums, c))
        yield c, last[0], new


def make_system(job: Job, state: State, sigma: float) -> System:
    """The equations where a fit ends, solved for the shared numbers alone."""
    sums, _, free = linearise(job, state, sigma)
    information, eliminated = sums.dense.copy(), []
    alone, taken = np.empty((3, job.size)), np.zeros(3)
    for c, matrix, new in _matrices(job, sums):
        if new:
            alone[c] = inverse_diagonal(matrix, job.grid, len(job.names))
            taken[c] = taken_by(job, matrix)
        else:
            alone[c], taken[c] = alone[c - 1], taken[c - 1]
        mixed, own = sums.mixed[c], free[c]
        solved = matrix.solve(mixed, TOLERANCE, own)
        shared = job.of_channel(c)
        information[np.ix_(shared, shared)] -= _products(mixed, solved, own)
        eliminated.append(solved.astype(job.dtype))
        del matrix
    information = (information + information.T) / 2
    freedom = _freedom(job, sums.left, float(taken.sum()))
    return System(sums.left, alone, eliminated, information, freedom)


def _products(mixed: np.ndarray, solved: np.ndarray, free: np.ndarray) -> np.ndarray:
    r"""$m^T s$ of the texels that are free, column by column."""
    each = [
        [float(np.sum(m * s, where=free, dtype=float)) for s in solved.T]
        for m in mixed.T
    ]
    return np.array(each).reshape(mixed.shape[1], solved.shape[1])


class Stepped(NamedTuple):
    """A step's end; of its beginning what was `left`, and `taken` by the texels."""

    state: State
    left: Left
    taken: float


def step(job: Job, state: State, sigma: float, nearest: bool = False) -> Stepped:
    """One step of Gauss and Newton's, within the bounds."""
    sums, right, free = linearise(job, state, sigma, nearest)
    information, few_right = sums.dense.copy(), sums.few_right.copy()
    moves, eliminated = [], []
    for c, matrix, _ in _matrices(job, sums):
        moves.append(matrix.solve(right[c][:, None], TOLERANCE, free[c])[:, 0])
        mixed = sums.mixed[c]
        solved = matrix.solve(mixed, TOLERANCE, free[c])
        shared = job.of_channel(c)
        information[np.ix_(shared, shared)] -= _products(mixed, solved, free[c])
        few_right[shared] -= solved.T @ right[c]
        eliminated.append(solved.astype(job.dtype))
        del matrix
    information = (information + information.T) / 2
    change = _few_change(job, state, information, few_right)
    texels = state.texels.copy()
    for c, move in enumerate(moves):
        move -= eliminated[c] @ change[job.of_channel(c)]
        texels[c] = np.clip(texels[c] + move, 0, 1)
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
    return Stepped(State(texels, numbers), sums.left, _taken(job, sums))


def _taken(job: Job, sums: Sums) -> float:
    """A first estimate: a texel takes a sample away where it has one."""
    ridge = 1 / PRIOR[1] ** 2
    return sum(
        float((blocks[p, p][0] / (blocks[p, p][0] + ridge)).sum(dtype=float))
        for blocks in sums.blocks
        for p in range(len(job.names))
    )


def _few_change(
    job: Job, state: State, information: np.ndarray, right: np.ndarray
) -> np.ndarray:
    """The step of the shared numbers; none for those at a bound that push outwards."""
    free = np.diag(information) > 0
    for k, one in enumerate(job.few):
        value = state.value(one)
        low, high = EXPONENTS if one.name == "shininess" else (0.0, 1.0)
        if (value <= low and right[k] < 0) or (value >= high and right[k] > 0):
            free[k] = False
    change = np.zeros(len(job.few))
    at = np.flatnonzero(free)
    if at.size:
        scale = np.sqrt(np.diag(information)[at])
        scaled = information[np.ix_(at, at)] / np.outer(scale, scale)
        # What the photographs do not tell apart stays where it is.
        inverse = np.linalg.pinv(scaled, rcond=LEAST, hermitian=True)
        change[at] = inverse @ (right[at] / scale) / scale
    for k, one in enumerate(job.few):
        if one.name == "shininess":
            change[k] = np.clip(change[k], -1, 1)
    return change


def solve(
    job: Job, state: State, sigma: float, noise_given: bool, max_steps: int
) -> tuple[State, float, System, bool, int]:
    """Steps until nothing changes, with the noise that is found on the way."""
    state, left, taken = step(job, state, sigma)
    cost, converged, steps = np.inf, False, 1
    while steps < max_steps and not converged:
        if not noise_given:
            sigma = _noise(job, left, taken, sigma)
        following, left, taken = step(job, state, sigma)
        now = left.cost * sigma**2
        least = 1e-5 * max(now, left.counted * job.floor**2)
        converged = abs(cost - now) < least and _moved(state, following) < 1e-3
        state, cost, steps = following, now, steps + 1
    if not noise_given:
        sigma = _noise(job, left, taken, sigma)
        # Where it stands now.
        left, freedom = _left_over(job, state, sigma)
        sigma = max(sigma * float(np.sqrt(left.squares / freedom)), job.floor)
    return state, sigma, make_system(job, state, sigma), converged, steps


def _left_over(job: Job, state: State, sigma: float) -> tuple[Left, float]:
    """What is left of the photographs, and the samples that determine nothing."""
    sums = sum_up(job, state, sigma)
    taken = np.zeros(3)
    for c, matrix, new in _matrices(job, sums):
        taken[c] = taken_by(job, matrix) if new else taken[c - 1]
        del matrix
    return sums.left, _freedom(job, sums.left, float(taken.sum()))


def _moved(one: State, other: State) -> float:
    """The largest change of a material's number, relative to it."""
    return max(
        float(abs(np.log(other.numbers[name] + 1e-3) - np.log(value + 1e-3)).max())
        for name, value in one.numbers.items()
    )


def _noise(job: Job, left: Left, taken: float, sigma: float) -> float:
    """A first estimate of the samples' standard deviation."""
    freedom = max(left.counted - taken - len(job.few), 0.1 * left.counted, 1.0)
    return max(sigma * float(np.sqrt(left.squares / freedom)), job.floor)


def _freedom(job: Job, left: Left, taken: float) -> float:
    """Samples less the numbers that they determine."""
    return max(left.counted - taken - len(job.few), 1.0)


def taken_by(job: Job, matrix: Preconditioned) -> float:
    """How many numbers the samples determine of one channel's texels.

    The trace of the hat matrix, by random probes.

    ??? cite "Source"
        Hutchinson, *A stochastic estimator of the trace of the influence matrix*,
        Commun. Stat. Simul. Comput. 19(2), 1990.
    """
    random, each = np.random.default_rng(1), at_once(job.size)
    known = 0.0
    for start in range(0, PROBES, each):
        sides = min(each, PROBES - start)
        probes = random.choice([-1.0, 1.0], (job.size, sides))
        prior = probes / PRIOR[1] ** 2
        if job.smoothness is not None:
            prior = prior + job.smoothness @ probes
        known += float((prior * matrix.solve(probes, 1e-3)).sum()) / PROBES
    return job.size - known
