"""From the Jacobian at the solution to error bars, and to what they cannot say."""

import dataclasses

import numpy as np
from jaxtyping import Array, Float

from phongfit.fitting.noise import shared_rounding_variance
from phongfit.fitting.problem import Evaluation, Problem, linearize
from phongfit.fitting.unknowns import Unknowns


@dataclasses.dataclass(frozen=True)
class Statistics:
    """Uncertainty of a solution in the solver's units.

    `covariance` is that of the unknowns that are free and can be told: NaN for those at
    a bound, infinite variance for those that cannot be told. `stderr` is its root, save
    at a bound: there it is how far into the box the data let the unknown go (the cost
    rises by one σ²).
    """

    covariance: np.ndarray
    stderr: np.ndarray
    untold: np.ndarray
    at_bound: np.ndarray
    reasons: tuple[str, ...]


def statistics(
    problem: Problem, y: Float[Array, " n"], at: Evaluation, inflation: float
) -> Statistics:
    """Sandwich covariance of a bounded fit, its free part, and what cannot be told.

    **Arguments:**

    - `problem`, `y`, `at`: the problem, its solution, and [`evaluate`][] there.
    - `inflation`: factor on all variances for residuals that are not independent.
    """
    used = np.asarray(problem.samples.weight).ravel() > 0
    jacobian, psi, slope = linearize(problem, y)
    columns = np.asarray(jacobian, float).reshape(len(y), -1)[:, used]
    psi, slope = (np.asarray(part, float).ravel()[used] for part in (psi, slope))
    bread = columns @ columns.T
    meat = _meat(problem, at, columns, used)
    if np.ptp(slope) > 0:
        # A loss that bends: the variance of its score over its slope, squared.
        meat = meat * np.mean(psi**2) / np.mean(slope) ** 2
    position = np.asarray(y)
    lower, upper = (
        np.asarray(problem.unknowns.lower),
        np.asarray(problem.unknowns.upper),
    )
    at_bound = (position <= lower) | (position >= upper)
    resolution = float(np.finfo(y.dtype).eps)
    untold, reasons = _untold(bread, problem.unknowns, resolution)
    at_bound &= ~untold

    size = len(position)
    covariance = np.full((size, size), np.nan)
    free = ~at_bound
    inverse = _inverse(bread[np.ix_(free, free)], resolution)
    covariance[np.ix_(free, free)] = (
        inflation * inverse @ meat[np.ix_(free, free)] @ inverse
    )
    covariance[untold, :] = covariance[:, untold] = np.nan
    covariance[untold, untold] = np.inf
    stderr = np.sqrt(np.diag(covariance))
    pull = np.abs(columns @ psi)
    for k in np.flatnonzero(at_bound):
        others = np.append(np.flatnonzero(free & ~untold), k)
        inverse = _inverse(bread[np.ix_(others, others)], resolution)
        variance = (inverse @ meat[np.ix_(others, others)] @ inverse)[-1, -1]
        curvature = 1 / inverse[-1, -1]
        rise = inflation * variance * curvature
        # pull·d + curvature·d²/2 = rise/2, solved without cancellation.
        stderr[k] = rise / (pull[k] + np.sqrt(pull[k] ** 2 + rise * curvature))
    return Statistics(covariance, stderr, untold, at_bound, reasons)


def _meat(
    problem: Problem, at: Evaluation, columns: np.ndarray, used: np.ndarray
) -> np.ndarray:
    """Covariance of the sum of scores: independent noise, and shared rounding.

    A region of one colour rounds as one, so samples of one channel and level are taken
    to share the part of their rounding error that noise does not dither.
    """
    noise, deviation, share, step = (
        np.asarray(part, float).ravel()[used]
        for part in (at.noise, at.deviation, at.variance_share, problem.samples.step)
    )
    common = shared_rounding_variance(step, noise)
    alone = (noise**2 * share + step**2 / 12 - common) / deviation**2
    meat = (columns * alone) @ columns.T
    if np.any(common > 1e-6 * deviation**2):
        target = np.asarray(problem.samples.target).ravel()[used]
        channel = np.broadcast_to(np.arange(3), (len(used) // 3, 3)).ravel()[used]
        level = np.unique(target, return_inverse=True)[1]
        group = np.unique(level * 3 + channel, return_inverse=True)[1]
        sums = [
            np.bincount(group, weights=column * np.sqrt(common) / deviation)
            for column in columns
        ]
        meat = meat + np.array(sums) @ np.array(sums).T
    return meat


def _normalized(bread: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A matrix with a unit diagonal, and the roots of the old one (1 for 0)."""
    root = np.sqrt(np.diag(bread))
    root = np.where(root > 0, root, 1)
    return bread / np.outer(root, root), root


def _threshold(resolution: float) -> float:
    """Eigenvalue of a normalised JᵀJ below which a direction is rounding alone."""
    return max((32 * resolution) ** 2, 1e-14)


def _inverse(bread: np.ndarray, resolution: float) -> np.ndarray:
    """Inverse on the directions that can be told; 0 on the others."""
    normalized, root = _normalized(bread)
    values, vectors = np.linalg.eigh(normalized)
    told = values > _threshold(resolution)
    inverse = (vectors[:, told] / values[told]) @ vectors[:, told].T
    return inverse / np.outer(root, root)


_SILENT = {
    "ambient": "no ambient light falls on a pixel that is used",
    "diffuse": "no light falls on a pixel that is used, or all of these are white",
    "specular": "no pixel that is used sees a highlight",
    "shininess": "there is no highlight: specular is 0, or no pixel sees it",
    "emission": "all pixels that are used are white",
}


def _untold(
    bread: np.ndarray, unknowns: Unknowns, resolution: float
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Which unknowns the Jacobian leaves open, and why, in words."""
    labels = np.array(unknowns.labels)
    kinds = unknowns.kinds
    diagonal = np.diag(bread)
    silent = diagonal <= _threshold(resolution) * max(diagonal.max(), 1e-300)
    reasons = [
        f"{', '.join(labels[silent & (kinds == kind)])} cannot be told: {words}"
        for kind, words in _SILENT.items()
        if (silent & (kinds == kind)).any()
    ]
    untold = silent.copy()
    heard = np.flatnonzero(~silent)
    if len(heard):
        normalized, _ = _normalized(bread[np.ix_(heard, heard)])
        values, vectors = np.linalg.eigh(normalized)
        null = vectors[:, values <= _threshold(resolution)]
        # Vectors of one null space mix: the projection tells who takes part.
        part = null @ null.T
        mixed = np.diag(part) > 1e-4
        untold[heard[mixed]] = True
        for group in _groups(np.abs(part) > 1e-4, mixed):
            names = ", ".join(labels[heard[group]])
            reasons.append(f"{names} cannot be told apart: they change the image alike")
    return untold, tuple(reasons)


def _groups(linked: np.ndarray, members: np.ndarray) -> list[np.ndarray]:
    """Connected groups among the members of a symmetric relation."""
    left = set(np.flatnonzero(members).tolist())
    groups = []
    while left:
        group, frontier = set(), {min(left)}
        while frontier:
            group |= frontier
            near = {int(j) for i in frontier for j in np.flatnonzero(linked[i])}
            frontier = (near & left) - group
        left -= group
        groups.append(np.array(sorted(group)))
    return groups
