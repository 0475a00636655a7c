r"""The best exponents of pixels: a scan over log f, then quasi-Newton steps."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

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

# Distance of a scan's candidates in log f: a factor of 2.
SPACING = np.log(2).item()
# Rounds of the box problem if it only ranks candidates.
FEW_ROUNDS = 2
# Longest step in log f: the slope does not predict φ beyond a factor of 2 in f.
LONGEST = 0.7
# Range to which the ratio of a measured curvature to the Gauss-Newton curvature is
# clipped before later steps use it.
BENT = 0.1, 10
# Least fraction of the way to a rejected point at which the next one may be tried.
NEAREST = 0.05
# Distance in log f below which a difference of slopes may be rounding, in units of the
# root of the machine precision.
CLOSE = 30
# Relative rounding of φ, in units of the machine precision.
ROUNDED = 500
# Converged: the next step in log f is shorter than this, or than this fraction of the
# standard error.
SHORTEST = 1e-3
SETTLED = 0.05


class Profile(NamedTuple):
    r"""The best reflectances at exponents over the whole range.

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
    """Log exponents of a scan, a factor of 2 apart, from the lowest on."""
    count = max(int(np.ceil((box.highest - box.lowest) / SPACING - 1e-6)), 1)
    return box.lowest + SPACING * np.arange(count)


def best_candidate(profile: Profile, box: Box) -> Float[Array, "groups pixels"]:
    """The log f of lowest φ, refined by a parabola through its neighbours."""
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
    """Result of a search for exponents.

    - `t`: log f of least value, or after one more short step from it.
    - `bend`: curvature there relative to that of Gauss and Newton.
    """

    t: Array
    bend: Array


class _Search(NamedTuple):
    r"""State of the search.

    - `t`: the next point to evaluate, `step` from the best so far.
    - `best`, `value`, `slope`: the best point so far, with $\phi$ and $\phi'$ there.
    - `left`, `right`: a bracket of the minimum.
    - `bend`: ratio of the measured curvature to its Gauss-Newton approximation.
    - `gain`: expected decrease of $\phi$ by the next step.
    - `done`: number of steps made.
    """

    t: Array
    step: Array
    best: Array
    value: Array
    slope: Array
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
    box: Box,
    steps: int,
    bend: Float[Array, "#groups #pixels"] | float = 1.0,
    most: int = 0,
    variance: Callable[[Array], Array] | None = None,
) -> Descent:
    r"""Minimise $\phi$ over t within its bounds.

    The steps are Newton's, with the exact slope. The curvature comes from the
    difference of two slopes; before there are two, it is the Gauss-Newton curvature,
    which is wrong by a factor of several for residuals of photographs. Points beyond
    the minimum on either side bracket it; a step out of the bracket is halved.

    **Arguments:**

    - `steps`: minimum number of steps.
    - `bend`: initial ratio of the curvature to the Gauss-Newton curvature.
    - `most`: maximum number of steps if the search does not converge sooner.
    - `variance`: from $\phi$ to the variance of a sample, for the test of convergence.
    """
    precision = jnp.finfo(start.dtype).eps
    rounding, close = ROUNDED * precision, CLOSE * precision**0.5

    def step(search: _Search) -> _Search:
        at = evaluate(columns, lobes, angles, search.t, box)
        # A rise of φ within rounding is accepted: it is not a real increase.
        accept = at.value <= search.value + rounding * jnp.abs(search.value)
        moved = search.t - search.best
        secant = (at.slope - search.slope) / jnp.where(moved != 0, moved, 1)
        best = jnp.where(accept, search.t, search.best)
        slope = jnp.where(accept, at.slope, search.slope)
        # The minimum lies before a point where φ rises or is above the best value.
        upward = jnp.where(accept, at.slope, moved)
        left = jnp.where(upward < 0, search.t, search.left)
        right = jnp.where(upward > 0, search.t, search.right)
        measured = (jnp.abs(moved) > close) & (secant > 0)
        curvature = jnp.where(measured, secant, search.bend * at.curvature)
        bend = secant / jnp.where(at.curvature > 0, at.curvature, jnp.inf)
        bend = jnp.where(measured, jnp.clip(bend, *BENT), search.bend)
        newton = -slope / jnp.where(curvature > 0, curvature, jnp.inf)
        # Steps from slopes alone can stall before a steep rise: after a rejected point,
        # the cubic uses the values as well.
        between = _cubic(search.slope, at.slope, at.value - search.value, moved)
        newton = jnp.where(accept, newton, between)
        t = best + jnp.clip(newton, -LONGEST, LONGEST)
        t = jnp.where(t <= left, (best + left) / 2, t)
        t = jnp.where(t >= right, (best + right) / 2, t)
        t = jnp.clip(t, box.lowest, box.highest)
        value = jnp.where(accept, at.value, search.value)
        return _Search(
            t,
            t - best,
            best,
            value,
            slope,
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
        -infinite,
        infinite,
        zero + bend,
        infinite,
        jnp.zeros(start.shape, jnp.int32),
    )
    last = jax.lax.while_loop(lambda s: jnp.any(unfinished(s)), go_on, first)
    # The last step was not evaluated. A short one is safe: it is near the minimum.
    t = jnp.where(jnp.abs(last.step) < 0.1, last.t, last.best)
    return Descent(t, last.bend)


def _cubic(slope: Array, beyond: Array, rise: Array, step: Array) -> Array:
    """Distance to the minimum of the cubic through a point and a higher one.

    Half of the way if that minimum is too close to either point.

    ??? cite "Source"
        Nocedal and Wright, *Numerical optimization*, 2006, equation 3.59.

    **Arguments:** `slope`, `beyond`: slopes at the two points; `rise`, `step`:
    differences of value and position between them.
    """
    length = jnp.where(step != 0, step, 1)
    first = slope + beyond - 3 * rise / length
    root = jnp.sqrt(jnp.maximum(first**2 - slope * beyond, 0)) * jnp.sign(length)
    below = beyond - slope + 2 * root
    share = 1 - (beyond + root - first) / jnp.where(below != 0, below, jnp.inf)
    inside = (share > NEAREST) & (share < 1 - NEAREST)
    return step * jnp.where(inside, share, 0.5)
