r"""Search for the best normal and material of pixels by Levenberg-Marquardt.

Every pixel has its own damping, and stops when its next step would be a small fraction
of its standard errors. For a robust loss, samples are reweighted at every step.

??? cite "Source"
    Marquardt, *An algorithm for least-squares estimation of nonlinear parameters*, J.
    Soc. Ind. Appl. Math. 11(2), 1963; Holland and Welsch, *Robust regression using
    iteratively reweighted least-squares*, Commun. Stat. Theory Methods 6(9), 1977.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from phongfit.fitting.problem.losses import Linear
from phongfit.maps.pixel.errors import Profile
from phongfit.maps.pixel.samples import Known, Samples
from phongfit.maps.pixel.scale import count_used, median_scale
from phongfit.maps.pixel.settings import MapSettings, Point, Unknowns
from phongfit.maps.pixel.starts import greyed, make_starts
from phongfit.maps.pixel.step import (
    Move,
    adapt_own,
    edges_of,
    free_to_move,
    held,
    make_move,
    moved,
    respond,
    steadied,
)
from phongfit.maps.pixel.sums import Sums, gather, no_sums, residuals

# Start exponents: of a broad and of a sharp highlight.
BROAD, SHARP = 8.0, 50.0
# Number of start exponents over the whole range, if normals are known.
SCANNED = 8
# Numbers of evaluated points (thorough search, fast search): from each start, from the
# best of them, and at the final scale of the residuals.
STEPS = (7, 2), (12, 6), (40, 5)
# Numbers of evaluated points in earlier stages: when each channel's reflectances are
# fitted first, and at earlier scales of the residuals.
COLOURED, ROUGHLY = 1, 4
# Numbers of evaluated points (thorough, fast) at exponents of a profile.
FOLLOWED = 7, 3
# Converged: the square of the step in standard errors is below this.
ROUGH = 0.1
FINE = 1e-2
# Convergence limit if only the cost is needed, since steps predict its decrease well.
VAGUELY = 0.5
# Damping: first value, factors on success and failure, the limit above which no descent
# step exists, and the least value.
DAMPING = 1e-3
FALL, RISE = 0.1, 8.0
STUCK = 1e5
LEAST = 1e-6
# An end is not a rival if its cost is higher by more than this times the cost per
# degree of freedom: its residuals are then large at any scale.
FAR_OFF = 16.0
# Relative rounding of a cost, in units of the machine precision.
ROUNDED = 20


class Descent(NamedTuple):
    """State of a search.

    - `point`, `sums`: the best so far; `trial`: the next point to evaluate.
    - `cost`: of the best, after each channel's own unknowns have adapted to it.
    - `settled`: converged: the next step is below tolerance, or no descent step exists.
        A step below tolerance is taken without evaluation, and its predicted cost used.
    """

    point: Point
    sums: Sums
    cost: Float[Array, " pixels"]
    trial: Point
    damping: Float[Array, " pixels"]
    settled: Bool[Array, " pixels"]


class SearchResult(NamedTuple):
    """Result of a search: the best point of all starts.

    - `cost`: see [`Descent`][].
    - `scale`: unit of the residuals; `left`: the residuals, see [`residuals`][].
    - `rival`: (pixels,), by how much another normal is worse, in squared noise.
    - `near`: true if another start did nearly as well: a thorough search follows it.
    """

    point: Point
    sums: Sums
    cost: Float[Array, " pixels"]
    scale: Float[Array, " pixels"]
    left: Float[Array, "images channels pixels"]
    settled: Bool[Array, " pixels"]
    rival: Float[Array, " pixels"]
    near: Bool[Array, " pixels"]


def where_pixels(where: Bool[Array, " pixels"], yes, no):
    """`yes` or `no` for each pixel: two trees of arrays with pixels as last axis."""

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
    alone: Array | int = 0,
    skipped: Array | bool = False,
) -> Descent:
    """Minimise the cost from a point, at a given scale of the residuals.

    **Arguments:**

    - `most`: maximum number of evaluated points; `enough`: see [`FINE`][].
    - `channels`: number of channels that each channel of the samples is the sum of.
    - `alone`: number of first steps that move only each channel's reflectances.
    - `skipped`: pixels that are not fitted.
    """
    edges = edges_of(settings, which, channels)
    viewer = samples.lamps.to_viewer
    rounding = ROUNDED * jnp.finfo(scale.dtype).eps

    def unfinished(state: tuple[Array, Descent]) -> Array:
        return (state[0] < most) & ~jnp.all(state[1].settled)

    def step(state: tuple[Array, Descent]) -> tuple[Array, Descent]:
        done, here = state
        sums = gather(here.trial, samples, scale, settings, which)
        told = steadied(sums, which, edges)
        cost = sums.cost - adapt_own(here.trial, told, which, edges).decrement
        better = cost <= here.cost * (1 + rounding)
        point, sums, cost = where_pixels(
            better & ~here.settled,
            (here.trial, sums, cost),
            (here.point, here.sums, here.cost),
        )
        damping = jnp.maximum(here.damping * jnp.where(better, FALL, RISE), LEAST)
        early = done < alone
        free = held(free_to_move(point, sums, which, edges), early)
        move = make_move(steadied(sums, which, edges), damping, free)
        trial = moved(point, move, viewer, which, edges)
        small = better & (move.decrement <= enough) & (damping < 1) & ~early
        promised = trial, sums.cost - move.decrement
        point, cost = where_pixels(small & ~here.settled, promised, (point, cost))
        settled = here.settled | small | (damping > STUCK)
        return done + 1, Descent(point, sums, cost, trial, damping, settled)

    first = _before(point, samples, scale, which, skipped)
    begin = jnp.zeros((), int), first
    end = jax.lax.while_loop(unfinished, step, begin)[1]
    told = steadied(end.sums, which, edges)
    adapted = adapt_own(end.point, told, which, edges)
    point = moved(end.point, adapted, viewer, which, edges)
    return end._replace(point=where_pixels(end.settled, end.point, point))


def _before(
    point: Point,
    samples: Samples,
    scale: Float[Array, " pixels"],
    which: Unknowns,
    skipped: Array | bool,
) -> Descent:
    """State before the first point is evaluated."""
    return Descent(
        point,
        no_sums(samples, which),
        jnp.full_like(scale, jnp.inf),
        point,
        jnp.full_like(scale, DAMPING),
        jnp.broadcast_to(jnp.asarray(skipped), scale.shape),
    )


def search(
    samples: Samples,
    known: Known,
    noise: Float[Array, ""],
    settings: MapSettings,
    which: Unknowns,
    thorough: Array | bool = True,
    normal: Float[Array, "3 pixels"] | None = None,
) -> SearchResult:
    """Find the best normal and material from several starts.

    **Arguments:** `known`: with leaves of shape (channels, #pixels); `thorough`:
    whether to go on until all pixels have converged, and to follow another start that
    may be as good; `normal`: unit vectors if they are known.
    """
    if normal is None:
        starts = _try_normals(samples, known, noise, settings, which, thorough)
    else:
        starts = _try_exponents(samples, normal, known, noise, settings, which)
    finish = functools.partial(
        _finish, samples=samples, noise=noise, wide=starts.wide,
        most=jnp.where(thorough, *STEPS[2]), settings=settings, which=which,
    )  # fmt: skip
    near = starts.near
    begins = jax.tree.map(lambda *leaves: jnp.stack(leaves), starts.best, starts.other)
    skipped = jnp.stack([jnp.zeros_like(near), ~(near & thorough)])
    ends, scales, left = jax.lax.map(finish, (begins, skipped))
    # Losses are comparable only at one scale: the smaller of both.
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
    left = where_pixels(second, left[1], left[0])
    return SearchResult(
        end.point, end.sums, end.cost, scale, left, end.settled, rival, near
    )


class _Starts(NamedTuple):
    """Two points of all channels to start from.

    - `near`: whether the second one is nearly as good.
    - `wide`: first scale of the residuals.
    """

    best: Point
    other: Point
    near: Bool[Array, " pixels"]
    wide: Float[Array, " pixels"]


def _try_normals(
    samples: Samples,
    known: Known,
    noise: Float[Array, ""],
    settings: MapSettings,
    which: Unknowns,
    thorough: Array | bool,
) -> _Starts:
    """Starts from several normals and exponents, fitted to the sum of the channels."""
    channels = samples.target.shape[1]
    together = greyed(samples)
    starts = make_starts(together)
    floor = noise if settings.noise_given else jnp.zeros_like(noise)
    wide = _positive(jnp.maximum(starts.matte.scale, floor), together)
    one = _one_channel(which)
    exponents = _exponents(known, settings, (BROAD, SHARP))
    begins = [
        _begin(normal, t, starts.matte.diffuse, known, which)
        for normal in starts.normals
        for t in exponents
    ]
    few, polished = (jnp.where(thorough, *each) for each in STEPS[:2])
    # Fast mode skips plain least squares, which is hardly ever the better start.
    plain = jnp.arange(len(begins)) < len(exponents)
    steps = jnp.where(plain & ~jnp.asarray(thorough), 0, few)

    def try_start(start: tuple[Point, Array]) -> tuple[Point, Array]:
        begin, steps = start
        end = descend(begin, together, wide, steps, ROUGH, settings, one, channels)
        return end.point, end.cost

    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *begins)
    points, costs = jax.lax.map(try_start, (stacked, steps))
    best = jnp.argmin(costs, axis=0)
    rivals = _rivals(points, costs, best)
    winner, cost = try_start((_pick(points, best), polished))
    freedom = count_used(together.share) - settings.unknowns(1)
    close = rivals.gaps * jnp.maximum(freedom, 1)[None] <= FAR_OFF * cost[None]
    # If there are both, follow another normal rather than another highlight.
    other = _pick(points, jnp.where(close[0], *rivals.starts))
    first, second = (
        _coloured(point, channels, known, which) for point in (winner, other)
    )
    return _Starts(first, second, jnp.any(close, axis=0), wide)


def _try_exponents(
    samples: Samples,
    normal: Float[Array, "3 pixels"],
    known: Known,
    noise: Float[Array, ""],
    settings: MapSettings,
    which: Unknowns,
) -> _Starts:
    """Starts from exponents over the whole range, with the best reflectances at each.

    They are found by least squares, which has no false minimum in reflectances.
    """
    size = samples.target.shape[1:]
    plain = dataclasses.replace(settings, loss=Linear())
    scale = 1e4 * _positive(jnp.zeros(size[1:], noise.dtype), samples)

    def try_exponent(t: Array) -> tuple[Point, Array]:
        def value(name: str) -> Array:
            given = 0 if name in which.own else getattr(known, name)
            return jnp.broadcast_to(jnp.asarray(given, noise.dtype), size)

        ambient, diffuse, specular = map(value, ("ambient", "diffuse", "specular"))
        t = jnp.broadcast_to(t, size[1:])
        begin = Point(normal, t, ambient, diffuse, specular)
        end = descend(begin, samples, scale, 1, 0.0, plain, which)
        return end.point, end.cost

    grid = np.exp(np.linspace(*settings.log_bounds, SCANNED))
    exponents = _exponents(known, settings, tuple(grid))
    points, costs = jax.lax.map(try_exponent, jnp.stack(exponents))
    number = jnp.argmin(costs, axis=0)
    best = _pick(points, number)
    unknowns = settings.unknowns(size[0])
    freedom = jnp.maximum(count_used(samples.share) - unknowns, 1)
    # Costs are differences of large sums of squares, too inexact for a small scale.
    left = residuals(best, samples, settings, which)
    if not settings.loss.robust:
        wide = jnp.broadcast_to(noise, size[1:])
        if not settings.noise_given:
            wide = jnp.sqrt(jnp.sum(left**2, axis=(0, 1)) / freedom)
        wide = _positive(wide, samples)
        return _Starts(best, best, jnp.zeros(size[1:], bool), wide)
    floor = noise if settings.noise_given else jnp.zeros_like(noise)
    wide = jnp.maximum(median_scale(left, samples.share, unknowns), floor)
    wide = _positive(wide, samples)

    # An outlier in the highlight attracts least squares, so all exponents are tried.
    def try_again(point: Point) -> tuple[Point, Array]:
        end = descend(point, samples, wide, ROUGHLY, ROUGH, settings, which)
        return end.point, end.cost

    points, costs = jax.lax.map(try_again, points)
    number = jnp.argmin(costs, axis=0)
    rivals = _rivals(points, costs, number)
    near = rivals.gaps[1] * freedom <= FAR_OFF * jnp.min(costs, axis=0)
    return _Starts(_pick(points, number), _pick(points, rivals.starts[1]), near, wide)


def _finish(
    start: tuple[Point, Bool[Array, " pixels"]],
    samples: Samples,
    noise: Float[Array, ""],
    wide: Float[Array, " pixels"],
    most: Array,
    settings: MapSettings,
    which: Unknowns,
) -> tuple[Descent, Float[Array, " pixels"], Float[Array, "images channels pixels"]]:
    """Fit all channels from a point: returns the end, its scale, and its residuals.

    **Arguments:** `start`: a point, and pixels that are not fitted.
    """
    begin, skipped = start
    unknowns = settings.unknowns(samples.target.shape[1])
    freedom = jnp.maximum(count_used(samples.share) - unknowns, 1)
    last = 2 if settings.loss.robust and not settings.noise_given else 1
    # After a scan by least squares all channels are fitted at its scale.
    first = 0 if which.normal or settings.loss.robust else last

    def left_by(point: Point) -> Array:
        return residuals(point, samples, settings, which)

    def measured(end: Descent, scale: Array) -> Array:
        if settings.noise_given:
            return jnp.broadcast_to(noise, wide.shape)
        if settings.loss.robust:
            scale = median_scale(left_by(end.point), samples.share, unknowns)
        else:
            scale = scale * jnp.sqrt(jnp.maximum(end.cost, 0) / freedom)
        return _positive(scale, samples)

    def again(stage: Array, found: tuple[Descent, Array]) -> tuple[Descent, Array]:
        end, scale = found
        # First each channel's reflectances, which are linear, at the same scale.
        alone, final = stage == 0, stage == last
        scale = jax.lax.cond(
            stage == first, lambda: scale, lambda: measured(end, scale)
        )
        steps = jnp.where(alone, COLOURED, jnp.where(final, most, ROUGHLY))
        end = descend(
            end.point,
            samples,
            scale,
            steps,
            jnp.where(final, FINE, ROUGH),
            settings,
            which,
            alone=jnp.where(alone, COLOURED, 0),
            skipped=skipped,
        )
        return end, scale

    def go_on() -> tuple[Descent, Array, Array]:
        end, scale = jax.lax.fori_loop(first, last + 1, again, (nothing, wide))
        return end, scale, left_by(end.point)

    nothing = _before(begin, samples, wide, which, skipped)
    still = nothing, wide, jnp.zeros_like(samples.target)
    return jax.lax.cond(jnp.all(skipped), lambda: still, go_on)


def follow_exponent(
    found: SearchResult,
    samples: Samples,
    log_exponents: Float[Array, "exponents pixels"],
    wanted: Bool[Array, " pixels"],
    settings: MapSettings,
    which: Unknowns,
    thorough: Array | bool = True,
) -> Profile:
    """Fit all other unknowns at other exponents.

    If normals are unknown, the fits start from the solution of the linearised model.

    **Arguments:** `wanted`: pixels to be fitted.
    """
    fixed = which._replace(exponent=False)
    edges = edges_of(settings, which)
    viewer = samples.lamps.to_viewer
    response = respond(
        found.sums, free_to_move(found.point, found.sums, which, edges), which.place
    )
    most = jnp.where(thorough, *FOLLOWED)

    def at(t: Array) -> tuple[Point, Array, Array]:
        begin = found.point
        if which.normal:
            off = t - begin.log_exponent
            own = tuple(off[None] * number for number in response.own)
            shared = tuple(off * number for number in response.shared)
            begin = moved(begin, Move(own, shared, off), viewer, which, edges)
        begin = begin._replace(log_exponent=t)
        end = descend(
            begin, samples, found.scale, most, VAGUELY, settings, fixed, skipped=~wanted
        )
        return end.point, end.cost - found.cost, end.settled

    points, rises, settled = jax.lax.map(at, log_exponents)
    return Profile(points, rises, jnp.all(settled, axis=0))


def _positive(scale: Array, samples: Samples) -> Array:
    """Scale of at least the rounding of the data: exact data leave no residual."""
    bright = jnp.max(jnp.abs(samples.target * samples.share), axis=(0, 1))
    least = 1e-6 * bright
    return jnp.maximum(scale, jnp.where(least > 0, least, 1))


def _exponents(
    known: Known, settings: MapSettings, tried: tuple[float, ...]
) -> list[Array]:
    """Logarithms of start exponents, (#pixels,): those tried, or the given one."""
    given = jnp.log(known.shininess[0])
    if not (settings.searched and settings.scanned):
        return [given]
    low, high = settings.log_bounds
    return [jnp.clip(jnp.log(jnp.full_like(given, f)), low, high) for f in tried]


def _one_channel(which: Unknowns) -> Unknowns:
    """Unknowns of a single channel, where ρ_s is the channel's own."""
    own = (*which.own, "specular") if which.one_specular else which.own
    return which._replace(own=own, one_specular=False)


def _begin(
    normal: Array, t: Array, diffuse: Array, known: Known, which: Unknowns
) -> Point:
    """Start point for the channels' sum, with ρ_s half of ρ_d."""
    pixels = diffuse.shape

    def given(values: Array) -> Array:
        return jnp.broadcast_to(jnp.sum(values, axis=0), (1, *pixels))

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
    """Point of all channels, made from a point of their sum."""
    size = (channels, *point.log_exponent.shape)

    def spread(name: str, values: Array) -> Array:
        if name in which.own:
            return jnp.broadcast_to(values / channels, size)
        return jnp.broadcast_to(getattr(known, name), size)

    specular = spread("specular", point.specular)
    return point._replace(
        ambient=spread("ambient", point.ambient),
        diffuse=spread("diffuse", point.diffuse),
        specular=point.specular / channels if which.one_specular else specular,
    )


def _pick(stacked: Point, which: Array) -> Point:
    """One of several stacked points for each pixel."""

    def pick(leaf: Array) -> Array:
        index = which.reshape((1,) * (leaf.ndim - 1) + which.shape)
        return jnp.take_along_axis(leaf, index, axis=0)[0]

    return jax.tree.map(pick, stacked)


APART = 0.9962
"""Cosine of 5°: normals further apart count as different."""

ANOTHER = 1.0
"""Difference of log f above which two highlights count as different."""


class _Rivals(NamedTuple):
    """The best ends with another normal and with another highlight.

    - `starts`: their numbers; `gaps`: how much higher their costs are. (2, pixels)
        each.
    """

    starts: Int[Array, "2 pixels"]
    gaps: Float[Array, "2 pixels"]


def _rivals(
    points: Point, costs: Float[Array, "starts pixels"], best: Array
) -> _Rivals:
    """Find the best ends of other starts with a different normal or highlight."""
    first = _pick(points, best)
    cosine = jnp.sum(points.normal * first.normal[None], axis=1)
    off = jnp.abs(points.log_exponent - first.log_exponent[None])
    others = jnp.stack(
        [jnp.where(other, costs, jnp.inf) for other in (cosine < APART, off > ANOTHER)]
    )
    gaps = jnp.min(others, axis=1) - jnp.min(costs, axis=0)[None]
    return _Rivals(jnp.argmin(others, axis=1), gaps)
