"""Standard problems of bounded least squares, for solvers to be measured by.

The functions and starts are a dozen of those of Moré, Garbow and Hillstrom, *Testing
unconstrained optimization software*, ACM TOMS 7(1), 1981, whose numbers the names
carry. Boxes marked "Gay" are those of Gay, *A trust-region approach to linearly
constrained optimization*, Lecture Notes in Mathematics 1066, 1984, as Ceres's examples
pass them on; boxes marked "Mayorov" are from the benchmarks that SciPy's
`least_squares` was made with (github.com/nmayorov/bounded-lsq). The others are ours,
put where they bind.

Every function takes the module that it computes with, so that SciPy can be given
NumPy's double precision, and complex numbers for derivatives without rounding.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np


def rosenbrock(x, xp=jnp):
    return xp.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def freudenstein_roth(x, xp=jnp):
    a = ((5 - x[1]) * x[1] - 2) * x[1]
    b = ((x[1] + 1) * x[1] - 14) * x[1]
    return xp.stack([x[0] - 13 + a, x[0] - 29 + b])


def powell_badly_scaled(x, xp=jnp):
    return xp.stack([1e4 * x[0] * x[1] - 1, xp.exp(-x[0]) + xp.exp(-x[1]) - 1.0001])


def brown_badly_scaled(x, xp=jnp):
    return xp.stack([x[0] - 1e6, x[1] - 2e-6, x[0] * x[1] - 2])


def beale(x, xp=jnp):
    return xp.stack(
        [y - x[0] * (1 - x[1] ** k) for k, y in ((1, 1.5), (2, 2.25), (3, 2.625))]
    )


MEYER = np.array(
    [34780.0, 28610, 23650, 19630, 16370, 13720, 11540, 9744]
    + [8261, 7030, 6005, 5147, 4427, 3820, 3307, 2872]
)


def meyer(x, xp=jnp):
    t = 45 + 5 * np.arange(1.0, 17)
    return x[0] * xp.exp(x[1] / (t + x[2])) - MEYER


def powell_singular(x, xp=jnp):
    a, b, c, d = x
    return xp.stack(
        [a + 10 * b, 5**0.5 * (c - d), (b - 2 * c) ** 2, 10**0.5 * (a - d) ** 2]
    )


def wood(x, xp=jnp):
    a, b, c, d = x
    return xp.stack(
        [
            10 * (b - a**2),
            1 - a,
            90**0.5 * (d - c**2),
            1 - c,
            10**0.5 * (b + d - 2),
            0.1**0.5 * (b - d),
        ]
    )


def biggs(x, xp=jnp):
    t = np.arange(1.0, 14) / 10
    y = np.exp(-t) - 5 * np.exp(-10 * t) + 3 * np.exp(-4 * t)
    falling = x[2] * xp.exp(-t * x[0]) - x[3] * xp.exp(-t * x[1])
    return falling + x[5] * xp.exp(-t * x[4]) - y


def watson(x, xp=jnp):
    j = np.arange(1.0, len(x))
    powers = (np.arange(1.0, 30) / 29)[:, None] ** np.arange(len(x))
    slope = (powers[:, :-1] * j) @ x[1:]
    inner = slope - (powers @ x) ** 2 - 1
    return xp.concatenate([inner, xp.stack([x[0], x[1] - x[0] ** 2 - 1])])


def brown_almost_linear(x, xp=jnp):
    total = xp.sum(x) - (len(x) + 1)
    return xp.concatenate([x[:-1] + total, xp.stack([xp.prod(x) - 1])])


def linear_rank_1(x, xp=jnp):
    return np.arange(1.0, 21) * xp.sum(np.arange(1.0, len(x) + 1) * x) - 1


class Problem(NamedTuple):
    """A row of the table; a bound that is one number holds for all unknowns."""

    name: str
    residual: Callable[..., Any]
    start: tuple[float, ...]
    lower: float | tuple[float, ...] = -np.inf
    upper: float | tuple[float, ...] = np.inf
    source: str = "MGH"

    def box(self) -> np.ndarray:
        """Lower and upper bounds, (2, n)."""
        edges = (self.lower, self.upper)
        return np.stack([np.broadcast_to(np.array(e), len(self.start)) for e in edges])


INF = np.inf
HALVES = (0.5,) * 10
ONES = (1.0,) * 10


PROBLEMS = [
    Problem("1", rosenbrock, (-1.2, 1)),
    Problem("1 boxed", rosenbrock, (-1.2, 1), (-50, 0), (0.5, 100), "Mayorov"),
    Problem("1 below", rosenbrock, (-2, 1), (-INF, -1.5), source="Mayorov"),
    Problem("1 above", rosenbrock, (2, 2), (-INF, 1.5), source="Mayorov"),
    Problem("1 left", rosenbrock, (-2, 2), (-INF, 1.5), source="Mayorov"),
    Problem("1 edge", rosenbrock, (0, 2), (-INF, 1.5), (1, INF), "Mayorov"),
    Problem("1 corner", rosenbrock, (2, 2), (1, 1.5), (3, 3), "Mayorov"),
    Problem("2", freudenstein_roth, (0.5, -2)),
    Problem("2 boxed", freudenstein_roth, (6, 6), (0, 4.5), (20, 30), "ours"),
    Problem("3", powell_badly_scaled, (0, 1)),
    Problem("3 boxed", powell_badly_scaled, (0, 1), (0, 1), (1, 9), "Gay"),
    Problem("4", brown_badly_scaled, (1, 1)),
    Problem("4 boxed", brown_badly_scaled, (1, 1), (0, 3e-5), (1e6, 100), "Gay"),
    Problem("5", beale, (1, 1)),
    Problem("5 boxed", beale, (1, 1), (0.6, 0.5), (10, 100), "Gay"),
    Problem("5 corner", beale, (1, 1), -10, (2.5, 10), "ours"),
    Problem("10", meyer, (0.02, 4000, 250)),
    Problem("10 boxed", meyer, (0.02, 4000, 250), (0.006, 0, 0), (2, 3e5, 3e4), "ours"),
    Problem("13", powell_singular, (3, -1, 0, 1)),
    Problem(
        "13 boxed",
        powell_singular,
        (3, -1, 0, 1),
        (0.1, -20, -1, -1),
        (100, 20, 1, 50),
        "Mayorov",
    ),
    Problem("14", wood, (-3, -1, -3, -1)),
    Problem("14 boxed", wood, (-3, -1, -3, -1), -100, (0, 10, 100, 100), "Gay"),
    Problem("18", biggs, (1, 2, 1, 1, 1, 1)),
    Problem(
        "18 boxed",
        biggs,
        (1, 2, 1, 1, 1, 1),
        (0, 0, 0, 1, 0, 0),
        (2, 8, 1, 7, 5, 5),
        "Gay",
    ),
    Problem("20 with 9", watson, (0,) * 9),
    Problem(
        "20 with 9 boxed",
        watson,
        (0,) * 9,
        (-1e-5, 0, 0, 0, 0, -3, 0, -3, 0),
        (1e-5, 0.9, 0.1, 1, 1, 0, 4, 0, 2),
        "Mayorov",
    ),
    Problem("27", brown_almost_linear, HALVES),
    Problem("27 boxed", brown_almost_linear, HALVES, 0.1, (0.9,) + (5,) * 9, "ours"),
    Problem("33", linear_rank_1, ONES),
    Problem("33 boxed", linear_rank_1, ONES, 0.1, 10, "ours"),
]
