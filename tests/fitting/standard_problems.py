"""Standard problems of bounded least squares, for solvers to be measured by.

The functions and starts are those of Moré, Garbow and Hillstrom, *Testing unconstrained
optimization software*, ACM TOMS 7(1), 1981, whose numbers the names carry. Boxes marked
"Gay" are those of Gay, *A trust-region approach to linearly constrained optimization*,
Lecture Notes in Mathematics 1066, 1984, as Ceres's examples pass them on; boxes marked
"Mayorov" are from the benchmarks that SciPy's `least_squares` was made with
(github.com/nmayorov/bounded-lsq). The others are ours, put where they bind.

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


def jennrich_sampson(x, xp=jnp):
    i = np.arange(1.0, 11)
    return 2 + 2 * i - (xp.exp(i * x[0]) + xp.exp(i * x[1]))


def helical_valley(x, xp=jnp):
    turn = xp.arctan(x[1] / x[0]) / (2 * np.pi) + xp.where(x[0] > 0, 0, 0.5)
    radius = xp.sqrt(x[0] ** 2 + x[1] ** 2)
    return xp.stack([10 * (x[2] - 10 * turn), 10 * (radius - 1), x[2]])


BARD = np.array(
    [0.14, 0.18, 0.22, 0.25, 0.29, 0.32, 0.35, 0.39]
    + [0.37, 0.58, 0.73, 0.96, 1.34, 2.10, 4.39]
)


def bard(x, xp=jnp):
    del xp
    u = np.arange(1.0, 16)
    v, w = 16 - u, np.minimum(u, 16 - u)
    return BARD - (x[0] + u / (v * x[1] + w * x[2]))


GAUSSIAN = np.array(
    [0.0009, 0.0044, 0.0175, 0.0540, 0.1295, 0.2420, 0.3521, 0.3989]
    + [0.3521, 0.2420, 0.1295, 0.0540, 0.0175, 0.0044, 0.0009]
)


def gaussian(x, xp=jnp):
    t = (7 - np.arange(15.0)) / 2
    return x[0] * xp.exp(-x[1] * (t - x[2]) ** 2 / 2) - GAUSSIAN


MEYER = np.array(
    [34780.0, 28610, 23650, 19630, 16370, 13720, 11540, 9744]
    + [8261, 7030, 6005, 5147, 4427, 3820, 3307, 2872]
)


def meyer(x, xp=jnp):
    t = 45 + 5 * np.arange(1.0, 17)
    return x[0] * xp.exp(x[1] / (t + x[2])) - MEYER


def box_three(x, xp=jnp):
    t = np.arange(1.0, 11) / 10
    return xp.exp(-t * x[0]) - xp.exp(-t * x[1]) - x[2] * (np.exp(-t) - np.exp(-10 * t))


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


KOWALIK_OSBORNE = np.array(
    [0.1957, 0.1947, 0.1735, 0.1600, 0.0844, 0.0627]
    + [0.0456, 0.0342, 0.0323, 0.0235, 0.0246]
)


def kowalik_osborne(x, xp=jnp):
    del xp
    u = [4, 2, 1, 0.5, 0.25, 0.167, 0.125, 0.1, 0.0833, 0.0714, 0.0625]
    u = np.array(u)
    ratio = (u**2 + u * x[1]) / (u**2 + u * x[2] + x[3])
    return KOWALIK_OSBORNE - x[0] * ratio


def brown_dennis(x, xp=jnp):
    del xp
    t = np.arange(1.0, 21) / 5
    a = x[0] + t * x[1] - np.exp(t)
    b = x[2] + x[3] * np.sin(t) - np.cos(t)
    return a**2 + b**2


OSBORNE_1 = np.array(
    [0.844, 0.908, 0.932, 0.936, 0.925, 0.908, 0.881, 0.850, 0.818, 0.784, 0.751]
    + [0.718, 0.685, 0.658, 0.628, 0.603, 0.580, 0.558, 0.538, 0.522, 0.506, 0.490]
    + [0.478, 0.467, 0.457, 0.448, 0.438, 0.431, 0.424, 0.420, 0.414, 0.411, 0.406]
)


def osborne_1(x, xp=jnp):
    t = 10 * np.arange(33.0)
    return OSBORNE_1 - (x[0] + x[1] * xp.exp(-t * x[3]) + x[2] * xp.exp(-t * x[4]))


def biggs(x, xp=jnp):
    t = np.arange(1.0, 14) / 10
    y = np.exp(-t) - 5 * np.exp(-10 * t) + 3 * np.exp(-4 * t)
    falling = x[2] * xp.exp(-t * x[0]) - x[3] * xp.exp(-t * x[1])
    return falling + x[5] * xp.exp(-t * x[4]) - y


OSBORNE_2 = np.array(
    [1.366, 1.191, 1.112, 1.013, 0.991, 0.885, 0.831, 0.847, 0.786, 0.725, 0.746]
    + [0.679, 0.608, 0.655, 0.616, 0.606, 0.602, 0.626, 0.651, 0.724, 0.649, 0.649]
    + [0.694, 0.644, 0.624, 0.661, 0.612, 0.558, 0.533, 0.495, 0.500, 0.423, 0.395]
    + [0.375, 0.372, 0.391, 0.396, 0.405, 0.428, 0.429, 0.523, 0.562, 0.607, 0.653]
    + [0.672, 0.708, 0.633, 0.668, 0.645, 0.632, 0.591, 0.559, 0.597, 0.625, 0.739]
    + [0.710, 0.729, 0.720, 0.636, 0.581, 0.428, 0.292, 0.162, 0.098, 0.054]
)


def osborne_2(x, xp=jnp):
    t = np.arange(65.0) / 10
    model = x[0] * xp.exp(-t * x[4])
    for k in (1, 2, 3):
        model = model + x[k] * xp.exp(-((t - x[k + 7]) ** 2) * x[k + 4])
    return OSBORNE_2 - model


def watson(x, xp=jnp):
    j = np.arange(1.0, len(x))
    powers = (np.arange(1.0, 30) / 29)[:, None] ** np.arange(len(x))
    slope = (powers[:, :-1] * j) @ x[1:]
    inner = slope - (powers @ x) ** 2 - 1
    return xp.concatenate([inner, xp.stack([x[0], x[1] - x[0] ** 2 - 1])])


def penalty_1(x, xp=jnp):
    return xp.concatenate([1e-5**0.5 * (x - 1), xp.stack([xp.sum(x**2) - 0.25])])


def penalty_2(x, xp=jnp):
    n = len(x)
    i = np.arange(2.0, n + 1)
    y = np.exp(i / 10) + np.exp((i - 1) / 10)
    e = xp.exp(x / 10)
    weighted = xp.sum((n - np.arange(float(n))) * x**2) - 1
    return xp.concatenate(
        [
            xp.stack([x[0] - 0.2]),
            1e-5**0.5 * (e[1:] + e[:-1] - y),
            1e-5**0.5 * (e[1:] - np.exp(-0.1)),
            xp.stack([weighted]),
        ]
    )


def variably_dimensioned(x, xp=jnp):
    total = xp.sum(np.arange(1.0, len(x) + 1) * (x - 1))
    return xp.concatenate([x - 1, xp.stack([total, total**2])])


def trigonometric(x, xp=jnp):
    n, i = len(x), np.arange(1.0, len(x) + 1)
    return n - xp.sum(xp.cos(x)) + i * (1 - xp.cos(x)) - xp.sin(x)


def brown_almost_linear(x, xp=jnp):
    total = xp.sum(x) - (len(x) + 1)
    return xp.concatenate([x[:-1] + total, xp.stack([xp.prod(x) - 1])])


def _neighbours(x, xp):
    """x with a 0 at either end."""
    none = xp.zeros_like(x[:1])
    return xp.concatenate([none, x, none])


def discrete_boundary_value(x, xp=jnp):
    h = 1 / (len(x) + 1)
    t = h * np.arange(1.0, len(x) + 1)
    y = _neighbours(x, xp)
    return 2 * x - y[:-2] - y[2:] + h**2 * (x + t + 1) ** 3 / 2


def discrete_integral_equation(x, xp=jnp):
    del xp
    h = 1 / (len(x) + 1)
    t = h * np.arange(1.0, len(x) + 1)
    # Green's function of the second derivative.
    kernel = np.minimum(t[:, None], t) * (1 - np.maximum(t[:, None], t))
    return x + h / 2 * (kernel @ (x + t + 1) ** 3)


def broyden_tridiagonal(x, xp=jnp):
    y = _neighbours(x, xp)
    return (3 - 2 * x) * x - y[:-2] - 2 * y[2:] + 1


def broyden_banded(x, xp=jnp):
    del xp
    i = np.arange(len(x))
    ahead = i - i[:, None]
    band = ((-5 <= ahead) & (ahead <= 1) & (ahead != 0)).astype(float)
    return x * (2 + 5 * x**2) + 1 - band @ (x * (1 + x))


def linear_full_rank(x, xp=jnp):
    shift = xp.sum(x) / len(x) + 1
    return xp.concatenate([x - shift, xp.zeros_like(x) - shift])


def linear_rank_1(x, xp=jnp):
    return np.arange(1.0, 21) * xp.sum(np.arange(1.0, len(x) + 1) * x) - 1


def linear_rank_1_with_zeros(x, xp=jnp):
    i = np.concatenate([[0], np.arange(1.0, 19), [0]])
    return i * xp.sum(np.arange(2.0, len(x)) * x[1:-1]) - 1


def chebyquad(x, xp=jnp):
    # The shifted polynomials by their recursion, less their means over [0, 1].
    z = 2 * x - 1
    polynomials = [xp.ones_like(z), z]
    for _ in range(2, len(x) + 1):
        polynomials.append(2 * z * polynomials[-1] - polynomials[-2])
    means = [0 if i % 2 else -1 / (i**2 - 1) for i in range(1, len(x) + 1)]
    return xp.mean(xp.stack(polynomials[1:]), axis=1) - np.array(means)


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
# Starts that the collection gives by formulas, for ten unknowns.
RAMP = tuple((1.0 - np.arange(1, 11) / 10).tolist())
COUNT = tuple(np.arange(1.0, 11).tolist())
SAG = tuple((np.arange(1, 11) / 11 * (np.arange(1, 11) / 11 - 1)).tolist())
TENS = np.arange(0.0, 100, 10)


def _nodes(n: int, *first: float) -> tuple[float, ...]:
    """Chebyquad's start, with other values for the first unknowns."""
    return first + tuple((np.arange(1, n + 1) / (n + 1)).tolist()[len(first) :])


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
    Problem("6", jennrich_sampson, (0.3, 0.4)),
    Problem("6 boxed", jennrich_sampson, (0.3, 0.4), (0.26, 0), (10, 20), "ours"),
    Problem("7", helical_valley, (-1, 0, 0)),
    Problem("7 boxed", helical_valley, (-1, 0, 0), (-100, -1, -1), (0.8, 1, 1), "Gay"),
    Problem("8", bard, (1, 1, 1)),
    Problem("8 boxed", bard, (1, 1, 1), (0.1, 0, 0), (50, 100, 1.5), "ours"),
    Problem("9", gaussian, (0.4, 1, 0)),
    Problem("9 boxed", gaussian, (0.4, 1, 0), (0.398, 1, -0.5), (4.2, 2, 0.1), "Gay"),
    Problem("10", meyer, (0.02, 4000, 250)),
    Problem("10 boxed", meyer, (0.02, 4000, 250), (0.006, 0, 0), (2, 3e5, 3e4), "ours"),
    Problem("12", box_three, (0, 10, 20)),
    Problem("12 boxed", box_three, (0, 7.5, 20), (0, 5, 0), (2, 9.5, 20), "Gay"),
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
    Problem("15", kowalik_osborne, (0.25, 0.39, 0.415, 0.39)),
    Problem(
        "15 boxed",
        kowalik_osborne,
        (0.25, 0.39, 0.415, 0.39),
        (0, -1, 0.13, 0.12),
        (10, 12, 13, 14),
        "ours",
    ),
    Problem("16", brown_dennis, (25, 5, -5, -1)),
    Problem(
        "16 boxed",
        brown_dennis,
        (25, 5, -5, -1),
        (-10, 0, -100, -20),
        (100, 15, 0, 0.2),
        "Gay",
    ),
    Problem("17", osborne_1, (0.5, 1.5, -1, 0.01, 0.02)),
    Problem(
        "17 boxed",
        osborne_1,
        (0.5, 1.5, -1, 0.01, 0.02),
        (0, 0, -50, 0, 0),
        (50, 1.9, -0.1, 10, 10),
        "ours",
    ),
    Problem("18", biggs, (1, 2, 1, 1, 1, 1)),
    Problem(
        "18 boxed",
        biggs,
        (1, 2, 1, 1, 1, 1),
        (0, 0, 0, 1, 0, 0),
        (2, 8, 1, 7, 5, 5),
        "Gay",
    ),
    Problem("19", osborne_2, (1.3, 0.65, 0.65, 0.7, 0.6, 3, 5, 7, 2, 4.5, 5.5)),
    Problem(
        "19 boxed",
        osborne_2,
        (1.3, 0.65, 0.65, 0.7, 0.6, 3, 5, 7, 2, 4.5, 5.5),
        (1, 0.5, 0, 0.6, 0, 0, 0, 0, 0, 0, 0),
        100,
        "ours",
    ),
    Problem("20 with 6", watson, (0,) * 6),
    Problem("20 with 9", watson, (0,) * 9),
    Problem(
        "20 with 9 boxed",
        watson,
        (0,) * 9,
        (-1e-5, 0, 0, 0, 0, -3, 0, -3, 0),
        (1e-5, 0.9, 0.1, 1, 1, 0, 4, 0, 2),
        "Mayorov",
    ),
    Problem("20 with 12", watson, (0,) * 12),
    Problem(
        "20 with 12 boxed",
        watson,
        (0,) * 12,
        (-1, 0, -1, -1, -1, 0, -3, 0, -10, 0, -5, 0),
        (0, 0.9, 0, 0.3, 0, 1, 0, 10, 0, 10, 0, 1),
        "Mayorov",
    ),
    Problem("23", penalty_1, COUNT),
    Problem(
        "23 boxed", penalty_1, COUNT, (0, 1, 0, 0, 0, 1, 0, 0, 0, 1), 100, "Mayorov"
    ),
    Problem("24 with 4", penalty_2, (0.5,) * 4),
    Problem(
        "24 with 4 boxed",
        penalty_2,
        (0.5,) * 4,
        (-10, 0.3, 0, -1),
        (50, 50, 50, 0.5),
        "Mayorov",
    ),
    Problem("24", penalty_2, HALVES),
    Problem(
        "24 boxed",
        penalty_2,
        HALVES,
        (-10, 0.1, 0, 0.05, 0, -10, 0, 0.2, 0, 0),
        (50,) * 9 + (0.5,),
        "Mayorov",
    ),
    Problem("25", variably_dimensioned, RAMP),
    Problem(
        "25 boxed",
        variably_dimensioned,
        RAMP,
        0,
        (*(TENS[1:].tolist()), 0.5),
        "Mayorov",
    ),
    Problem("26", trigonometric, (0.1,) * 10),
    Problem(
        "26 boxed",
        trigonometric,
        tuple((TENS + 5).tolist()),
        tuple(TENS.tolist()),
        tuple((TENS + 10).tolist()),
        "Mayorov",
    ),
    Problem("27", brown_almost_linear, HALVES),
    Problem("27 boxed", brown_almost_linear, HALVES, 0.1, (0.9,) + (5,) * 9, "ours"),
    Problem("28", discrete_boundary_value, SAG),
    Problem("28 boxed", discrete_boundary_value, (-0.05,) * 10, -0.1, 10, "ours"),
    Problem("29", discrete_integral_equation, SAG),
    Problem("29 boxed", discrete_integral_equation, (-0.05,) * 10, -0.1, 10, "ours"),
    Problem("30", broyden_tridiagonal, (-1,) * 10),
    Problem(
        "30 boxed", broyden_tridiagonal, (-1,) * 10, -2, (-0.6,) * 5 + (0,) * 5, "ours"
    ),
    Problem("31", broyden_banded, (-1,) * 10),
    Problem("31 boxed", broyden_banded, (-1,) * 10, -2, (-0.5,) * 5 + (0,) * 5, "ours"),
    Problem("32", linear_full_rank, ONES),
    Problem("32 boxed", linear_full_rank, ONES, (-0.5,) * 5 + (-3,) * 5, 10, "ours"),
    Problem("33", linear_rank_1, ONES),
    Problem("33 boxed", linear_rank_1, ONES, 0.1, 10, "ours"),
    Problem("34", linear_rank_1_with_zeros, ONES),
    Problem("34 boxed", linear_rank_1_with_zeros, ONES, 0.1, 10, "ours"),
    Problem("35 with 7", chebyquad, _nodes(7)),
    Problem(
        "35 with 7 boxed",
        chebyquad,
        _nodes(7, 0.025, 0.1, 0.15),
        0,
        (0.05, 0.23, 0.333, 1, 1, 1, 1),
        "Mayorov",
    ),
    Problem("35 with 8", chebyquad, _nodes(8)),
    Problem(
        "35 with 8 boxed",
        chebyquad,
        _nodes(8, 0.02, 0.1, 0.2),
        (0, 0, 0.1, 0, 0, 0, 0, 0),
        (0.04, 0.2, 0.3, 1, 1, 1, 1, 1),
        "Mayorov",
    ),
    Problem("35 with 9", chebyquad, _nodes(9)),
    Problem("35 with 10", chebyquad, _nodes(10)),
    Problem(
        "35 with 10 boxed",
        chebyquad,
        _nodes(10),
        (0, 0.1, 0.2, 0, 0, 0.5, 0.5, 0.5, 0.5, 0.5),
        (1, 0.2, 0.3, 0.4, 0.5, 1, 1, 1, 1, 1),
        "Mayorov",
    ),
]
