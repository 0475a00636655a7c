"""One damped Gauss-Newton step, in the box of the reflectances.

The channels are coupled only by the unknowns that they share. So each channel's own
unknowns are eliminated first, which leaves a matrix of at most four shared ones.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from phongfit.maps.pixel.settings import (
    MapSettings,
    Point,
    Unknowns,
    tangents,
    turned_to,
)
from phongfit.maps.pixel.small import (
    Factors,
    Numbers,
    Triangle,
    dot,
    entry,
    factorize,
    only,
    optimization_barrier,
    solve,
    times,
)
from phongfit.maps.pixel.sums import Sums, over_channels

# Longest steps: of the normal in radians, and of log f.
FARTHEST = 0.3
LONGEST = 0.7


class Move(NamedTuple):
    """A step of each channel's own unknowns and of the shared, with its decrement.

    - `decrement`: decrease of the cost if the model is linear, which is the square of
        the step in standard errors.
    """

    own: Numbers
    shared: Numbers
    decrement: Float[Array, " pixels"]


class Free(NamedTuple):
    """Flags of the unknowns that are free to move."""

    own: Numbers
    shared: Numbers


class Reduced(NamedTuple):
    """The shared unknowns' matrix after elimination of the channels' own.

    - `shared`: that matrix; `pull`: its right side.
    - `factors`: of the channels' own; `adapted`: their inverse times `cross`.
    - `cross`: without unknowns that are held.
    """

    shared: Triangle
    pull: Numbers
    factors: Factors
    adapted: tuple[Numbers, ...]
    cross: tuple[Numbers, ...]


def reduce_sums(sums: Sums, damping: Float[Array, " pixels"], free: Free) -> Reduced:
    """Eliminate each channel's own unknowns, which are linear and so not damped."""
    more = 1 + damping
    factors = factorize(only(sums.own, free.own))
    cross = tuple(
        tuple(
            jnp.where(mine & both[None], number, 0)
            for number, mine in zip(row, free.own, strict=True)
        )
        for row, both in zip(sums.cross, free.shared, strict=True)
    )
    pulled = _of_free(sums.pull_own, free.own)
    adapted = tuple(solve(factors, row) for row in cross)
    shared = tuple(
        tuple(
            number - over_channels(dot(cross[i], adapted[j]))
            for j, number in enumerate(row)
        )
        for i, row in enumerate(_damped(sums.shared, more))
    )
    pull = tuple(
        jnp.where(mine, number - over_channels(dot(pulled, row)), 0)
        for number, row, mine in zip(
            sums.pull_shared, adapted, free.shared, strict=True
        )
    )
    return optimization_barrier(
        Reduced(only(shared, free.shared), pull, factors, adapted, cross)
    )


def make_move(sums: Sums, damping: Float[Array, " pixels"], free: Free) -> Move:
    """The damped step of all free unknowns."""
    reduced = reduce_sums(sums, damping, free)
    shared = solve(factorize(reduced.shared), reduced.pull) if reduced.shared else ()
    left = _of_free(sums.pull_own, free.own)
    for x, row in zip(shared, reduced.cross, strict=True):
        left = tuple(b - x[None] * c for b, c in zip(left, row, strict=True))
    own = solve(reduced.factors, left)
    promised = over_channels(dot(own, sums.pull_own)) + dot(shared, sums.pull_shared)
    return optimization_barrier(Move(own, shared, promised))


def respond(sums: Sums, free: Free, place: int) -> Move:
    """Change of all other unknowns when log f, at `place`, increases by one."""
    still = jnp.zeros_like(sums.cost)
    shared = list(free.shared)
    shared[place] = jnp.zeros_like(shared[place])
    pulled = sums._replace(
        pull_own=tuple(-number for number in sums.cross[place]),
        pull_shared=tuple(
            -entry(sums.shared, place, k) for k in range(len(sums.shared))
        ),
    )
    return make_move(pulled, still, Free(free.own, tuple(shared)))


def _of_free(values: Numbers, free: Numbers) -> Numbers:
    return tuple(
        jnp.where(mine, number, 0) for number, mine in zip(values, free, strict=True)
    )


def _damped(matrix: Triangle, more: Array) -> Triangle:
    """Matrix with its diagonal multiplied by `more`, as in Marquardt's method."""
    return tuple(
        (*row[:-1], row[-1] * more + jnp.finfo(more.dtype).tiny) for row in matrix
    )


class Edges(NamedTuple):
    """The box: a low and a high for each own unknown, for ρ_s, and for log f."""

    own: tuple[tuple[float, float], ...]
    specular: tuple[float, float]
    log_exponent: tuple[float, float]


def edges_of(settings: MapSettings, which: Unknowns, channels: int = 1) -> Edges:
    """Bounds of the settings, multiplied for the sum of `channels` channels."""

    def wide(name: str) -> tuple[float, float]:
        low, high = settings.bound(name)
        return channels * low, channels * high

    own = tuple(wide(name) for name in which.own)
    return Edges(own, wide("specular"), settings.log_bounds)


def free_to_move(point: Point, sums: Sums, which: Unknowns, edges: Edges) -> Free:
    """Flags of all unknowns but those at a bound whose gradient points outwards."""

    def inward(value: Array, pull: Array, edge: tuple[float, float]) -> Array:
        low, high = edge
        return ((value > low) | (pull > 0)) & ((value < high) | (pull < 0))

    own = tuple(
        inward(getattr(point, name), pull, edge)
        for name, pull, edge in zip(which.own, sums.pull_own, edges.own, strict=True)
    )
    always = jnp.ones(point.log_exponent.shape, bool)
    shared = [always] * which.place
    if which.exponent:
        pull = sums.pull_shared[which.place]
        shared.append(inward(point.log_exponent, pull, edges.log_exponent))
    if which.one_specular:
        pull = sums.pull_shared[-1]
        shared.append(inward(point.specular[0], pull, edges.specular))
    return Free(own, tuple(shared))


def steadied(sums: Sums, which: Unknowns, edges: Edges) -> Sums:
    """Sums with a weak prior, so that unidentified unknowns do not move.

    The prior of log f and of each reflectance is its present value, with the width of
    its box as standard deviation. The normal has no prior.
    """

    def more(matrix: Triangle, widths: dict[int, tuple[float, float]]) -> Triangle:
        return tuple(
            (*row[:-1], row[-1] + (widths[k][1] - widths[k][0]) ** -2)
            if k in widths
            else row
            for k, row in enumerate(matrix)
        )

    shared = {}
    if which.exponent:
        shared[which.place] = edges.log_exponent
    if which.one_specular:
        shared[which.n_shared - 1] = edges.specular
    own = dict(enumerate(edges.own))
    return sums._replace(own=more(sums.own, own), shared=more(sums.shared, shared))


def adapt_own(point: Point, sums: Sums, which: Unknowns, edges: Edges) -> Move:
    """The step of each channel's own unknowns alone, and its decrease of the cost.

    The step is clipped to the box, and 0 if the clipped step would raise the cost. The
    decrease is exact, since light is linear in these unknowns.
    """
    free = free_to_move(point, sums, which, edges).own
    pull = _of_free(sums.pull_own, free)
    steps = optimization_barrier(solve(factorize(only(sums.own, free)), pull))
    values = [getattr(point, name) for name in which.own]
    own = tuple(
        jnp.clip(value + step, *edge) - value
        for value, step, edge in zip(values, steps, edges.own, strict=True)
    )
    gain = 2 * dot(own, sums.pull_own) - dot(own, times(sums.own, own))
    better = gain > 0
    still = tuple(jnp.zeros_like(pull) for pull in sums.pull_shared)
    return optimization_barrier(
        Move(
            tuple(jnp.where(better, step, 0) for step in own),
            still,
            over_channels(jnp.where(better, gain, 0)),
        )
    )


def moved(
    point: Point,
    move: Move,
    to_viewer: Float[Array, "3 #pixels"],
    which: Unknowns,
    edges: Edges,
) -> Point:
    """The point after a step, clipped to its box, with the normal facing the viewer."""
    found = point
    if which.normal:
        first, second = tangents(point.normal)
        a, b = move.shared[:2]
        far = jnp.sqrt(a**2 + b**2)
        shorter = jnp.minimum(1, FARTHEST / jnp.where(far > 0, far, 1))[None]
        normal = point.normal + shorter * (a[None] * first + b[None] * second)
        found = point._replace(normal=turned_to(normal, to_viewer))
    for name, step, (low, high) in zip(which.own, move.own, edges.own, strict=True):
        value = jnp.clip(getattr(point, name) + step, low, high)
        found = found._replace(**{name: value})
    if which.exponent:
        step = jnp.clip(move.shared[which.place], -LONGEST, LONGEST)
        t = jnp.clip(point.log_exponent + step, *edges.log_exponent)
        found = found._replace(log_exponent=t)
    if which.one_specular:
        specular = jnp.clip(point.specular + move.shared[-1][None], *edges.specular)
        found = found._replace(specular=specular)
    return found


def held(free: Free, shared: Array | bool) -> Free:
    """`free` with all shared unknowns held if `shared` is true."""
    return Free(free.own, tuple(one & ~jnp.asarray(shared) for one in free.shared))
