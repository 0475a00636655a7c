r"""Gauss and Newton's steps: texels eliminated, a small system for what is shared.

The texels, which are many and hardly coupled, are eliminated by a sparse solve; what is
left is the Schur complement of the shared numbers.

??? cite "Source"
    Variable projection: Golub and Pereyra, *Separable nonlinear least squares*, Inverse
    Problems 19(2), 2003; the elimination is that of bundle adjustment, Triggs et al.,
    *Bundle adjustment: a modern synthesis*, 1999.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from phongfit.fitting.texels.equations import Sums, make_systems, sum_up
from phongfit.fitting.texels.job import EXPONENTS, PRIOR, Job, State
from phongfit.fitting.texels.solve import Preconditioned

SCAN = np.geomspace(2.0, 700.0, 11)
"""Exponents among which a fit starts, each with the texels that suit it best."""

TOLERANCE = 1e-5
"""Of the sparse solves, relative to their right-hand sides."""

PROBES = 8
"""Random vectors that the trace of a large matrix is estimated from."""

LEAST = 1e-7
"""Eigenvalue of the shared numbers' scaled information that none is identified by."""


def find_start(
    job: Job, numbers: dict[str, np.ndarray], noise_given: bool
) -> tuple[State, float]:
    """Where to start: the best of some exponents, each material on its own.

    Each sample sees the nearest texel alone, which is then solved for at once.
    """
    sigma = 1.0 if noise_given else 0.02
    seek = any(one.name == "shininess" for one in job.few)
    linear = dataclasses.replace(
        job, few=[one for one in job.few if one.name != "shininess"]
    )
    best_cost = np.full(len(numbers["shininess"]), np.inf)
    best = numbers["shininess"].copy()
    texels = np.full((3, job.size), PRIOR[0])
    state = State(texels, numbers)
    for f in SCAN if seek else ():
        tried = State(
            texels, numbers | {"shininess": np.full_like(numbers["shininess"], f)}
        )
        stepped, _ = step(linear, tried, sigma, nearest=True)
        cost = sum_up(linear, stepped, sigma, nearest=True).cost
        better = cost < best_cost
        best, best_cost = np.where(better, f, best), np.where(better, cost, best_cost)
    state = State(texels, numbers | {"shininess": best})
    state, _ = step(linear, state, sigma)
    return state, sigma


class System(NamedTuple):
    """The last step's equations: what errors are made of."""

    sums: Sums
    matrices: list[Preconditioned]
    eliminated: list[np.ndarray]
    information: np.ndarray


def step(
    job: Job, state: State, sigma: float, nearest: bool = False
) -> tuple[State, System]:
    """One step of Gauss and Newton's, within the bounds."""
    sums = sum_up(job, state, sigma, nearest)
    matrices, right = make_systems(job, sums, state)
    information, few_right = sums.dense.copy(), sums.few_right.copy()
    solutions, eliminated = [], []
    for c, matrix in enumerate(matrices):
        at_low = (state.texels[c] <= 0) & (right[c] < 0)
        at_high = (state.texels[c] >= 1) & (right[c] > 0)
        free = ~(at_low | at_high)
        both = np.column_stack([right[c], sums.mixed[c]])
        solved = matrix.solve(both, TOLERANCE, free)
        shared = job.of_channel(c)
        known = (sums.mixed[c] * free[:, None]).T @ solved[:, 1:]
        information[np.ix_(shared, shared)] -= known
        few_right[shared] -= solved[:, 1:].T @ right[c]
        solutions.append(solved[:, 0])
        eliminated.append(solved[:, 1:])
    information = (information + information.T) / 2
    change = _few_change(job, state, information, few_right)
    texels = state.texels.copy()
    for c, solution in enumerate(solutions):
        moved = solution - eliminated[c] @ change[job.of_channel(c)]
        texels[c] = np.clip(texels[c] + moved, 0, 1)
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
    return State(texels, numbers), System(sums, matrices, eliminated, information)


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
    state, system = step(job, state, sigma)
    cost, converged, steps = np.inf, False, 1
    while steps < max_steps and not converged:
        if not noise_given:
            sigma = _noise(job, system.sums, sigma)
        following, system = step(job, state, sigma)
        now = float(system.sums.cost.sum()) * sigma**2
        least = 1e-5 * max(now, system.sums.counted * job.floor**2)
        converged = abs(cost - now) < least and _moved(state, following) < 1e-3
        state, cost, steps = following, now, steps + 1
    if not noise_given:
        sigma = _noise(job, system.sums, sigma)
    # Where it stands now, with the noise as it is.
    system = step(job, state, sigma)[1]
    if not noise_given:
        found = sigma * np.sqrt(system.sums.residual / freedom_of(job, system))
        sigma = max(float(found), job.floor)
        system = step(job, state, sigma)[1]
    return state, sigma, system, converged, steps


def _moved(one: State, other: State) -> float:
    """The largest change of a material's number, relative to it."""
    return max(
        float(abs(np.log(other.numbers[name] + 1e-3) - np.log(value + 1e-3)).max())
        for name, value in one.numbers.items()
    )


def _noise(job: Job, sums: Sums, sigma: float) -> float:
    """A first estimate: a texel takes a sample away where it has one."""
    ridge = 1 / PRIOR[1] ** 2
    taken = sum(
        float((blocks[p, p][0] / (blocks[p, p][0] + ridge)).sum())
        for blocks in sums.blocks
        for p in range(len(job.names))
    )
    freedom = max(sums.counted - taken - len(job.few), 0.1 * sums.counted, 1.0)
    return max(sigma * float(np.sqrt(sums.residual / freedom)), job.floor)


def freedom_of(job: Job, system: System) -> float:
    """Samples less the numbers that they determine: the trace of the hat matrix.

    ??? cite "Source"
        Hutchinson, *A stochastic estimator of the trace of the influence matrix*,
        Commun. Stat. Simul. Comput. 19(2), 1990.
    """
    random = np.random.default_rng(1)
    taken, known = float(len(job.few)), {}
    for matrix in system.matrices:
        if id(matrix) not in known:
            probes = random.choice([-1.0, 1.0], (job.size, PROBES))
            solved = matrix.solve(probes, 1e-3)
            prior = probes / PRIOR[1] ** 2
            if job.smoothness is not None:
                prior = prior + job.smoothness @ probes
            known[id(matrix)] = job.size - float((prior * solved).sum()) / PROBES
        taken += known[id(matrix)]
    return max(system.sums.counted - taken, 1.0)
