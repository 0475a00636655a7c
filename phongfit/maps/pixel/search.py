r"""The best exponents of pixels: a scan over log f, then steps of Newton's kind."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from phongfit.maps.pixel.columns import Columns
from phongfit.maps.pixel.exponent import (
    Box,
    Sums,
    best_reflectances,
    evaluate,
    sum_images,
)
from phongfit.maps.pixel.lobes import AbstractLobes, Angles
from phongfit.maps.pixel.small import Numbers, in_groups

# Candidates of a scan are a factor of 2 apart.
SPACING = np.log(2).item()
# Rounds of the box problem where it only ranks candidates.
FEW_ROUNDS = 2
# No step is longer, in log f: beyond a factor of 2 the slope says little.
LONGEST = 0.7
# How far a curvature may be from that of Gauss and Newton to be expected once more.
BENT = 0.1, 10
# Share of the way to a point that was too far at which the next may be tried.
NEAREST = 0.05
# Points so near in log f have slopes whose difference may be rounding, in units of the
# root of the precision.
CLOSE = 30
# Share of a value that its rounding may make up, in units of the precision's.
ROUNDED = 500
# A search has ended where the next step is shorter than this, or than this share of the
# standard error.
SHORTEST = 1e-3
SETTLED = 0.05


class Profile(NamedTuple):
    r"""The best reflectances at exponents all over their range.

    - `t`: (candidates,) logarithms of the exponents, rising.
    - `value`: (candidates, groups, pixels) $\phi$ less a constant.
    - `point`: for each unknown (candidates, channels, pixels), the columns' and last
        that of ρ_s.
    - `sums`: of the images.
    """

    t: Array
    value: Array
    point: Numbers
    sums: Sums


def survey(
    columns: Columns, lobes: AbstractLobes, angles: Angles, box: Box, groups: int
) -> Profile:
    """The profile at all candidates, and at the end of the range."""
    t = jnp.asarray([*_candidates(box), box.highest], columns.rest.dtype)
    sums = sum_images(columns, lobes, angles, t[:, None, None])
    best = best_reflectances(columns, sums, box, FEW_ROUNDS)
    return Profile(t, 2 * in_groups(best.value, groups), best.point, sums)


def _candidates(box: Box) -> Float[np.ndarray, " candidates"]:
    """Exponents of a scan: a factor of 2 apart, from the lowest on."""
    count = max(int(np.ceil((box.highest - box.lowest) / SPACING - 1e-6)), 1)
    return box.lowest + SPACING * np.arange(count)


def best_candidate(profile: Profile, box: Box) -> Float[Array, "groups pixels"]:
    """The log f of least value, refined by a parabola through its neighbours."""
    count = len(_candidates(box))
    value = profile.value[:count]
    best = jnp.argmin(value, axis=0)
    t = box.lowest + SPACING * best.astype(value.dtype)
    left, here, right = (
        jnp.take_along_axis(value, jnp.clip(best + k, 0, count - 1)[None], axis=0)[0]
        for k in (-1, 0, 1)
    )
    bend = left - 2 * here + right
    inner = (best > 0) & (best < count - 1) & (bend > 0)
    shift = jnp.where(inner, (left - right) / (2 * jnp.where(inner, bend, 1)), 0)
    t = t + SPACING * jnp.clip(shift, -0.5, 0.5)
    return jnp.clip(t, box.lowest, box.highest)


class Descent(NamedTuple):
    r"""Where a search ended.

    - `t`: the best, or what one more short step makes of it.
    - `value`, `slope`: $\phi$ less a constant, and $\phi'$, at the best that was tried.
    - `curvature`: $\phi''$ there as Gauss and Newton have it.
    - `bend`: the curvature over that.
    - `ended`: whether what is left to go is too short to matter.
    """

    t: Array
    value: Array
    slope: Array
    curvature: Array
    bend: Array
    ended: Array


class _Search(NamedTuple):
    r"""Where the search stands.

    - `t`: to be looked at next, `step` from the best so far.
    - `best`, `value`, `slope`, `curvature`: the best so far, $\phi$ there, $\phi'$ and
        $\phi''$ as Gauss and Newton have it.
    - `left`, `right`: the bottom lies between them.
    - `bend`: the curvature, over that of Gauss and Newton.
    - `gain`: by how much the next step is expected to lower $\phi$.
    - `done`: how many steps were made.
    """

    t: Array
    step: Array
    best: Array
    value: Array
    slope: Array
    curvature: Array
    left: Array
    right: Array
    bend: Array
    gain: Array
    done: Array


def refine_exponents(
    columns: Columns,
    lobes: AbstractLobes,
    angles: Angles,
    start: Float[Array, "groups pixels"],
    low: Float[Array, "#groups #pixels"],
    high: Float[Array, "#groups #pixels"],
    box: Box,
    steps: int,
    bend: Float[Array, "#groups #pixels"] | float = 1.0,
    most: Int[Array, ""] | int = 0,
    variance: Callable[[Array], Array] | None = None,
) -> Descent:
    r"""A better t: steps down $\phi$ between `low` and `high`.

    Newton's steps on the exact slope. The curvature is the difference of two slopes or,
    until two are known, that of Gauss and Newton, which is several times too large or
    too small where the residuals are those of a photograph. What leads up, and what
    leads down too far, brackets the bottom; a step out of the bracket is halved.

    **Arguments:**

    - `steps`: so many are made in any case.
    - `bend`: the curvature over that of Gauss and Newton, to begin with.
    - `most`: so many are made at most where the bottom is not reached sooner.
    - `variance`: from $\phi$ to the variance of a sample, by which that is judged.
    """
    precision = jnp.finfo(start.dtype).eps
    rounding, close = ROUNDED * precision, CLOSE * precision**0.5

    def step(search: _Search) -> _Search:
        at = evaluate(columns, lobes, angles, search.t, box)
        # Differences below rounding must not send the search back.
        accept = at.value <= search.value + rounding * jnp.abs(search.value)
        moved = search.t - search.best
        secant = (at.slope - search.slope) / jnp.where(moved != 0, moved, 1)
        best = jnp.where(accept, search.t, search.best)
        slope = jnp.where(accept, at.slope, search.slope)
        expected = jnp.where(accept, at.curvature, search.curvature)
        # Where the slope rises, or the point lies above the best, the bottom is past.
        upward = jnp.where(accept, at.slope, moved)
        left = jnp.where(upward < 0, search.t, search.left)
        right = jnp.where(upward > 0, search.t, search.right)
        measured = (jnp.abs(moved) > close) & (secant > 0)
        curvature = jnp.where(measured, secant, search.bend * at.curvature)
        bend = secant / jnp.where(at.curvature > 0, at.curvature, jnp.inf)
        bend = jnp.where(measured, jnp.clip(bend, *BENT), search.bend)
        newton = -slope / jnp.where(curvature > 0, curvature, jnp.inf)
        # Slopes alone stand still before a wall: values, too, tell where the bottom is.
        between = _cubic(search.slope, at.slope, at.value - search.value, moved)
        newton = jnp.where(accept, newton, between)
        t = best + jnp.clip(newton, -LONGEST, LONGEST)
        t = jnp.where(t <= left, (best + left) / 2, t)
        t = jnp.where(t >= right, (best + right) / 2, t)
        t = jnp.clip(t, low, high)
        value = jnp.where(accept, at.value, search.value)
        return _Search(
            t,
            t - best,
            best,
            value,
            slope,
            expected,
            left,
            right,
            bend,
            jnp.abs(slope * (t - best)) / 2,
            search.done + 1,
        )

    def ended(search: _Search) -> Array:
        short = jnp.abs(search.step) <= SHORTEST
        if variance is None:
            return short
        return short | (search.gain <= SETTLED**2 * variance(search.value))

    def unfinished(search: _Search) -> Array:
        return (search.done < steps) | (~ended(search) & (search.done < most))

    def go_on(search: _Search) -> _Search:
        active = unfinished(search)
        return jax.tree.map(
            lambda new, old: jnp.where(active, new, old), step(search), search
        )

    infinite = jnp.full_like(start, jnp.inf)
    zero = jnp.zeros_like(start)
    first = _Search(
        start,
        infinite,
        start,
        infinite,
        zero,
        zero,
        -infinite,
        infinite,
        zero + bend,
        infinite,
        jnp.zeros(start.shape, jnp.int32),
    )
    last = jax.lax.while_loop(lambda s: jnp.any(unfinished(s)), go_on, first)
    # The last step has not been tried: a short one is safe, near the bottom.
    t = jnp.where(jnp.abs(last.step) < 0.1, last.t, last.best)
    return Descent(t, last.value, last.slope, last.curvature, last.bend, ended(last))


def _cubic(slope: Array, beyond: Array, rise: Array, step: Array) -> Array:
    """How far from a point the bottom is of the cubic through it and a higher one.

    Where that is not a good way between them, the middle.

    ??? cite "Source"
        Nocedal and Wright, *Numerical optimization*, 2006, equation 3.59.

    **Arguments:** `slope`, `beyond`: at both; `rise`, `step`: from one to the other.
    """
    length = jnp.where(step != 0, step, 1)
    first = slope + beyond - 3 * rise / length
    root = jnp.sqrt(jnp.maximum(first**2 - slope * beyond, 0)) * jnp.sign(length)
    below = beyond - slope + 2 * root
    share = 1 - (beyond + root - first) / jnp.where(below != 0, below, jnp.inf)
    inside = (share > NEAREST) & (share < 1 - NEAREST)
    return step * jnp.where(inside, share, 0.5)
