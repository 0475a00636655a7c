"""Profile likelihood: the cost with an unknown held, and all others fitted again."""

import dataclasses
from collections.abc import Iterable, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.fitting.problem.problem import Problem
from phongfit.fitting.problem.unknowns import Unknowns
from phongfit.fitting.solve.search import SearchResult
from phongfit.fitting.solve.solution import solve
from phongfit.fitting.uncertainty.numbers import number_with_error
from phongfit.fitting.uncertainty.quantiles import fisher_quantile, student_reach
from phongfit.fitting.uncertainty.statistics import quadratic_about, statistics
from phongfit.programs import program

# One, two and three standard deviations of a normal distribution.
LEVELS = (0.6827, 0.9545, 0.9973)
# Step of a profile in standard errors, and the distance after which steps grow.
STEP, FARTHEST = 0.5, 16
# Points along each axis of a pair.
ACROSS = 15
# Most points of a profile on one side.
MOST_POINTS = 60
MAX_STEPS = 50


@dataclasses.dataclass(frozen=True)
class Profile:
    """Increase of the cost with one unknown held.

    **Arguments:**

    - `label`: the unknown.
    - `values`: values at which it was held, increasing; user's units.
    - `rise`: Δχ² there, scaled such that it is (Δ/standard error)² near the estimate.
    - `intervals`: level → (low, high); an end is a bound if Δχ² does not reach the
        level.
    """

    label: str
    values: np.ndarray
    rise: np.ndarray
    intervals: dict[float, tuple[float, float]]

    def __str__(self) -> str:
        rows = [f"{self.label}: profile-likelihood intervals"]
        for level, (low, high) in self.intervals.items():
            ends = (number_with_error(end, (high - low) / 2) for end in (low, high))
            rows.append(f"  {100 * level:5.2f} %  {' … '.join(ends)}")
        return "\n".join(rows)


@dataclasses.dataclass(frozen=True)
class ProfilePair:
    """Increase of the cost with two unknowns held.

    **Arguments:**

    - `labels`: the two.
    - `values`: values at which each was held, user's units.
    - `rise`: Δχ², (values of the first, values of the second).
    - `thresholds`: level → the Δχ² that bounds its region.
    """

    labels: tuple[str, str]
    values: tuple[np.ndarray, np.ndarray]
    rise: np.ndarray
    thresholds: dict[float, float]


def profile(
    found: SearchResult,
    label: str,
    freedom: int,
    levels: tuple[float, ...] = LEVELS,
    inflation: float = 1.0,
) -> Profile:
    """The profile of one unknown: see [`Fit`][]`.profile`.

    **Arguments:** `inflation`: factor on all variances, as of the standard errors.
    """
    _check_levels(levels)
    held = _Held(found, [label], inflation)
    (index,) = held.indices
    reach = {p: student_reach(p, freedom) for p in levels}
    farthest = max(reach.values())
    sides = [held.walk(index, sign, farthest) for sign in (-1, 1)]
    points = np.array([*reversed(sides[0][1:]), *sides[1]])
    y, roots = points.T
    values = held.values(index, y)
    signed = np.where(np.arange(len(y)) < len(sides[0]) - 1, -roots, roots)
    low, high = held.box(index)
    intervals = {
        level: (
            _crossing(values[: len(sides[0])], signed[: len(sides[0])], -far, low),
            _crossing(
                values[len(sides[0]) - 1 :], signed[len(sides[0]) - 1 :], far, high
            ),
        )
        for level, far in reach.items()
    }
    return Profile(label, values, roots**2, intervals)


def profile_pair(
    found: SearchResult,
    labels: tuple[str, str],
    freedom: int,
    levels: tuple[float, ...] = LEVELS,
    inflation: float = 1.0,
) -> ProfilePair:
    """The profile of two unknowns on a grid: see [`Fit`][]`.profile`."""
    _check_levels(levels)
    if labels[0] == labels[1]:
        raise ValueError(f"other: expected two unknowns, got {labels[1]!r} twice")
    held = _Held(found, labels, inflation)
    freedom = max(freedom, 1)
    thresholds = {p: 2 * fisher_quantile(p, 2, freedom) for p in levels}
    farthest = 1.15 * np.sqrt(max(thresholds.values()))
    grids = [held.grid(index, farthest, ACROSS) for index in held.indices]
    rise = np.zeros((ACROSS, ACROSS))
    for i, first in enumerate(grids[0]):
        y = held.best
        # In alternating directions, so that each point starts from its neighbour.
        order = range(ACROSS) if i % 2 == 0 else reversed(range(ACROSS))
        for j in order:
            at = dict(zip(held.indices, (first, grids[1][j]), strict=True))
            rise[i, j], y = held.rise(at, y)
    first, second = (
        held.values(index, grid)
        for index, grid in zip(held.indices, grids, strict=True)
    )
    return ProfilePair((labels[0], labels[1]), (first, second), rise, thresholds)


def _check_levels(levels: Sequence[float]) -> None:
    if not len(levels):
        raise ValueError("levels: expected at least one, got none")
    for level in levels:
        if not 0 < level < 1:
            raise ValueError(f"levels: expected numbers in (0, 1), got {level!r}")


def _crossing(
    values: np.ndarray, signed: np.ndarray, level: float, bound: float
) -> float:
    """Value at which the signed root of the rise meets a level, or the bound."""
    rising = np.append(True, signed[1:] > np.maximum.accumulate(signed)[:-1])
    values, signed = values[rising], signed[rising]
    if len(values) < 2 or not signed[0] <= level <= signed[-1]:
        return bound
    # Imported here, since SciPy takes long to import and few fits need a profile.
    from scipy.interpolate import PchipInterpolator

    return float(PchipInterpolator(signed, values)(level))


class _Held:
    """A solved problem, to be solved again with some unknowns held."""

    def __init__(self, found: SearchResult, labels: Iterable[str], inflation: float):
        self.problem, self.best = found.problem, found.y
        unknowns = found.problem.unknowns
        given = zip(("name", "other"), labels, strict=False)
        self.indices = [_index(unknowns, *pair) for pair in given]
        self.lower = np.asarray(unknowns.lower)
        self.upper = np.asarray(unknowns.upper)
        at_best = statistics(found.problem, found.y, inflation)
        about = quadratic_about(
            at_best, unknowns, np.asarray(found.y, float), np.arange(len(self.lower))
        )
        along = np.eye(len(self.lower))[self.indices]
        self.errors = np.zeros(len(self.lower))
        self.errors[self.indices] = np.abs(about.ends(along, 1.0)).max(axis=1)
        # The profile is scaled, since the covariance differs from the inverse
        # curvature.
        ratios = (at_best.spread / at_best.stderr)[self.indices]
        ratios = ratios[np.isfinite(at_best.stderr[self.indices])]
        self.scale = float(np.mean(ratios)) ** 2 if len(ratios) else 1.0
        self.least = total_cost(self.problem, self.best)

    def rise(
        self, at: dict[int, float], start: Float[Array, " n"]
    ) -> tuple[float, Float[Array, " n"]]:
        """Δχ² with some numbers of y held, and the y of this minimum."""
        lower, upper, y = (
            np.array(a) for a in (self.lower, self.upper, np.asarray(start))
        )
        for index, value in at.items():
            lower[index] = upper[index] = y[index] = value
        held = eqx.tree_at(
            lambda p: (p.unknowns.lower, p.unknowns.upper),
            self.problem,
            (jnp.asarray(lower), jnp.asarray(upper)),
        )
        solution = solve(held, jnp.asarray(y), MAX_STEPS)
        squares = total_cost(self.problem, solution.y)
        return max(squares - self.least, 0.0) * self.scale, solution.y

    def walk(self, index: int, sign: int, farthest: float) -> list[tuple[float, float]]:
        """(y, √Δχ²) from the estimate outwards, until past `farthest` or a bound."""
        y, edge = self.best, (self.lower if sign < 0 else self.upper)[index]
        here = float(np.asarray(y)[index])
        points, step = [(here, 0.0)], STEP * self.errors[index]
        while points[-1][1] < 1.05 * farthest and here != edge:
            if len(points) > FARTHEST / STEP:
                # Far away, steps grow if the cost hardly rises.
                step *= 2
            here = here + sign * step
            if sign * (here - edge) >= 0 or len(points) > MOST_POINTS:
                here = float(edge)
            if not np.isfinite(here):
                break
            rise, y = self.rise({index: here}, y)
            points.append((here, float(np.sqrt(rise))))
        return points

    def grid(self, index: int, farthest: float, count: int) -> np.ndarray:
        """Values of one number of y around the estimate, in the box."""
        center = float(np.asarray(self.best)[index])
        reach = farthest * self.errors[index]
        low = max(center - reach, float(self.lower[index]))
        high = min(center + reach, float(self.upper[index]))
        return np.linspace(low, high, count)

    def values(self, index: int, y: np.ndarray) -> np.ndarray:
        """Values of one number of y in the user's units."""
        unknowns = self.problem.unknowns
        if unknowns.logarithmic[index]:
            return np.exp(y)
        return y * float(unknowns.scale[unknowns.y_entry[index]])

    def box(self, index: int) -> tuple[float, float]:
        """The bounds of one number of y in the user's units."""
        unknowns = self.problem.unknowns
        entry = unknowns.y_entry[index]
        (row,) = np.flatnonzero(unknowns.reported == entry)
        return tuple(unknowns.bounds[row].tolist())


def _index(unknowns: Unknowns, argument: str, label: str) -> int:
    labels = list(unknowns.free_labels)
    free = [one for one in unknowns.labels if labels.count(one) == 1]
    if label not in free:
        there = ", ".join(free)
        raise ValueError(f"{argument}: expected one of {there}, got {label!r}")
    return labels.index(label)


def total_cost(problem: Problem, y: Float[Array, " n"]) -> float:
    """The cost, added up in double precision: profiles are small differences of it."""
    samples, priors = _costs(problem, y)
    return float(np.sum(np.asarray(samples, float)) + np.sum(np.asarray(priors, float)))


@program()
def _costs(problem: Problem, y: Float[Array, " n"]) -> tuple[Array, Array]:
    samples = problem.loss.root(problem.residual(y)) ** 2
    return samples, problem.unknowns.prior_residual(y) ** 2
