r"""From starts to the best normal and material: Levenberg and Marquardt, side by side.

Every pixel has its own damping and stops where its next step would be a small share of
its standard errors. Robust losses make least squares anew at every step.

??? cite "Source"
    Marquardt, *An algorithm for least-squares estimation of nonlinear parameters*, J.
    Soc. Ind. Appl. Math. 11(2), 1963; Holland and Welsch, *Robust regression using
    iteratively reweighted least-squares*, Commun. Stat. Theory Methods 6(9), 1977.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from phongfit.maps.normals.errors import Profile
from phongfit.maps.normals.scale import median_scale
from phongfit.maps.normals.starts import greyed, make_starts
from phongfit.maps.normals.step import (
    edges_of,
    free_to_move,
    held,
    make_move,
    moved,
)
from phongfit.maps.normals.sums import Sums, gather, no_sums, residuals
from phongfit.maps.normals.unknowns import Point, Unknowns
from phongfit.maps.pixel.pixel import Known
from phongfit.maps.pixel.samples import Samples
from phongfit.maps.pixel.settings import MapSettings

# Exponents to begin from: broad and sharp highlights.
BROAD, SHARP = 8.0, 50.0
# Steps from each start, and then at each scale of the residuals.
FEW_STEPS = 7
STEPS = 6
COLOURED = 2
LAST_STEPS = 25
# Square of the step, in standard errors, from which on it does not matter.
ROUGH = 0.1
FINE = 1e-2
# Damping: at first, how it falls and rises, where it says that nothing leads downhill.
DAMPING = 1e-2
FALL, RISE = 0.3, 5.0
STUCK = 1e5
LEAST = 1e-6
# An end that costs so much more is no rival: its residuals are large at any scale.
FAR_OFF = 30.0
# What rounding may add to a cost.
ROUNDED = 20


class Descent(NamedTuple):
    """Where a search stands.

    - `point`, `sums`: the best so far; `trial`: what is looked at next.
    - `decrement`: what the step to there promised, the square of its standard errors.
    - `settled`: the next step does not matter, or nothing leads downhill.
    """

    point: Point
    sums: Sums
    trial: Point
    decrement: Float[Array, " pixels"]
    damping: Float[Array, " pixels"]
    settled: Bool[Array, " pixels"]


class Found(NamedTuple):
    """The best that a search has found.

    - `scale`: that residuals were measured in.
    - `rival`: (pixels,), by how much another normal is worse, in squared noise.
    """

    point: Point
    sums: Sums
    scale: Float[Array, " pixels"]
    settled: Bool[Array, " pixels"]
    rival: Float[Array, " pixels"]


def where_pixels(where: Bool[Array, " pixels"], yes, no):
    """Pixel by pixel, one of two trees of arrays whose last axis is the pixels."""

    def choose(a: Array, b: Array) -> Array:
        return jnp.where(where.reshape((1,) * (a.ndim - 1) + where.shape), a, b)

    return jax.tree.map(choose, yes, no)


def descend(
    point: Point,
    samples: Samples,
    scale: Float[Array, " pixels"],
    most: Array | int,
    enough: Array | float,
    settings: MapSettings,
    which: Unknowns,
    channels: int = 1,
    only_own: Array | bool = False,
    skipped: Array | bool = False,
) -> Descent:
    """Downhill from a point, at a given scale of the residuals.

    **Arguments:**

    - `most`: points to be looked at; `enough`: see [`FINE`][].
    - `channels`: whose sum each channel of the samples is.
    - `only_own`: whether to move each channel's reflectances alone.
    - `skipped`: pixels that need not move.
    """
    edges = edges_of(settings, which, channels)
    viewer = samples.lamps.to_viewer
    rounding = ROUNDED * jnp.finfo(scale.dtype).eps

    def unfinished(state: tuple[Array, Descent]) -> Array:
        return (state[0] < most) & ~jnp.all(state[1].settled)

    def step(state: tuple[Array, Descent]) -> tuple[Array, Descent]:
        done, here = state
        sums = gather(here.trial, samples, scale, settings.loss, settings.model, which)
        better = sums.cost <= here.sums.cost * (1 + rounding)
        small = (here.decrement <= enough) & (here.damping < 1)
        point, sums = where_pixels(
            better & ~here.settled, (here.trial, sums), (here.point, here.sums)
        )
        settled = here.settled | (small & better) | (here.damping > STUCK)
        damping = jnp.maximum(here.damping * jnp.where(better, FALL, RISE), LEAST)
        free = held(free_to_move(point, sums, which, edges), only_own)
        move = make_move(sums, damping, free)
        trial = moved(point, move, viewer, which, edges)
        return done + 1, Descent(point, sums, trial, move.decrement, damping, settled)

    endless = jnp.full_like(scale, jnp.inf)
    first = Descent(
        point,
        no_sums(samples, which)._replace(cost=endless),
        point,
        endless,
        jnp.full_like(scale, DAMPING),
        jnp.broadcast_to(jnp.asarray(skipped), scale.shape),
    )
    return jax.lax.while_loop(unfinished, step, (jnp.zeros((), int), first))[1]


def search(
    samples: Samples,
    known: Known,
    noise: Float[Array, ""],
    settings: MapSettings,
    which: Unknowns,
) -> Found:
    """The best normal and material that several starts lead to.

    They begin with the channels' sum, whose best end counts; then each channel has its
    own reflectances, and the residuals' scale is found anew.
    """
    channels = samples.target.shape[1]
    together = greyed(samples)
    starts = make_starts(together)
    floor = noise if settings.noise_given else jnp.zeros_like(noise)
    wide = _positive(jnp.maximum(starts.matte.scale, floor), together)
    one = _one_channel(which)
    exponents = _exponents(known, settings)
    begins = [
        _begin(normal, t, starts.matte.diffuse, known, which)
        for normal in starts.normals
        for t in exponents
    ]

    def try_start(begin: Point) -> tuple[Point, Array]:
        end = descend(begin, together, wide, FEW_STEPS, ROUGH, settings, one, channels)
        return end.point, end.sums.cost

    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *begins)
    points, costs = jax.lax.map(try_start, stacked)
    best = jnp.argmin(costs, axis=0)
    gaps, other = _rival(points, costs, best)
    unknowns = settings.unknowns(channels)

    def measured(left: Array) -> Array:
        if settings.noise_given:
            return jnp.broadcast_to(noise, wide.shape)
        if not settings.loss.robust:
            return jnp.ones_like(wide)
        return _positive(median_scale(left, samples.share, unknowns), samples)

    def left_by(point: Point) -> Array:
        return residuals(point, samples, settings.model, which)

    remeasured = settings.loss.robust and not settings.noise_given
    steps = (COLOURED, *((STEPS, STEPS) if remeasured else ()), LAST_STEPS)
    last = len(steps) - 1

    def finish(start: tuple[Point, Array]) -> tuple[Descent, Array, Array]:
        begin, skipped = start

        def again(number: Array, found: tuple[Descent, Array]) -> tuple[Descent, Array]:
            point, first = found[0].point, number == 0
            # The reflectances of each channel follow at once: they are linear.
            scale = jnp.where(first, wide, measured(left_by(point)))
            most = jnp.array(steps)[number]
            enough = jnp.where(number == last, FINE, ROUGH)
            end = descend(
                point,
                samples,
                scale,
                most,
                enough,
                settings,
                which,
                only_own=first,
                skipped=skipped,
            )
            return end, scale

        nothing = descend(begin, samples, wide, 0, ROUGH, settings, which)
        end, scale = jax.lax.fori_loop(0, len(steps), again, (nothing, wide))
        return end, scale, left_by(end.point)

    both = [
        _coloured(_pick(points, chosen), channels, known, which)
        for chosen in (best, other)
    ]
    begins = jax.tree.map(lambda *leaves: jnp.stack(leaves), *both)
    skipped = jnp.stack([jnp.zeros_like(gaps, bool), gaps > FAR_OFF])
    ends, scales, left = jax.lax.map(finish, (begins, skipped))
    # Which loss is less is asked at one scale: the smaller of both.
    scale = jnp.where(skipped[1], scales[0], jnp.minimum(scales[0], scales[1]))
    relative = left / scale[None, None, None]
    final = jnp.sum(settings.loss.root(relative) ** 2, axis=(1, 2))
    second = ~skipped[1] & (final[1] < final[0])
    first = jax.tree.map(lambda leaf: leaf[0], ends)
    other_end = jax.tree.map(lambda leaf: leaf[1], ends)
    end = where_pixels(second, other_end, first)
    cosine = jnp.sum(first.point.normal * other_end.point.normal, axis=0)
    apart = ~skipped[1] & (cosine < APART)
    rival = jnp.where(apart, jnp.abs(final[1] - final[0]), jnp.inf)
    scale = jnp.where(second, scales[1], scales[0])
    return Found(end.point, end.sums, scale, end.settled, rival)


def follow_exponent(
    found: Found,
    samples: Samples,
    log_exponents: Float[Array, "2 pixels"],
    settings: MapSettings,
    which: Unknowns,
) -> Profile:
    """The best of all else at other exponents than the one found."""
    fixed = which._replace(exponent=False)

    def at(t: Array) -> tuple[Point, Array]:
        begin = found.point._replace(log_exponent=t)
        end = descend(begin, samples, found.scale, FEW_STEPS, ROUGH, settings, fixed)
        return end.point, end.sums.cost - found.sums.cost

    return Profile(*jax.lax.map(at, log_exponents))


def _positive(scale: Array, samples: Samples) -> Array:
    """A scale above the rounding of what is measured: exact data leave nothing."""
    bright = jnp.max(jnp.abs(samples.target * samples.share), axis=(0, 1))
    least = 1e-6 * bright
    return jnp.maximum(scale, jnp.where(least > 0, least, 1))


def _exponents(known: Known, settings: MapSettings) -> list[Array]:
    """Logarithms of the exponents to begin from."""
    given = jnp.log(known.shininess[0])
    if not (settings.searched and settings.scanned):
        return [given]
    low, high = settings.log_bounds
    return [
        jnp.clip(jnp.log(jnp.full_like(given, f)), low, high) for f in (BROAD, SHARP)
    ]


def _one_channel(which: Unknowns) -> Unknowns:
    """The same of a single channel, whose ρ_s is its own."""
    own = (*which.own, "specular") if which.one_specular else which.own
    return which._replace(own=own, one_specular=False)


def _begin(
    normal: Array, t: Array, diffuse: Array, known: Known, which: Unknowns
) -> Point:
    """A point of the channels' sum: half as much highlight as matte light."""
    pixels = diffuse.shape

    def given(values: Array) -> Array:
        return jnp.broadcast_to(jnp.sum(values), (1, *pixels))

    shiny = which.one_specular or "specular" in which.own
    return Point(
        normal,
        jnp.broadcast_to(t, pixels),
        jnp.zeros((1, *pixels), t.dtype) if "ambient" in which.own
        else given(known.ambient),
        diffuse[None],
        diffuse[None] / 2 if shiny else given(known.specular),
    )  # fmt: skip


def _coloured(point: Point, channels: int, known: Known, which: Unknowns) -> Point:
    """A point of all channels from one of their sum."""
    size = (channels, *point.log_exponent.shape)

    def spread(name: str, values: Array) -> Array:
        if name in which.own:
            return jnp.broadcast_to(values / channels, size)
        return jnp.broadcast_to(getattr(known, name)[:, None], size)

    specular = spread("specular", point.specular)
    return point._replace(
        ambient=spread("ambient", point.ambient),
        diffuse=spread("diffuse", point.diffuse),
        specular=point.specular / channels if which.one_specular else specular,
    )


def _pick(stacked: Point, which: Array) -> Point:
    """Pixel by pixel, one of several stacked points."""

    def pick(leaf: Array) -> Array:
        index = which.reshape((1,) * (leaf.ndim - 1) + which.shape)
        return jnp.take_along_axis(leaf, index, axis=0)[0]

    return jax.tree.map(pick, stacked)


APART = 0.9962
"""Cosine of 5°: normals that are further apart are two."""


def _rival(
    points: Point, costs: Float[Array, "starts pixels"], best: Array
) -> tuple[Float[Array, " pixels"], Array]:
    """By how much the next best end costs more whose normal is another; which it is."""
    normal = _pick(points, best).normal
    cosine = jnp.sum(points.normal * normal[None], axis=1)
    others = jnp.where(cosine < APART, costs, jnp.inf)
    return jnp.min(others, axis=0) - jnp.min(costs, axis=0), jnp.argmin(others, axis=0)
