r"""The best exponent of one pixel: a scan over log f, then steps of Newton's kind.

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

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.fitting.maps.columns import (
    Columns,
    Lights,
    joined,
    pairs,
    weighed_sums,
)
from phongfit.fitting.maps.small import (
    Boxed,
    Numbers,
    Triangle,
    dot,
    factorize,
    minimize_in_box,
    only,
    over_channels,
    settled,
    solve,
    times,
)
from phongfit.reflectance import AbstractSpecular

# No step is longer, in log f: beyond a factor of 2 the slope says little.
LONGEST = 0.7
# How far a curvature may be from that of Gauss and Newton to be expected once more.
BENT = 0.1, 10
# Logarithm of the least height of a lobe that counts: products of smaller ones leave
# the normal numbers of single precision, and those are slow.
FAINTEST = -36.0
# Rounds of the box problem: where it matters, and where it only ranks candidates.
ROUNDS = 6
FEW_ROUNDS = 3


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


def lobes(
    model: AbstractSpecular, log_cosine: Lights, t: Array
) -> tuple[Lights, Lights]:
    """Heights of the highlights at exponent e^t, and their slopes in t."""
    one = jnp.ones((), t.dtype)

    def height_at(t: Array) -> Array:
        return model.lobe(one, jnp.exp(t))

    height, rise = jax.jvp(height_at, (t,), (one,))
    tops, slopes = [], []
    for logarithm in log_cosine:
        power = jnp.exp(t) * logarithm
        lobe = height * jnp.where(power > FAINTEST, jnp.exp(power), 0)
        tops.append(lobe)
        slopes.append(lobe * (power + rise / height))
    return settled((tuple(tops), tuple(slopes)))


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
    matrix, lower, upper = settled((matrix, lower, upper))
    found = minimize_in_box(matrix, vector, lower, upper, rounds)
    product = times(matrix, found.point)
    pull = tuple(p - v for p, v in zip(product, vector, strict=True))
    moved = zip(start, found.point, box.lower, box.upper, strict=True)
    point = tuple(jnp.clip(x + d, low, high) for x, d, low, high in moved)
    return settled((Boxed(point, found.value, found.free), pull))


def full_gram(columns: Columns, sums: Sums) -> Triangle:
    """Products of all columns, the highlight's last."""
    return (*columns.gram, (*sums.cross, sums.own))


def slope_gram(slopes: Slopes) -> Numbers:
    """Products of S' with all columns, the highlight's last."""
    return (*slopes.cross, slopes.mixed)


def evaluate(
    columns: Columns,
    model: AbstractSpecular,
    log_cosine: Lights,
    t: Float[Array, ""],
    box: Box,
) -> At:
    """Everything at one exponent: one exponential for each light.

    **Arguments:** `columns`: of all channels that share the exponent.
    """
    lobe, slope = lobes(model, log_cosine, t)
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

    sums, slopes = settled((sums, slopes))
    best, score, curvature, pull = settled(
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


class Scan(NamedTuple):
    """The best of a few exponents, between which neighbours, and the faintest S.

    - `t`: log f of the best, refined by a parabola.
    - `low`, `high`: its neighbours.
    - `faintest`: the least curvature that ρ_s has at any candidate.
    """

    t: Array
    low: Array
    high: Array
    faintest: Array


def scan(
    columns: Columns,
    model: AbstractSpecular,
    log_cosine: Lights,
    box: Box,
    count: int,
) -> Scan:
    r"""Candidates a factor of 2 apart, from the lowest exponent on.

    $\cos^{2f} = (\cos^f)^2$: one exponential serves all of them.

    **Arguments:**

    - `columns`: of one channel, or of the first of several.
    - `count`: of candidates, ≥ 2: from [`candidates`][].
    """
    spacing = np.log(2).item()
    exponent = jnp.exp(box.lowest)
    powers = _powers(log_cosine, exponent)
    one = jnp.ones((), exponent.dtype)
    candidates = []
    for k in range(count):
        powers = settled(_squares(powers) if k else powers)
        height = model.lobe(one, exponent * 2**k)
        sums = sum_lights(columns, powers)
        cross = tuple(height * number for number in sums.cross)
        candidates.append(Sums(cross, height**2 * sums.own, height * sums.moment))

    def ranked(sums: Sums) -> tuple[Array, Array]:
        best, _ = best_reflectances(first, sums, box, FEW_ROUNDS)
        return best.value, factorize(full_gram(first, sums)).last

    first, stacked = jax.tree.map(
        lambda leaf: leaf[0],
        (columns, jax.tree.map(lambda *leaves: jnp.stack(leaves, 1), *candidates)),
    )
    value, curvature = jax.vmap(ranked)(settled(stacked))
    best = jnp.argmin(value)
    t = box.lowest + spacing * best.astype(exponent.dtype)
    low = jnp.maximum(t - spacing, box.lowest)
    high = jnp.where(best == count - 1, box.highest, t + spacing)
    # The vertex of the parabola through the best and its neighbours.
    left, here, right = (value[jnp.clip(best + k, 0, count - 1)] for k in (-1, 0, 1))
    bend = left - 2 * here + right
    inner = (best > 0) & (best < count - 1) & (bend > 0)
    shift = jnp.where(inner, (left - right) / (2 * jnp.where(inner, bend, 1)), 0)
    t = t + spacing * jnp.clip(shift, -0.5, 0.5)
    t = jnp.clip(t, box.lowest, box.highest)
    return Scan(t, low, high, jnp.min(curvature))


def _powers(log_cosine: Lights, exponent: Array) -> Lights:
    powers = (exponent * logarithm for logarithm in log_cosine)
    return tuple(jnp.where(power > FAINTEST, jnp.exp(power), 0) for power in powers)


def _squares(powers: Lights) -> Lights:
    least = np.exp(FAINTEST / 2).item()
    return tuple(jnp.where(power > least, power * power, 0) for power in powers)


def candidates(lowest: float, highest: float) -> int:
    """How many candidates a scan between two values of log f takes."""
    return max(int(np.floor((highest - lowest) / np.log(2) + 1e-6)) + 1, 2)


class _Search(NamedTuple):
    r"""Where the search stands.

    - `t`: to be looked at next, `step` from the best so far.
    - `best`, `value`, `slope`: the best so far, $\phi$ and $\phi'$ there.
    - `left`, `right`: the bottom lies between them.
    - `bend`: the curvature there, over that of Gauss and Newton.
    """

    t: Array
    step: Array
    best: Array
    value: Array
    slope: Array
    left: Array
    right: Array
    bend: Array


def descend(
    columns: Columns,
    model: AbstractSpecular,
    log_cosine: Lights,
    start: Float[Array, ""],
    low: Float[Array, ""],
    high: Float[Array, ""],
    box: Box,
    steps: int,
    bend: Float[Array, ""] | float = 1.0,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    r"""A better t: `steps` steps down $\phi$ between `low` and `high`.

    Newton's steps on the exact slope. The curvature is the difference of two slopes or,
    until two are known, that of Gauss and Newton, which is several times too large or
    too small where the residuals are those of a photograph. What leads up, and what
    leads down too far, brackets the bottom; a step out of the bracket is halved.

    **Arguments:** `bend`: the curvature over that of Gauss and Newton, to begin with.

    **Returns:** t, and the last `bend`.
    """

    def step(_: int, search: _Search) -> _Search:
        at = evaluate(columns, model, log_cosine, search.t, box)
        # Differences below rounding must not send the search back.
        slack = 1e-6 * jnp.abs(search.value)
        accept = at.value <= search.value + slack
        moved = search.t - search.best
        secant = (at.slope - search.slope) / jnp.where(moved != 0, moved, 1)
        best = jnp.where(accept, search.t, search.best)
        slope = jnp.where(accept, at.slope, search.slope)
        # Where the slope rises, or the point lies above the best, the bottom is past.
        upward = jnp.where(accept, at.slope, moved)
        left = jnp.where(upward < 0, search.t, search.left)
        right = jnp.where(upward > 0, search.t, search.right)
        measured = (moved != 0) & (secant > 0)
        curvature = jnp.where(measured, secant, search.bend * at.curvature)
        bend = secant / jnp.where(at.curvature > 0, at.curvature, jnp.inf)
        bend = jnp.where(measured, jnp.clip(bend, *BENT), search.bend)
        newton = -slope / jnp.where(curvature > 0, curvature, jnp.inf)
        t = best + jnp.clip(newton, -LONGEST, LONGEST)
        t = jnp.where(t <= left, (best + left) / 2, t)
        t = jnp.where(t >= right, (best + right) / 2, t)
        t = jnp.clip(t, low, high)
        value = jnp.where(accept, at.value, search.value)
        return _Search(t, t - best, best, value, slope, left, right, bend)

    infinite = jnp.full_like(start, jnp.inf)
    zero = jnp.zeros_like(start)
    first = _Search(
        start, zero, start, infinite, zero, -infinite, infinite, zero + bend
    )
    last = jax.lax.fori_loop(0, steps, step, first)
    # The last step has not been tried: a short one is safe, near the bottom.
    return jnp.where(jnp.abs(last.step) < 0.1, last.t, last.best), last.bend
