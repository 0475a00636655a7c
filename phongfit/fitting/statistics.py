"""From the Jacobian at the solution to error bars, and to what they cannot say."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from phongfit.fitting.leaves import LEAVES
from phongfit.fitting.noise import shared_rounding_variance
from phongfit.fitting.problem import Evaluation, Problem
from phongfit.fitting.sums import Linearization, linearize
from phongfit.fitting.unknowns import Unknowns
from phongfit.programs import program


@dataclasses.dataclass(frozen=True)
class Statistics:
    """Uncertainty of a solution in the solver's units.

    `covariance` is that of the unknowns that are free and can be told: NaN for those at
    a bound, infinite variance for those that cannot be told. `stderr` is its root, save
    at a bound: there it is how far into the box the data let the unknown go (the cost
    rises by one σ²). `apart` are the errors of the material's unknowns if those of the
    scenes were known; infinite for what no sample depends on.
    """

    covariance: np.ndarray
    stderr: np.ndarray
    apart: np.ndarray
    untold: np.ndarray
    at_bound: np.ndarray
    chi_squared: float
    reasons: tuple[str, ...]


def statistics(
    problem: Problem,
    y: Float[Array, " n"],
    inflation: float,
    pieces: "Pieces | None" = None,
) -> Statistics:
    """Sandwich covariance of a bounded fit, its free part, and what cannot be told.

    **Arguments:**

    - `problem`, `y`: the problem, and its solution.
    - `inflation`: factor on all variances for residuals that are not independent.
    - `pieces`: sums over the samples, if they are at hand.
    """
    found = _in_numpy(add_up(problem, y) if pieces is None else pieces)
    resolution = float(np.finfo(y.dtype).eps)
    exact = found.exact
    if _too_coarse(found.inside, resolution):
        found = _in_numpy(_pieces_in_double(problem, y))
    if exact:
        # What is left over is rounding of the arithmetic, which samples share.
        inflation = inflation * float(np.sum(np.asarray(problem.samples.weight) > 0))
    bread, meat = found.bread, found.meat
    if found.shared > 1e-6:
        meat = meat + found.loss_variance * _shared_rounding(problem, y)
    position = np.asarray(y)
    lower, upper = (
        np.asarray(problem.unknowns.lower),
        np.asarray(problem.unknowns.upper),
    )
    at_bound = (position <= lower) | (position >= upper)
    untold, reasons = _untold(found.inside, problem.unknowns, resolution)
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
    pull = np.abs(found.pull)
    for k in np.flatnonzero(at_bound):
        others = np.append(np.flatnonzero(free & ~untold), k)
        inverse = _inverse(bread[np.ix_(others, others)], resolution)
        variance = (inverse @ meat[np.ix_(others, others)] @ inverse)[-1, -1]
        curvature = 1 / inverse[-1, -1]
        rise = inflation * variance * curvature
        # pull·d + curvature·d²/2 = rise/2, solved without cancellation.
        stderr[k] = rise / (pull[k] + np.sqrt(pull[k] ** 2 + rise * curvature))
    apart = np.full(size, np.inf)
    material = np.isin(problem.unknowns.kinds, LEAVES)
    specular = problem.unknowns.kinds == "specular"
    audible = ~_silent(found.inside, resolution)
    heard = np.flatnonzero(material & (free | specular) & audible)
    inverse = _inverse(bread[np.ix_(heard, heard)], resolution)
    variance = np.diag(inverse @ meat[np.ix_(heard, heard)] @ inverse)
    apart[heard] = np.sqrt(inflation * np.maximum(variance, 0))
    return Statistics(
        covariance,
        stderr,
        apart,
        untold,
        at_bound,
        float(found.chi_squared),
        reasons,
    )


def _in_numpy(pieces: "Pieces") -> Any:
    return jax.tree.map(lambda part: np.asarray(part, float), pieces)


def _too_coarse(bread: np.ndarray, resolution: float) -> bool:
    """Whether sums of this precision leave open if a direction is told at all."""
    if resolution < 1e-10 or not np.all(np.isfinite(bread)):
        return False
    heard = np.diag(bread) > 0
    values = np.linalg.eigvalsh(_normalized(bread[np.ix_(heard, heard)])[0])
    return bool(np.any(values < 1e4 * resolution))


def _pieces_in_double(problem: Problem, y: Float[Array, " n"]) -> "Pieces":
    """The same derivatives, added up in double precision."""
    parts = problem, _linearize(problem, y)
    with jax.enable_x64(True):
        return _add_up(*jax.tree.map(_in_double, parts))


_linearize = eqx.filter_jit(linearize)


def _in_double(leaf: Any) -> Any:
    return jnp.asarray(np.asarray(leaf), float) if eqx.is_inexact_array(leaf) else leaf


class Pieces(eqx.Module):
    """Sums over the samples that all statistics are made of."""

    bread: Float[Array, "n n"]
    meat: Float[Array, "n n"]
    inside: Float[Array, "n n"]
    pull: Float[Array, " n"]
    loss_variance: Float[Array, ""]
    shared: Float[Array, ""]
    chi_squared: Float[Array, ""]
    exact: Bool[Array, ""]


@program()
def add_up(problem: Problem, y: Float[Array, " n"]) -> Pieces:
    """The sums at a solution."""
    return _add_up(problem, linearize(problem, y))


@eqx.filter_jit
def _add_up(problem: Problem, found: Linearization) -> Pieces:
    at, priors, jacobian = found.at, found.priors, found.jacobian
    samples = at.residual
    kind = samples.dtype
    used = problem.samples.weight > 0
    count = jnp.maximum(jnp.sum(used), 1).astype(kind)

    score, slope = problem.loss.score(samples)
    variance, steepness = jnp.ones((), kind), jnp.ones((), kind)
    if problem.loss.robust:
        # A loss that bends: the variance of its score, and its mean slope.
        variance = jnp.sum(jnp.where(used, score**2, 0)) / count
        steepness = jnp.sum(jnp.where(used, slope, 0)) / count
    independent, shared = at.variance_share, jnp.zeros((), kind)
    if problem.samples.step is not None:
        common = _common(problem, at)
        rounding = problem.samples.step**2 / 12
        alone = at.noise**2 * at.variance_share + rounding - common
        independent = alone / at.deviation**2
        shared = jnp.max(common / at.deviation**2)
    known = jacobian.priors.T @ jacobian.priors
    # A white sample tells only that the light is no less than white: what nothing else
    # speaks of is not told.
    told = (problem.samples.target < 1).astype(kind) if problem.clamp else None
    bread, meat, inside = jacobian.grams(None, independent, told)
    meat = variance * meat
    if problem.scatter is not None:
        root = jnp.sqrt(jnp.diag(bread))
        meat, shared = problem.scatter * jnp.outer(root, root), jnp.zeros((), kind)
    return Pieces(
        bread=steepness * bread + known,
        meat=meat + known,
        inside=inside + known,
        pull=jacobian.pull(score) + jacobian.priors.T @ priors,
        loss_variance=variance,
        shared=shared,
        chi_squared=jnp.sum(samples**2) + jnp.sum(priors**2),
        exact=_is_exact(problem, at),
    )


def _is_exact(problem: Problem, at: Evaluation) -> Bool[Array, ""]:
    """Whether nothing is left over but what arithmetic of this precision rounds."""
    exact = problem.sigma <= 1.01 * at.floor
    return exact & (problem.samples.step is None)


def _common(problem: Problem, at: Evaluation) -> Float[Array, "3 samples"]:
    """Variance of the rounding that samples of one level share."""
    step = problem.samples.step
    if step is None:
        return jnp.zeros_like(at.noise)
    return shared_rounding_variance(step, at.noise)


def _shared_rounding(problem: Problem, y: Float[Array, " n"]) -> np.ndarray:
    """Covariance of the sum of scores from rounding that samples share.

    A region of one colour rounds as one, so samples of one channel and level are taken
    to share the part of their rounding error that noise does not dither.
    """
    found = _linearize(problem, y)
    jacobian, common = found.jacobian, _common(problem, found.at)
    common = common / found.at.deviation**2
    used = np.asarray(problem.samples.weight).ravel() > 0
    columns = jacobian.columns().reshape(len(y), -1)[:, used]
    share = np.sqrt(np.asarray(common, float))
    target = np.asarray(problem.samples.target).ravel()[used]
    channel = np.repeat(np.arange(3), len(used) // 3)[used]
    level = np.unique(target, return_inverse=True)[1]
    group = np.unique(level * 3 + channel, return_inverse=True)[1]
    sums = [
        np.bincount(group, weights=column * share.ravel()[used]) for column in columns
    ]
    return np.array(sums) @ np.array(sums).T


def _normalized(bread: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A matrix with a unit diagonal, and the roots of the old one (1 for 0)."""
    root = np.sqrt(np.diag(bread))
    root = np.where(root > 0, root, 1)
    return bread / np.outer(root, root), root


def _threshold(resolution: float) -> float:
    """Eigenvalue of a normalised JᵀJ below which a direction is rounding alone."""
    return max((32 * resolution) ** 2, 1e-14)


def _silent(bread: np.ndarray, resolution: float) -> np.ndarray:
    """Unknowns that the samples do not feel."""
    diagonal = np.diag(bread)
    return diagonal <= _threshold(resolution) * max(diagonal.max(), 1e-300)


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
    labels = np.array(unknowns.y_labels)
    kinds = unknowns.kinds
    silent = _silent(bread, resolution)
    reasons = [
        f"{_listed(labels[silent & (kinds == kind)])} cannot be told: "
        + _SILENT.get(kind, "no pixel that is used depends on it")
        for kind in unknowns.names
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
            names = _listed(labels[heard[group]])
            if "," not in names:
                names += ": its two angles"
            reasons.append(f"{names} cannot be told apart: they change the image alike")
    return untold, tuple(reasons)


def _listed(labels: np.ndarray) -> str:
    """Names, each once."""
    return ", ".join(dict.fromkeys(labels.tolist()))


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
