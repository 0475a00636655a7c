r"""The best reflectances of one pixel at one exponent, and how the squares go on.

For given f the best ρ is a tiny problem in a box, made of sums over the lights. What is
left of the squares, $\phi(t)$ with $t = \log f$, is a function of one number, whose
slope those sums give exactly: $\phi' = -2 \sum_c \rho_s\, S' \cdot r$.

??? cite "Source"
    Golub and Pereyra, *The differentiation of pseudo-inverses and nonlinear least
    squares problems whose variables separate*, SIAM J. Numer. Anal. 10(2), 1973;
    Kaufman, *A variable projection method for solving separable nonlinear least squares
    problems*, BIT 15, 1975.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from phongfit.maps.pixel.columns import (
    Columns,
    Lights,
    joined,
    pairs,
    weighed_sums,
)
from phongfit.maps.pixel.lobes import AbstractLobes, Angles
from phongfit.maps.pixel.small import (
    Boxed,
    Numbers,
    Triangle,
    dot,
    factorize,
    minimize_in_box,
    only,
    optimization_barrier,
    over_channels,
    solve,
    times,
)

# Rounds of the box problem.
ROUNDS = 6


class Box(NamedTuple):
    """Bounds of the reflectances (those in the columns, then ρ_s) and of log f."""

    lower: Numbers
    upper: Numbers
    lowest: Float[Array, ""]
    highest: Float[Array, ""]


class Sums(NamedTuple):
    """Sums over the lights for one exponent, (channels,) each.

    - `cross`: of S with the fixed columns.
    - `own`: S·S.
    - `moment`: of S with the light that the columns leave.
    """

    cross: Numbers
    own: Array
    moment: Array


class Slopes(NamedTuple):
    """The same of S' = dS / d log f.

    - `cross`: of S' with the fixed columns.
    - `mixed`, `own`: S·S' and S'·S'.
    - `moment`: of S' with the light that the columns leave.
    """

    cross: Numbers
    mixed: Array
    own: Array
    moment: Array


class At(NamedTuple):
    r"""The best reflectances at one exponent, and how $\phi$ goes on from there.

    - `point`: the columns' reflectances, then ρ_s, each (channels,).
    - `free`: which of them are not held by a bound.
    - `value`: φ less a constant.
    - `slope`: φ'.
    - `curvature`: φ'' as Gauss and Newton have it, ≥ 0.
    - `pull`: the slope of half the squares in each unknown.
    """

    point: Numbers
    free: Numbers
    value: Array
    slope: Array
    curvature: Array
    pull: Numbers
    sums: Sums
    slopes: Slopes


def sum_lights(columns: Columns, lobe: Lights) -> Sums:
    """The sums of all channels: see [`Sums`][]."""
    *cross, moment = _rows(weighed_sums(columns.moments, joined(list(lobe))))
    own = weighed_sums(columns.squares, joined(pairs(lobe, lobe)))
    return Sums(tuple(cross), own, moment)


def sum_slopes(columns: Columns, lobe: Lights, slope: Lights) -> Slopes:
    """The sums of all channels: see [`Slopes`][]."""
    *cross, moment = _rows(weighed_sums(columns.moments, joined(list(slope))))
    mixed = weighed_sums(columns.squares, joined(_mixed_pairs(lobe, slope)))
    own = weighed_sums(columns.squares, joined(pairs(slope, slope)))
    return Slopes(tuple(cross), mixed, own, moment)


def _mixed_pairs(left: Lights, right: Lights) -> list[Array]:
    """As [`pairs`][], of the mean of left with right and right with left."""
    both = zip(pairs(left, right), pairs(right, left), strict=True)
    return [left[0] * right[0]] if len(left) == 1 else [(a + b) / 2 for a, b in both]


def _rows(table: Float[Array, "channels rows"]) -> Numbers:
    return tuple(table[:, k] for k in range(table.shape[1]))


def best_reflectances(
    columns: Columns, sums: Sums, box: Box, rounds: int
) -> tuple[Boxed, Numbers]:
    """One channel's best ρ for given sums, and what is left of its slope there."""
    matrix = full_gram(columns, sums)
    zero = jnp.zeros_like(sums.own)
    vector = (*(zero for _ in columns.start), sums.moment)
    start = (*columns.start, zero)
    lower = tuple(edge - x for edge, x in zip(box.lower, start, strict=True))
    upper = tuple(edge - x for edge, x in zip(box.upper, start, strict=True))
    matrix, lower, upper = optimization_barrier((matrix, lower, upper))
    found = minimize_in_box(matrix, vector, lower, upper, rounds)
    product = times(matrix, found.point)
    pull = tuple(p - v for p, v in zip(product, vector, strict=True))
    moved = zip(start, found.point, box.lower, box.upper, strict=True)
    point = tuple(jnp.clip(x + d, low, high) for x, d, low, high in moved)
    return optimization_barrier((Boxed(point, found.value, found.free), pull))


def full_gram(columns: Columns, sums: Sums) -> Triangle:
    """Products of all columns, the highlight's last."""
    return (*columns.gram, (*sums.cross, sums.own))


def slope_gram(slopes: Slopes) -> Numbers:
    """Products of S' with all columns, the highlight's last."""
    return (*slopes.cross, slopes.mixed)


def evaluate(
    columns: Columns,
    lobes: AbstractLobes,
    angles: Angles,
    t: Float[Array, ""],
    box: Box,
) -> At:
    """Everything at one exponent: one exponential for each light.

    **Arguments:** `columns`: of all channels that share the exponent.
    """
    lobe, slope = lobes.at(angles, t)
    sums, slopes = sum_lights(columns, lobe), sum_slopes(columns, lobe, slope)

    def channel(
        columns: Columns, sums: Sums, slopes: Slopes
    ) -> tuple[Boxed, Array, Array, Numbers]:
        best, pull = best_reflectances(columns, sums, box, ROUNDS)
        *fixed, specular = best.point
        moved = tuple(x - x0 for x, x0 in zip(fixed, columns.start, strict=True))
        products = slope_gram(slopes)
        score = slopes.moment - dot(products, (*moved, specular))
        # What of S' no reflectance that is free to move can imitate.
        held = tuple(
            jnp.where(f, p, 0) for f, p in zip(best.free, products, strict=True)
        )
        imitated = solve(factorize(only(full_gram(columns, sums), best.free)), held)
        alone = jnp.maximum(slopes.own - dot(held, imitated), 0)
        return best, specular * score, specular**2 * alone, pull

    sums, slopes = optimization_barrier((sums, slopes))
    best, score, curvature, pull = optimization_barrier(
        over_channels(channel, columns, sums, slopes)
    )
    return At(
        best.point,
        best.free,
        2 * jnp.sum(best.value),
        -2 * jnp.sum(score),
        2 * jnp.sum(curvature),
        pull,
        sums,
        slopes,
    )
