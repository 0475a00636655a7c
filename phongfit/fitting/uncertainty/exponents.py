"""Intervals for barely identified exponents: quadratics over the exponent's range.

Without a highlight the exponent can have any value, and the other unknowns depend on
it: near f = 1 a highlight is nearly Lambert's light, at f = 1000 only a few pixels show
it. A quadratic about the solution does not describe this. For a given exponent light is
linear in all reflectances. So the exponent is held at points all over its bounds, the
others are fitted again, and about each point the cost is a quadratic.

??? cite "Source"
    Davies, *Hypothesis testing when a nuisance parameter is present only under the
    alternative*, Biometrika 64(2), 1977.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from phongfit.fitting.problem.problem import Problem
from phongfit.fitting.problem.unknowns import Unknowns
from phongfit.fitting.solve.solution import solve
from phongfit.fitting.solve.sums import moved_samples
from phongfit.fitting.uncertainty.identifiability import SEEN, linked_groups
from phongfit.fitting.uncertainty.intervals import Quadratic
from phongfit.fitting.uncertainty.region import Part
from phongfit.fitting.uncertainty.sandwich import Sandwich, as_quadratic
from phongfit.fitting.uncertainty.statistics import (
    SandwichSums,
    Statistics,
    in_numpy,
    quadratic_about,
    sandwich_at,
    sandwich_sums,
)
from phongfit.programs import program

# Number of exponents between the bounds; by default their ratio is 1.5.
GRID_POINTS = 16
MAX_STEPS = 30


class Doubts(NamedTuple):
    """Barely identified exponents.

    - `vague`: those for which one quadratic is not enough.
    - `unseen`: those whose highlight is not seen: all values are equally good, unless
        the fit gets much worse.
    - `faint`: those whose highlight is so faint that the noise may have determined the
        exponent.
    """

    vague: Bool[np.ndarray, " n"]
    unseen: Bool[np.ndarray, " n"]
    faint: Bool[np.ndarray, " n"]


class _GridPoint(NamedTuple):
    """The best fit for held exponents, and the increase of its cost.

    `rise` has an entry for each group of samples and each prior.
    """

    y: Float[np.ndarray, " n"]
    sandwich: Sandwich
    rise: Float[np.ndarray, " terms"]


def parts_over_exponents(
    problem: Problem,
    y: Float[Array, " n"],
    found: Statistics,
    inflation: float,
    doubts: Doubts,
) -> tuple[Part, ...]:
    """Quadratics that cover the bounds of exponents.

    **Arguments:** `y`, `found`: the solution and its statistics with this `inflation`.
    """
    felt, vague = _felt_terms(problem), doubts.vague
    groups = [np.arange(len(y))]
    if np.count_nonzero(vague) > 1:
        # Unknowns without a common sample are held and fitted again together.
        linked = felt.astype(int) @ felt.T.astype(int) > 0
        groups = linked_groups(linked, np.ones(len(y), bool))
    turns = max(np.count_nonzero(vague[group]) for group in groups)
    held = np.zeros((turns, len(y)), bool)
    for group in groups:
        exponents = group[vague[group]]
        held[np.arange(len(exponents)), exponents] = True
    solution = _GridPoint(np.asarray(y, float), found.sandwich, np.zeros(felt.shape[1]))
    grids = [_grid(problem, y, found, inflation, turn) for turn in held]

    def part(group: Int[np.ndarray, " k"]) -> Part:
        terms = np.any(felt[group], axis=0, keepdims=True)[0]
        quadratics = [
            quadratic
            for turn, grid in zip(held, grids, strict=True)
            for exponent in group[turn[group]]
            for quadratic in _cells(
                [*grid, solution],
                problem.unknowns,
                group,
                int(exponent),
                terms,
                bool(doubts.unseen[exponent]),
            )
        ]
        if not quadratics:
            whole = quadratic_about(found, problem.unknowns, solution.y, group)
            return Part(group, (whole,))
        searched = np.any((vague & doubts.faint)[group])
        return Part(group, tuple(quadratics), bool(searched))

    return tuple(map(part, groups))


def _felt_terms(problem: Problem) -> Bool[np.ndarray, "n terms"]:
    """Groups of samples, and priors, that depend on each unknown."""
    unknowns = problem.unknowns
    moved = moved_samples(unknowns).reshape(len(unknowns.y_entry), -1)
    with_prior = np.flatnonzero(unknowns.has_prior)
    indices = np.array(unknowns.y_index)[np.array(unknowns.source)[with_prior]]
    priors = np.arange(len(moved))[:, None] == indices[None]
    return np.column_stack([moved, priors])


def _grid(
    problem: Problem,
    y: Float[Array, " n"],
    found: Statistics,
    inflation: float,
    turn: Bool[np.ndarray, " n"],
) -> list[_GridPoint]:
    """The best fits with some exponents held at points all over their bounds."""
    shares = (np.arange(GRID_POINTS) + 0.5) / GRID_POINTS
    ends, rises, sums = _fit_with_held(problem, y, turn, shares.astype(y.dtype))
    sums = in_numpy(sums)
    scale = found.scale
    points = []
    for k, end in enumerate(ends):
        one = jax.tree.map(lambda leaf, k=k: leaf[k], sums)
        sandwich = sandwich_at(problem, end, inflation, one)
        rise = scale * np.asarray(rises[k], float)
        points.append(_GridPoint(np.asarray(end, float), sandwich, rise))
    return points


@program()
def _fit_with_held(
    problem: Problem,
    y: Float[Array, " n"],
    turn: Bool[np.ndarray | Array, " n"],
    shares: Float[np.ndarray | Array, " points"],
) -> tuple[Float[Array, "points n"], Float[Array, "points terms"], SandwichSums]:
    """Solutions with some unknowns held, the increases of the cost, and sums."""
    unknowns = problem.unknowns
    lower, upper = unknowns.lower, unknowns.upper

    def terms(y: Array) -> tuple[Array, Array]:
        return problem.loss.root(problem.residual(y)), unknowns.prior_residual(y)

    samples, priors = terms(y)
    group, count = problem.group(), moved_samples(unknowns).shape[1]
    member = group[None] == jnp.arange(count, dtype=group.dtype)[:, None]

    def at(
        near: Array, share: Array
    ) -> tuple[Array, tuple[Array, Array, SandwichSums]]:
        value = lower + share * (upper - lower)
        edges = jnp.where(turn, value, lower), jnp.where(turn, value, upper)
        held = eqx.tree_at(
            lambda p: (p.unknowns.lower, p.unknowns.upper), problem, edges
        )
        end = solve(held, jnp.where(turn, value, near), MAX_STEPS).y
        # Differences of squares before they are summed: a sum would round them away.
        there, priors_there = terms(end)
        rise = (there - samples) * (there + samples)
        rise = member.astype(rise.dtype) @ rise.T
        of_priors = (priors_there - priors) * (priors_there + priors)
        rise = jnp.concatenate([rise.ravel(), of_priors])
        return end, (end, rise, sandwich_sums(problem, end))

    return jax.lax.scan(at, y, jnp.asarray(shares))[1]


def _cells(
    points: list[_GridPoint],
    unknowns: Unknowns,
    group: Int[np.ndarray, " k"],
    exponent: int,
    felt: Bool[np.ndarray, " terms"],
    unseen: bool,
) -> list[Quadratic]:
    """Quadratics about points, each valid up to halfway to the next point.

    **Arguments:** `points`: the last is the solution.
    """
    box = unknowns.lower, unknowns.upper
    lower, upper = (np.array(edge, float)[group] for edge in box)
    (own,) = np.flatnonzero(group == exponent)
    solution = points[-1]
    # Points near the solution are left out, since its quadratic covers them.
    least = (upper[own] - lower[own]) / GRID_POINTS / 2
    here = solution.y[exponent]
    apart = [point for point in points[:-1] if abs(point.y[exponent] - here) > least]
    points = sorted([*apart, solution], key=lambda point: point.y[exponent])
    middles = np.array([point.y[exponent] for point in points])
    edges = (middles[1:] + middles[:-1]) / 2
    edges = np.concatenate([[lower[own]], edges, [upper[own]]])
    quadratics = []
    for k, point in enumerate(points):
        lower[own], upper[own] = edges[k], edges[k + 1]
        y = point.y[group]
        quadratic = as_quadratic(
            point.sandwich.part(group),
            lower - y,
            upper - y,
            steep=(group == exponent) & (point is not solution),
            rise=float(point.rise[felt].sum()),
            center=y - solution.y[group],
        )
        if unseen and quadratic.least < SEEN**2:
            rise = quadratic.rise - quadratic.least
            quadratic = dataclasses.replace(quadratic, rise=rise)
        quadratics.append(quadratic)
    return quadratics
