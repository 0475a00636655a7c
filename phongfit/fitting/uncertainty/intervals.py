r"""Profile intervals of a quadratic cost in a box.

Near a solution the cost is a quadratic in a box. Its profile along one number (the
minimum over all others in the box) is convex and consists of parabolas. They are
followed outwards, from one change of the active bounds to the next, until
$\Delta\chi^2$ reaches the level. So the interval of a number that is correlated with
one at its bound is wide on the side to which the bound leaves room.

??? cite "Source"
    Self and Liang, *Asymptotic properties of maximum likelihood estimators and
    likelihood ratio tests under nonstandard conditions*, J. Am. Stat. Assoc. 82, 1987.
    Nocedal and Wright, *Numerical optimization*, 2nd ed., chapter 16: active sets.
"""

import dataclasses
import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

# Directions that the data do not determine get a standard deviation of this many widths
# of the box: the box limits them, and matrices can be inverted.
WIDTHS = 30.0
# Precision of undetermined directions without a box, relative to that of each number
# alone.
SHARE = 1e-15


@dataclasses.dataclass(frozen=True, eq=False)
class Quadratic:
    r"""$\Delta\chi^2 = r + 2 g \cdot p + p^\top P p$ for steps $p$ in a box.

    **Arguments:**

    - `precision`: $P$, the inverse of the covariance without bounds.
    - `slope`: $g$: 0 for free numbers; for those at a bound, the cost would fall beyond
        it.
    - `lower`, `upper`: the box, in steps from the point.
    - `rise`: $r$, $\Delta\chi^2$ of the point from the solution.
    - `center`: the point, as a step from the solution.
    """

    precision: Float[np.ndarray, "n n"]
    slope: Float[np.ndarray, " n"]
    lower: Float[np.ndarray, " n"]
    upper: Float[np.ndarray, " n"]
    rise: float
    center: Float[np.ndarray, " n"]

    @functools.cached_property
    def least(self) -> float:
        """Minimum of Δχ² in the box."""
        return self.rise + self._bottom.depth

    def ends(
        self, along: Float[np.ndarray, "k n"], level: float
    ) -> Float[np.ndarray, "k 2"]:
        r"""The least and largest $a \cdot (c + p)$ with $\Delta\chi^2$ up to a level.

        **Arguments:** `along`: the vectors $a$, as rows.

        **Returns:** NaN if Δχ² is above the level everywhere.
        """
        if self.least > level:
            return np.full((len(along), 2), np.nan)
        return self._ends(along, level) + (along @ self.center)[:, None]

    def _ends(self, along: Float[np.ndarray, "k n"], level: float) -> np.ndarray:
        budget = level - self.rise
        center = -self._covariance @ self.slope
        room = budget - self.slope @ center
        spread = np.sqrt(np.einsum("ki,ij,kj->k", along, self._covariance, along))
        open_ends = (along @ center)[:, None] + np.sqrt(room) * spread[:, None] * SIDES
        near = self._near(budget)
        if not near.any():
            return open_ends
        reduced = self._reduced(near)
        start = self._bottom.point[near]
        functionals = reduced.functionals(along)
        both = np.repeat(functionals, 2, axis=0)
        signs = np.tile(SIDES, len(along))
        walked = reduced.walk(
            np.append(start, 0), both, signs, budget - self._bottom.depth
        )
        reached = walked.reached.reshape(-1, 2)
        ended = walked.ended.reshape(-1, 2)
        return np.where(ended, reached, open_ends)

    @functools.cached_property
    def _covariance(self) -> Float[np.ndarray, "n n"]:
        root = np.sqrt(np.diag(self.precision))
        return np.linalg.inv(self.precision / np.outer(root, root)) / np.outer(
            root, root
        )

    def _near(self, budget: float) -> Bool[np.ndarray, " n"]:
        """Numbers that may meet their bounds before the level is reached."""
        center = -self._covariance @ self.slope
        room = budget - self.slope @ center
        far = np.sqrt(np.maximum(room, 0) * np.diag(self._covariance))
        near = (center - far < self.lower) | (center + far > self.upper)
        return near | (self.slope != 0)

    def _reduced(self, near: Bool[np.ndarray, " n"]) -> "_Reduced":
        """The quadratic minimised over the numbers that meet no bound."""
        far = ~near
        coupling = self.precision[np.ix_(far, near)]
        inverse = np.zeros((0, 0))
        if far.any():
            block = self.precision[np.ix_(far, far)]
            root = np.sqrt(np.diag(block))
            inverse = np.linalg.inv(block / np.outer(root, root)) / np.outer(root, root)
        follow = -inverse @ coupling
        size = int(np.count_nonzero(near))
        precision = np.eye(size + 1)
        precision[:size, :size] = self.precision[np.ix_(near, near)]
        precision[:size, :size] += coupling.T @ follow
        open_end = [np.inf]
        return _Reduced(
            precision,
            np.append(self.slope[near], 0),
            np.append(self.lower[near], [-np.inf]),
            np.append(self.upper[near], open_end),
            near,
            follow,
            inverse,
        )

    @functools.cached_property
    def _bottom(self) -> "_Bottom":
        """The minimum in the box: the point itself unless a free number has a slope."""
        inside = (self.lower < 0) & (self.upper > 0)
        steep = np.flatnonzero(inside & (self.slope != 0))
        point, depth = np.zeros_like(self.slope), 0.0
        if not len(steep):
            return _Bottom(point, depth)
        everything = np.ones(len(point), bool)
        reduced = self._reduced(everything)
        at = np.append(point, 0)
        for place in steep:
            along = np.eye(len(at))[[place]]
            sign = -np.sign((reduced.precision @ at + reduced.slope)[[place]])
            walked = reduced.walk(at, along, sign, None)
            at, depth = walked.points[0], depth + float(walked.risen[0])
        return _Bottom(at[:-1], depth)


SIDES = np.array([-1.0, 1.0])


class _Bottom(NamedTuple):
    point: Float[np.ndarray, " n"]
    depth: float


class _Walked(NamedTuple):
    """Ends of walks, the values of $a \\cdot p$ there, and increases of the cost."""

    points: Float[np.ndarray, "walks m"]
    reached: Float[np.ndarray, " walks"]
    risen: Float[np.ndarray, " walks"]
    ended: Bool[np.ndarray, " walks"]


@dataclasses.dataclass(frozen=True, eq=False)
class _Reduced:
    """The quadratic in the numbers that may meet bounds, and in one more number.

    The last number stands for all others along the vector: it has variance 1 and no
    bounds.
    """

    precision: Float[np.ndarray, "m m"]
    slope: Float[np.ndarray, " m"]
    lower: Float[np.ndarray, " m"]
    upper: Float[np.ndarray, " m"]
    near: Bool[np.ndarray, " n"]
    follow: Float[np.ndarray, "far near"]
    rest: Float[np.ndarray, "far far"]

    def functionals(self, along: Float[np.ndarray, "k n"]) -> np.ndarray:
        """The vectors in the reduced numbers, (k, m)."""
        beyond = along[:, ~self.near]
        variance = np.einsum("ki,ij,kj->k", beyond, self.rest, beyond)
        own = along[:, self.near] + beyond @ self.follow
        return np.column_stack([own, np.sqrt(np.maximum(variance, 0))])

    def walk(
        self,
        start: Float[np.ndarray, " m"],
        along: Float[np.ndarray, "walks m"],
        signs: Float[np.ndarray, " walks"],
        budget: float | None,
    ) -> _Walked:
        """Follow the profile outwards, with all walks in lock step.

        **Arguments:**

        - `start`: the minimum, or for a single walk the minimum at its position.
        - `signs`: direction of each walk.
        - `budget`: largest increase of the cost; `None` to walk down to the minimum.
        """
        count, size = along.shape
        points = np.tile(start, (count, 1))
        held = (points <= self.lower) | (points >= self.upper)
        risen, ended = np.zeros(count), np.zeros(count, bool)
        for _ in range(4 * size + 8):
            step = self._step(points, held, along, signs)
            held, stuck = step.held, step.stuck
            ended |= stuck
            limit = step.until(risen, budget)
            event = np.minimum(step.room.min(axis=1), step.release.min(axis=1))
            ended_here = ~ended & ~step.waits & (limit <= event)
            go = ~ended & ~step.waits
            length = np.where(go, np.minimum(limit, event), 0)
            points = points + length[:, None] * step.direction
            risen = risen + length * (2 * step.steepness + length * step.curvature)
            ended |= ended_here
            going = go & ~ended_here
            hit = going[:, None] & (step.room <= event[:, None])
            edge = np.where(step.direction > 0, self.upper, self.lower)
            points = np.where(hit, edge, points)
            free = going[:, None] & ~hit.any(axis=1)[:, None]
            held = (held | hit) & ~(free & (step.release <= event[:, None]))
            if ended.all():
                break
        return _Walked(points, np.sum(along * points, axis=1), risen, ended)

    def _step(
        self,
        points: Float[np.ndarray, "walks m"],
        held: Bool[np.ndarray, "walks m"],
        along: Float[np.ndarray, "walks m"],
        signs: Float[np.ndarray, " walks"],
    ) -> "_Step":
        """The next step of each walk, up to a change of the active bounds."""
        free = ~held
        both = free[:, :, None] & free[:, None, :]
        root = np.sqrt(np.diag(self.precision))
        scaled = self.precision / np.outer(root, root)
        matrix = np.where(both, scaled, np.eye(len(root)))
        pull = np.where(free, along, 0)
        answer = np.linalg.solve(matrix, (pull / root)[..., None])[..., 0] / root
        answer = np.where(free, answer, 0)
        reach = np.sum(pull * answer, axis=1)
        moves = reach > 0
        inwards = np.where(points <= self.lower, signs[:, None], -signs[:, None])
        # The followed number itself may lie at its bound, and leave it.
        leaves = held & ~moves[:, None] & (inwards * along > 0)
        leaves &= (self.lower < self.upper)[None]
        waits = leaves.any(axis=1)
        safe = np.where(moves, reach, 1)
        direction = np.where(
            moves[:, None], signs[:, None] * answer / safe[:, None], 0.0
        )
        slope = points @ self.precision + self.slope
        steepness = np.sum(slope * direction, axis=1)
        curvature = np.where(moves, 1 / safe, 0)

        # Numbers that hardly move never reach their bounds.
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            edge = np.where(direction > 0, self.upper, self.lower)
            room = (edge - points) / direction
            room = np.where(free & (direction != 0), np.maximum(room, 0), np.inf)
            # The multiplier of a number at its bound, and its rate of decrease.
            force = slope - (signs * steepness)[:, None] * along
            falls = direction @ self.precision - (signs * curvature)[:, None] * along
            side = np.where(points <= self.lower, 1.0, -1.0)
            force, falls = side * force, side * falls
            falling = held & (falls < 0) & (self.lower < self.upper)[None]
            release = np.where(falling, np.maximum(-force / falls, 0), np.inf)
        return _Step(
            held & ~leaves,
            ~moves & ~waits,
            waits,
            direction,
            steepness,
            curvature,
            room,
            release,
        )


class _Step(NamedTuple):
    """A straight piece of each walk.

    - `held`: numbers that stay at a bound.
    - `stuck`: walks that cannot go on.
    - `waits`: walks on which a number leaves its bound before they go on.
    - `direction`: change of all numbers per unit of distance.
    - `steepness`, `curvature`: half the cost's slope along the direction, and half its
        second derivative.
    - `room`: distance at which each number reaches a bound.
    - `release`: distance at which each held number leaves its bound.
    """

    held: Bool[np.ndarray, "walks m"]
    stuck: Bool[np.ndarray, " walks"]
    waits: Bool[np.ndarray, " walks"]
    direction: Float[np.ndarray, "walks m"]
    steepness: Float[np.ndarray, " walks"]
    curvature: Float[np.ndarray, " walks"]
    room: Float[np.ndarray, "walks m"]
    release: Float[np.ndarray, "walks m"]

    def until(self, risen: np.ndarray, budget: float | None) -> np.ndarray:
        """Distance at which the rise becomes `budget`, or to the minimum if it is None.

        **Arguments:** `risen`: rise so far.
        """
        curvature = np.where(self.curvature > 0, self.curvature, 1)
        if budget is None:
            return np.maximum(-self.steepness / curvature, 0)
        left = np.maximum(budget - risen, 0)
        root = np.sqrt(self.steepness**2 + left * curvature)
        # steepness·2d + curvature·d² = left, solved without cancellation.
        whole = self.steepness + root
        with np.errstate(divide="ignore", invalid="ignore"):
            far = np.where(whole > 0, left / whole, 0)
        return np.where(self.steepness < 0, (root - self.steepness) / curvature, far)
