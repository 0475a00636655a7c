r"""The best reflectances of pixels at one exponent, and derivatives of the cost there.

For given f the best ρ solves a small problem in a box, made of sums over the lights.
The remaining sum of squares, $\phi(t)$ with $t = \log f$, is a function of one number,
and the sums give its slope exactly: $\phi' = -2 \sum_c \rho_s\, S' \cdot r$.

??? cite "Source"
    Golub and Pereyra, *The differentiation of pseudo-inverses and nonlinear least
    squares problems whose variables separate*, SIAM J. Numer. Anal. 10(2), 1973;
    Kaufman, *A variable projection method for solving separable nonlinear least squares
    problems*, BIT 15, 1975.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from phongfit.maps.pixel.columns import Columns, pairs
from phongfit.maps.pixel.lobes import AbstractLobes, Angles
from phongfit.maps.pixel.small import (
    Boxed,
    Numbers,
    Triangle,
    dot,
    factorize,
    in_groups,
    minimize_in_box,
    of_rank,
    only,
    solve,
    sum_over_images,
)

# Rounds of the box problem.
ROUNDS = 6


class Box(NamedTuple):
    """Bounds of the reflectances (those in the columns, then ρ_s) and of log f."""

    lower: tuple[float, ...]
    upper: tuple[float, ...]
    lowest: float
    highest: float


class Sums(NamedTuple):
    """Sums over the images at one exponent, (channels, pixels) each, or at several.

    - `cross`: of S with the fixed columns.
    - `own`: S·S.
    - `moment`: of S with the residual of the fixed columns.
    """

    cross: Numbers
    own: Array
    moment: Array


class Slopes(NamedTuple):
    """Sums over the images of S' = dS / d log f.

    - `cross`: of S' with the fixed columns.
    - `mixed`, `own`: S·S' and S'·S'.
    - `moment`: of S' with the residual of the fixed columns.
    """

    cross: Numbers
    mixed: Array
    own: Array
    moment: Array


class At(NamedTuple):
    r"""The best reflectances at one exponent, with value and derivatives of $\phi$.

    The channels of a group share an exponent: one group of all, or one for each.

    - `point`: the columns' reflectances, then ρ_s, each (channels, pixels).
    - `free`: which of them are not held by a bound.
    - `value`: φ less a constant, (groups, pixels).
    - `slope`: φ'.
    - `curvature`: Gauss-Newton approximation of φ'', ≥ 0.
    """

    point: Numbers
    free: Numbers
    value: Array
    slope: Array
    curvature: Array
    sums: Sums
    slopes: Slopes


def sum_images(
    columns: Columns,
    lobes: AbstractLobes,
    angles: Angles,
    t: Float[Array, "*candidates groups #pixels"],
) -> Sums:
    """The sums of all channels: see [`Sums`][]."""
    height = lobes.at(t)

    def add(sums: tuple[Array, Array, Array], image: tuple) -> tuple:
        angles, cross, moments, squares = image
        heights = [height(one)[0] for one in _lights(angles, t.ndim)]
        products = pairs(heights, heights)
        along = [one[..., None, :, :] for one in heights]
        return (
            _plus(sums[0], cross, along),
            _plus(sums[1], moments, heights),
            _plus(sums[2], squares, products),
        )

    none = _no_sums(columns, t.shape[:-2])
    cross, moment, own = sum_over_images(add, none, (angles, *columns.rows))
    return Sums(tuple(jnp.moveaxis(cross, -3, 0)), own, moment)


def sum_with_slopes(
    columns: Columns,
    lobes: AbstractLobes,
    angles: Angles,
    t: Float[Array, "groups #pixels"],
) -> tuple[Sums, Slopes]:
    """[`Sums`][] and [`Slopes`][] of all channels."""
    height = lobes.at(t)

    def add(sums: tuple[Array, ...], image: tuple) -> tuple:
        angles, cross, moments, squares = image
        both = [height(one) for one in _lights(angles, t.ndim)]
        heights, rises = ([one[k] for one in both] for k in (0, 1))
        products = zip(
            pairs(heights, heights),
            _mixed_pairs(heights, rises),
            pairs(rises, rises),
            strict=True,
        )
        products = [jnp.stack(three) for three in products]
        return (
            _plus(sums[0], cross, heights),
            _plus(sums[1], cross, rises),
            _plus(sums[2], moments, heights),
            _plus(sums[3], moments, rises),
            _plus(sums[4], squares, products),
        )

    cross, moment, own = _no_sums(columns)
    none = cross, cross, moment, moment, jnp.stack([own] * 3)
    found = sum_over_images(add, none, (angles, *columns.rows))
    cross, crossed, moment, slope, (own, mixed, steep) = found
    sums = Sums(tuple(cross), own, moment)
    return sums, Slopes(tuple(crossed), mixed, steep, slope)


def _no_sums(
    columns: Columns, batch: tuple[int, ...] = ()
) -> tuple[Array, Array, Array]:
    """Zeros of the shapes of `cross`, `moment` and `own` of [`Sums`][]."""
    cross, moments, squares = (
        jnp.zeros((*batch, *rows.shape[2:]), rows.dtype) for rows in columns.rows
    )
    return cross, moments, squares


def _lights(angles: PyTree[Float[Array, "lobes pixels"]], rank: int) -> list[PyTree]:
    """Angles of each light of an image, as arrays with `rank` axes."""
    count = jax.tree.leaves(angles)[0].shape[0]
    return [
        of_rank(jax.tree.map(lambda one, j=j: one[j], angles), rank)
        for j in range(count)
    ]


def _plus(sums: Array, rows: Array, parts: list[Array]) -> Array:
    """Sums plus the products of rows with `parts`, one for each light or pair."""
    for row, part in zip(rows, parts, strict=True):
        sums = sums + of_rank(row, sums.ndim) * of_rank(part, sums.ndim)
    return sums


def _mixed_pairs(left: list[Array], right: list[Array]) -> list[Array]:
    """Mean of [`pairs`][] of left with right and of right with left."""
    both = zip(pairs(left, right), pairs(right, left), strict=True)
    return [left[0] * right[0]] if len(left) == 1 else [(a + b) / 2 for a, b in both]


def best_reflectances(columns: Columns, sums: Sums, box: Box, rounds: int) -> Boxed:
    """The best ρ of every channel for given sums."""
    matrix = full_gram(columns, sums)
    zero = jnp.zeros_like(sums.moment)
    vector = (*(zero for _ in columns.start), sums.moment)
    start = (*of_rank(columns.start, zero.ndim), zero)
    lower = tuple(edge - x for edge, x in zip(box.lower, start, strict=True))
    upper = tuple(edge - x for edge, x in zip(box.upper, start, strict=True))
    found = minimize_in_box(matrix, vector, lower, upper, rounds)
    moved = zip(start, found.point, box.lower, box.upper, strict=True)
    point = tuple(jnp.clip(x + d, low, high) for x, d, low, high in moved)
    return Boxed(point, found.value, found.free)


def full_gram(columns: Columns, sums: Sums) -> Triangle:
    """Products of all columns, the highlight's last."""
    return (*of_rank(columns.gram, sums.own.ndim), (*sums.cross, sums.own))


def slope_gram(slopes: Slopes) -> Numbers:
    """Products of S' with all columns, the highlight's last."""
    return (*slopes.cross, slopes.mixed)


def evaluate(
    columns: Columns,
    lobes: AbstractLobes,
    angles: Angles,
    t: Float[Array, "groups pixels"],
    box: Box,
) -> At:
    """Best reflectances, φ and its derivatives at one exponent for each group."""
    groups = len(t)
    sums, slopes = sum_with_slopes(columns, lobes, angles, t)
    best = best_reflectances(columns, sums, box, ROUNDS)
    *fixed, specular = best.point
    moved = tuple(x - x0 for x, x0 in zip(fixed, columns.start, strict=True))
    products = slope_gram(slopes)
    score = slopes.moment - dot(products, (*moved, specular))
    # Project the free columns out of S', since their reflectances adapt to f.
    held = tuple(jnp.where(f, p, 0) for f, p in zip(best.free, products, strict=True))
    imitated = solve(factorize(only(full_gram(columns, sums), best.free)), held)
    alone = jnp.maximum(slopes.own - dot(held, imitated), 0)
    return At(
        best.point,
        best.free,
        2 * in_groups(best.value, groups),
        -2 * in_groups(specular * score, groups),
        2 * in_groups(specular**2 * alone, groups),
        sums,
        slopes,
    )
