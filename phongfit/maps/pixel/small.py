r"""Linear algebra of one to four unknowns, written out number by number.

A library call for a matrix of 3 × 3 costs more than all else that a pixel needs. So a
vector is a tuple of numbers here and a symmetric matrix a tuple of the rows of its
lower triangle: batched, each entry is one array with the pixels side by side.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

Numbers: TypeAlias = tuple[Array, ...]
Triangle: TypeAlias = tuple[Numbers, ...]


T = TypeVar("T")

# Images of a run.
RUN = 4


KEEP_BARRIERS = {"xla_disable_hlo_passes": "cse_barrier_expander"}
"""XLA option for programs with [`optimization_barrier`][], not documented by XLA.

Otherwise XLA removes barriers on a CPU before it fuses operations.
"""


def optimization_barrier(values: T) -> T:
    """The same values, computed once and kept.

    XLA fuses each result with everything that it depends on, so intermediate values are
    computed anew for each of several results; in a chain of solutions that multiplies.
    Measured on two cores with 96² pixels, warm: maps with normals sought under 49
    lights take 2.5 s with the barriers of this module and of `maps/normals`, 6.3 s
    without those of this module, 17 to 22 s without any.
    """
    return jax.lax.optimization_barrier(values)


class Factors(NamedTuple):
    r"""$H = L D L^\top$: rows of L below its diagonal, and the inverses of D.

    A direction that rounding alone could have made has an inverse of 0: nothing is
    known along it, and nothing moves. `last` is the last entry of D.
    """

    lower: Triangle
    inverse: Numbers
    last: Array


def entry(matrix: Triangle, i: int, j: int) -> Array:
    """One number of a symmetric matrix."""
    return matrix[max(i, j)][min(i, j)]


def factorize(matrix: Triangle, last: int | None = None) -> Factors:
    """Factors of a positive semidefinite matrix.

    The last entry of D is the last unknown's curvature once all others have adapted to
    it; 0 where it is lost in rounding.

    **Arguments:** `last`: the unknown to be put last; default the last.
    """
    order = list(range(len(matrix)))
    if last is not None:
        order.append(order.pop(last))
    lower: list[Numbers] = []
    inverse: list[Array] = []
    pivot = jnp.zeros_like(matrix[0][0])
    smallest = 100 * jnp.finfo(pivot.dtype).eps
    for i, which in enumerate(order):
        # Row i of L times D, from the rows above.
        row: list[Array] = []
        for j in range(i):
            number = entry(matrix, which, order[j])
            for k in range(j):
                number = number - row[k] * lower[j][k]
            row.append(number)
        scaled = tuple(number * d for number, d in zip(row, inverse, strict=True))
        whole = entry(matrix, which, which)
        pivot = whole
        for number, share in zip(row, scaled, strict=True):
            pivot = pivot - number * share
        identified = pivot > smallest * whole
        pivot = jnp.where(identified, pivot, 0)
        inverse.append(jnp.where(identified, 1 / jnp.where(identified, pivot, 1), 0))
        lower.append(scaled)
    return optimization_barrier(Factors(tuple(lower), tuple(inverse), pivot))


def solve(factors: Factors, vector: Numbers) -> Numbers:
    """The x of $H x = b$; 0 for unknowns that rounding hides."""
    size = len(vector)
    forward: list[Array] = []
    for i in range(size):
        number = vector[i]
        for k in range(i):
            number = number - factors.lower[i][k] * forward[k]
        forward.append(number)
    x = [number * d for number, d in zip(forward, factors.inverse, strict=True)]
    for i in reversed(range(size)):
        for k in range(i + 1, size):
            x[i] = x[i] - factors.lower[k][i] * x[k]
    return tuple(x)


def only(matrix: Triangle, free: Numbers) -> Triangle:
    """The matrix with unknowns that are not free cut out: rows of the identity."""
    return tuple(
        tuple(
            jnp.where(free[i] & free[j], matrix[i][j], 1 if i == j else 0)
            for j in range(i + 1)
        )
        for i in range(len(matrix))
    )


def times(matrix: Triangle, vector: Numbers) -> Numbers:
    """A symmetric matrix times a vector."""
    size = len(vector)
    return tuple(
        dot(tuple(entry(matrix, i, j) for j in range(size)), vector)
        for i in range(size)
    )


def dot(a: Numbers, b: Numbers) -> Array:
    """Sum of products, of at least one pair."""
    total = a[0] * b[0]
    for left, right in zip(a[1:], b[1:], strict=True):
        total = total + left * right
    return total


def curvatures(matrix: Triangle) -> Numbers:
    """For each unknown: its curvature when the others adapt to it.

    The inverse is its variance; 0 where rounding, or the others, hide it.
    """
    return tuple(factorize(matrix, last=k).last for k in range(len(matrix)))


class Boxed(NamedTuple):
    """The minimum of a quadratic in a box: where, how deep, and which are free."""

    point: Numbers
    value: Array
    free: Numbers


def minimize_in_box(
    matrix: Triangle, vector: Numbers, lower: Numbers, upper: Numbers, rounds: int
) -> Boxed:
    r"""The $x$ in $[l, u]$ that minimises $\tfrac12 x^\top H x - b \cdot x$.

    A primal-dual active-set method: each round solves for the free unknowns, holds
    those that left the box at their bound, and frees those that want to come back. For
    three unknowns six rounds have always been enough; the best of all rounds is
    kept, should they go round in circles. Rounds end where nothing changes any more.

    ??? cite "Source"
        Hintermüller, Ito and Kunisch, *The primal-dual active set strategy as a
        semismooth Newton method*, SIAM J. Optim. 13(3), 2002.
    """
    size = len(vector)

    def unfinished(state: _Rounds) -> Array:
        return jnp.any(state.changed) & (state.round < rounds)

    def step(state: _Rounds) -> _Rounds:
        below, above = state.below, state.above
        free = tuple(~(b | a) for b, a in zip(below, above, strict=True))
        held = tuple(
            jnp.where(below[i], lower[i], jnp.where(above[i], upper[i], 0))
            for i in range(size)
        )
        pushed = times(matrix, held)
        pull = tuple(jnp.where(free[i], vector[i] - pushed[i], 0) for i in range(size))
        solved = solve(factorize(only(matrix, free)), pull)
        x = optimization_barrier(
            tuple(jnp.where(free[i], solved[i], held[i]) for i in range(size))
        )
        inside = tuple(jnp.clip(x[i], lower[i], upper[i]) for i in range(size))
        half = times(matrix, inside)
        value = dot(inside, tuple(half[i] / 2 - vector[i] for i in range(size)))
        loose = tuple(free[i] & (inside[i] == x[i]) for i in range(size))
        slope = times(matrix, x)
        slope = tuple(vector[i] - slope[i] for i in range(size))
        under = tuple(
            jnp.where(free[i], x[i] < lower[i], below[i] & (slope[i] < 0))
            for i in range(size)
        )
        over = tuple(
            jnp.where(free[i], x[i] > upper[i], above[i] & (slope[i] > 0))
            for i in range(size)
        )
        changed = jnp.zeros_like(state.changed)
        for before, after in zip((*below, *above), (*under, *over), strict=True):
            changed = changed | (before != after)
        best = _better(Boxed(inside, value, loose), state.best)
        return _Rounds(under, over, best, state.round + 1, changed)

    none = tuple(jnp.zeros(number.shape, bool) for number in vector)
    nowhere = jnp.full_like(vector[0], jnp.inf)
    first = _Rounds(
        none,
        none,
        Boxed(vector, nowhere, none),
        jnp.zeros((), jnp.int32),
        jnp.ones(vector[0].shape, bool),
    )
    return jax.lax.while_loop(unfinished, step, first).best


class _Rounds(NamedTuple):
    """What is held at which bound, the best so far, and whether to go on."""

    below: Numbers
    above: Numbers
    best: Boxed
    round: Array
    changed: Array


def _better(new: Boxed, old: Boxed) -> Boxed:
    better = new.value < old.value
    return Boxed(
        tuple(
            jnp.where(better, n, o) for n, o in zip(new.point, old.point, strict=True)
        ),
        jnp.where(better, new.value, old.value),
        tuple(jnp.where(better, n, o) for n, o in zip(new.free, old.free, strict=True)),
    )


def of_rank(values: T, rank: int) -> T:
    """The same with axes of length 1 before the others."""

    def spread(one: Array) -> Array:
        return one.reshape((1,) * (rank - one.ndim) + one.shape)

    return jax.tree.map(spread, values)


def no_triangle(nothing: Array, size: int) -> Triangle:
    """A symmetric matrix of zeros."""
    return tuple((nothing,) * (i + 1) for i in range(size))


def add_products(sums: Triangle, left: Numbers, right: Numbers) -> Triangle:
    """A symmetric matrix and the products of two vectors."""
    return tuple(
        tuple(s + left[i] * right[j] for j, s in enumerate(row))
        for i, row in enumerate(sums)
    )


def in_groups(
    values: Float[Array, "*batch channels pixels"], groups: int
) -> Float[Array, "*batch groups pixels"]:
    """Summed over the channels that share an exponent: over all, or each alone."""
    if values.shape[-2] == groups:
        return values
    # Row by row: a sum over an axis of three is slow.
    total = values[..., :1, :]
    for k in range(1, values.shape[-2]):
        total = total + values[..., k : k + 1, :]
    return total


def any_sample(
    flags: Bool[Array, "images *batch channels #pixels"],
) -> Bool[Array, "*batch 1 #pixels"]:
    """Whether it holds for any image and channel. Sums of flags are slow."""

    def add(sums: Array, one: Array) -> Array:
        return sums + jnp.where(one, 1, 0).astype(sums.dtype)

    none = jnp.zeros(flags.shape[1:], jnp.float32)
    return in_groups(sum_over_images(add, none, flags), 1) > 0


def sum_over_images(add: Callable[[T, Any], T], none: T, images: Any) -> T:
    """What `add` makes of all images, one after another along the first axis.

    In runs of a few, which compilers work out at once: sums are read and written once a
    run, and rounding grows with the number of runs, not of images.

    **Arguments:** `add`: from sums and an image to sums; `none`: sums over no image.
    """

    def run(start: Array | int, length: int, sums: T) -> T:
        part = none
        for k in range(length):
            part = add(part, _of_image(images, start + k))
        return jax.tree.map(jnp.add, sums, part)

    runs, rest = divmod(len(jax.tree.leaves(images)[0]), RUN)
    sums = none
    if runs:
        sums = jax.lax.fori_loop(0, runs, lambda k, sums: run(k * RUN, RUN, sums), sums)
    return run(runs * RUN, rest, sums) if rest else sums


def _of_image(arrays: T, index: Array | int) -> T:
    """`array[index]` of each: an index may not be negative.

    Whether it is would be asked for every number read: up to a quarter of a map's time.
    """
    return jax.tree.map(
        lambda array: jax.lax.dynamic_index_in_dim(
            array, index, keepdims=False, allow_negative_indices=False
        ),
        arrays,
    )
