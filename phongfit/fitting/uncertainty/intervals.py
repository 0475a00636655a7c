r"""Profile intervals of a quadratic cost in a box.

Near a solution the cost is a quadratic in a box. The end of an interval is the point
farthest along a vector $a$ at which $\Delta\chi^2$ is not above a level. It lies on the
path of the points that minimise $\Delta\chi^2 - 2 \lambda\, a \cdot p$ in the box, for
$\lambda$ from 0 on. The path is straight between changes of the active bounds, and is
followed from one change to the next. So the interval of a number that is correlated
with one at its bound is wide on the side to which the bound leaves room.

??? cite "Source"
    Self and Liang, *Asymptotic properties of maximum likelihood estimators and
    likelihood ratio tests under nonstandard conditions*, J. Am. Stat. Assoc. 82, 1987.
    Markowitz, *The optimization of a quadratic function subject to linear constraints*,
    Naval Research Logistics Quarterly 3, 1956: the path.
"""

import dataclasses
import functools

import numpy as np
from jaxtyping import Bool, Float

# Directions that the data do not determine get a standard deviation of this many widths
# of the box: the box limits them, and matrices can be inverted.
WIDTHS = 30.0
# Precision of undetermined directions without a box, relative to that of each number
# alone.
SHARE = 1e-15
SIDES = np.array([-1.0, 1.0])


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
        bottom = self._bottom
        return self.rise + float((2 * self.slope + self.precision @ bottom) @ bottom)

    def ends(
        self, along: Float[np.ndarray, "k n"], level: float
    ) -> Float[np.ndarray, "k 2"]:
        r"""The least and largest $a \cdot (c + p)$ with $\Delta\chi^2$ up to a level.

        **Arguments:** `along`: the vectors $a$, as rows.

        **Returns:** NaN if Δχ² is above the level everywhere.
        """
        if self.least > level:
            return np.full((len(along), 2), np.nan)
        vectors = np.repeat(along, 2, axis=0) * np.tile(SIDES, len(along))[:, None]
        points = self._without_box(vectors, level)
        outside = ~np.all((self.lower <= points) & (points <= self.upper), axis=1)
        for k in np.flatnonzero(outside):
            points[k] = self._walk(
                self._bottom, self.slope, vectors[k], level - self.least
            )
        ends = np.sum(np.repeat(along, 2, axis=0) * points, axis=1).reshape(-1, 2)
        return ends + (along @ self.center)[:, None]

    def _without_box(
        self, along: Float[np.ndarray, "m n"], level: float
    ) -> Float[np.ndarray, "m n"]:
        """The farthest points along vectors if there were no box."""
        root = np.sqrt(np.diag(self.precision))
        covariance = np.linalg.inv(self.precision / np.outer(root, root))
        covariance /= np.outer(root, root)
        center = -covariance @ self.slope
        room = max(level - self.rise - self.slope @ center, 0.0)
        moves = along @ covariance
        spread = np.sqrt(np.maximum(np.sum(moves * along, axis=1), 1e-300))
        return center + np.sqrt(room) * moves / spread[:, None]

    @functools.cached_property
    def _bottom(self) -> Float[np.ndarray, " n"]:
        """The minimum in the box: the point itself unless a free number has a slope."""
        inside = (self.lower < 0) & (self.upper > 0)
        steep = np.where(inside, self.slope, 0)
        point = np.zeros_like(steep)
        return (
            self._walk(point, self.slope - steep, -steep, None) if any(steep) else point
        )

    def _walk(
        self,
        point: Float[np.ndarray, " n"],
        slope: Float[np.ndarray, " n"],
        along: Float[np.ndarray, " n"],
        budget: float | None,
    ) -> Float[np.ndarray, " n"]:
        r"""Follow the path from $\lambda = 0$ outwards.

        **Arguments:**

        - `point`: the minimum for the slope $g$ that is given.
        - `budget`: increase of the cost at the path's end; `None` to end at $\lambda =
            1$.
        """
        held, factor = (point <= self.lower) | (point >= self.upper), 0.0
        for _ in range(4 * len(point) + 8):
            direction, bend, room, release = self._piece(
                point, slope - factor * along, along, held
            )
            if budget is None:
                limit = 1 - factor
            elif bend > 0:
                # The cost rises by bend · ((λ + length)² − λ²).
                more = budget / bend
                limit = more / (factor + np.sqrt(factor**2 + more)) if more > 0 else 0.0
            else:
                limit = np.inf
            event = min(room.min(), release.min())
            length = min(limit, event)
            if np.isinf(length):
                break
            point = point + length * direction
            if limit <= event:
                break
            if budget is not None:
                budget -= bend * length * (2 * factor + length)
            factor += length
            hit = room <= event
            edge = np.where(direction > 0, self.upper, self.lower)
            point = np.where(hit, edge, point)
            held = held | hit if hit.any() else held & ~(release <= event)
        return np.clip(point, self.lower, self.upper)

    def _piece(
        self,
        point: Float[np.ndarray, " n"],
        slope: Float[np.ndarray, " n"],
        along: Float[np.ndarray, " n"],
        held: Bool[np.ndarray, " n"],
    ) -> tuple[np.ndarray, float, np.ndarray, np.ndarray]:
        r"""The straight piece of a path from a point on; lengths are changes of λ.

        **Returns:** the change of the point per unit of λ; half the second derivative
        of the cost in λ; the length at which each number reaches a bound, and that at
        which each held number leaves its bound.
        """
        free, direction = np.flatnonzero(~held), np.zeros_like(point)
        if len(free):
            block = self.precision[np.ix_(free, free)]
            root = np.sqrt(np.diag(block))
            scaled = block / np.outer(root, root)
            direction[free] = np.linalg.solve(scaled, along[free] / root) / root
        force, falls = (
            self.precision @ point + slope,
            self.precision @ direction - along,
        )
        lower = point <= self.lower
        held = held & (self.lower < self.upper)
        # Numbers that hardly move never reach their bounds.
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            edge = np.where(direction > 0, self.upper, self.lower)
            room = np.maximum((edge - point) / direction, 0)
            release = np.maximum(-force / falls, 0)
        return (
            direction,
            float(along @ direction),
            np.where(direction != 0, room, np.inf),
            np.where(held & (np.where(lower, falls, -falls) < 0), release, np.inf),
        )
