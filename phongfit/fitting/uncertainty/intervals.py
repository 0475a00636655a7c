r"""How far the data let a number go, all others free to follow within their bounds.

Near a solution the cost is a quadratic in a box. Its profile along one number, the
least over all others in the box, is convex and made of parabolas: they are followed
outwards, from the place where one bound begins or ceases to bind to the next, until
$\Delta\chi^2$ has risen as far as is asked. So a number that trades against one at its
bound is as uncertain as the trade is, on the side where the bound leaves room.

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

# A direction that the data leave open is held by this many widths of its box: the box
# decides, and matrices can be inverted.
WIDTHS = 30.0
# The same where there is no box, as a share of what is known of each number alone.
SHARE = 1e-15


@dataclasses.dataclass(frozen=True, eq=False)
class Quadratic:
    r"""$\Delta\chi^2 = r + 2 g \cdot p + p^\top P p$ for steps $p$ in a box.

    **Arguments:**

    - `precision`: $P$, the inverse of the covariance that all would have without
        bounds.
    - `slope`: $g$: 0 for what is free, and what its bound keeps from falling further.
    - `lower`, `upper`: the box, in steps from the place.
    - `rise`: $r$, how much worse the place is than the solution.
    - `center`: the place, as a step from the solution.
    """

    precision: Float[np.ndarray, "n n"]
    slope: Float[np.ndarray, " n"]
    lower: Float[np.ndarray, " n"]
    upper: Float[np.ndarray, " n"]
    rise: float
    center: Float[np.ndarray, " n"]

    @functools.cached_property
    def least(self) -> float:
        """The least in the box."""
        return self.rise + self._bottom.depth

    def ends(
        self, along: Float[np.ndarray, "k n"], level: float
    ) -> Float[np.ndarray, "k 2"]:
        r"""The least and largest $a \cdot (c + p)$ with $\Delta\chi^2$ up to a level.

        **Arguments:** `along`: the vectors $a$, a row each.

        **Returns:** NaN where the level is nowhere kept.
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
        """Where the numbers that meet no bound have followed the others."""
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
        """The least: 0, save where a number that no bound keeps has a slope."""
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
    """Where walks ended; how far $a \\cdot p$ had come, and what it had cost."""

    points: Float[np.ndarray, "walks m"]
    reached: Float[np.ndarray, " walks"]
    risen: Float[np.ndarray, " walks"]
    ended: Bool[np.ndarray, " walks"]


@dataclasses.dataclass(frozen=True, eq=False)
class _Reduced:
    """The profile over what meets no bound: what does, and one number for the rest.

    That last one stands for the rest of what is followed: of variance 1, and unbounded.
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
        """Outwards along the profile, all walks in step.

        **Arguments:**

        - `start`: the least, or the least for its own place along a single walk.
        - `signs`: to which side each goes.
        - `budget`: by how much the cost may rise; `None` to walk down to the least.
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
        """Where each walk goes on, as long as the same bounds bind."""
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
        # What is followed may lie at its bound itself, and leave it.
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

        # What hardly moves never gets to its bound.
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            edge = np.where(direction > 0, self.upper, self.lower)
            room = (edge - points) / direction
            room = np.where(free & (direction != 0), np.maximum(room, 0), np.inf)
            # What keeps a number at its bound, and how fast that falls.
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
    held: Bool[np.ndarray, "walks m"]
    stuck: Bool[np.ndarray, " walks"]
    waits: Bool[np.ndarray, " walks"]
    direction: Float[np.ndarray, "walks m"]
    steepness: Float[np.ndarray, " walks"]
    curvature: Float[np.ndarray, " walks"]
    room: Float[np.ndarray, "walks m"]
    release: Float[np.ndarray, "walks m"]

    def until(self, risen: np.ndarray, budget: float | None) -> np.ndarray:
        """How far it is to the level, or to where it no longer falls."""
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
