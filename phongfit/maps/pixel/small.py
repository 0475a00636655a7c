r"""Linear algebra of one to four unknowns, written out number by number.

A library call for a 3 × 3 matrix costs more than the rest of a pixel's fit. A vector is
therefore a tuple of numbers, and a symmetric matrix a tuple of the rows of its lower
triangle. In a batch, each entry is an array whose last axis is the pixels.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

Numbers: TypeAlias = tuple[Array, ...]
Triangle: TypeAlias = tuple[Numbers, ...]


T = TypeVar("T")

# Number of images that `sum_over_images` adds per step of its loop.
RUN = 4


KEEP_BARRIERS = {"xla_disable_hlo_passes": "cse_barrier_expander"}
"""XLA option for programs with [`optimization_barrier`][], not documented by XLA.

Otherwise XLA removes barriers on a CPU before it fuses operations.
"""


def optimization_barrier(values: T) -> T:
    """Return the values unchanged, and have XLA compute them once.

    XLA fuses each result with everything that it depends on, so it computes
    intermediate values again for each result; in a chain of solutions that multiplies.
    Measured on two cores with 96² pixels, warm: maps with fitted normals under 49
    lights take 2.5 s with the barriers of this module and of `maps/normals`, 6.3 s
    without those of this module, 17 to 22 s without any.
    """
    return jax.lax.optimization_barrier(values)


class Factors(NamedTuple):
    r"""$H = L D L^\top$: rows of L below its diagonal, and the inverses of D.

    If an entry of D is within rounding of 0, its inverse is set to 0: the data do not
    determine that direction, and solutions do not move along it. `last` is the last
    entry of D.
    """

    lower: Triangle
    inverse: Numbers
    last: Array


def entry(matrix: Triangle, i: int, j: int) -> Array:
    """One entry of a symmetric matrix."""
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
    """Solution x of $H x = b$; 0 for unknowns whose curvature is lost in rounding."""
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
    """Matrix whose rows and columns of held unknowns are those of the identity."""
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
    """Curvature of each unknown when the others adapt to it.

    Its inverse is the unknown's variance. It is 0 if it is lost in rounding, or if the
    other unknowns can compensate for this one.
    """
    return tuple(factorize(matrix, last=k).last for k in range(len(matrix)))


class Boxed(NamedTuple):
    """Minimum of a quadratic in a box: its point, its value, and the free unknowns."""

    point: Numbers
    value: Array
    free: Numbers


def minimize_in_box(
    matrix: Triangle, vector: Numbers, lower: Numbers, upper: Numbers, rounds: int
) -> Boxed:
    r"""The $x$ in $[l, u]$ that minimises $\tfrac12 x^\top H x - b \cdot x$.

    A primal-dual active-set method: each round solves for the free unknowns, holds
    those that left the box at their bound, and frees those whose gradient points back
    inside. Six rounds have always been enough for three unknowns. Rounds end when the
    active set no longer changes; the best of all rounds is returned, in case of cycles.

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
    """State of the rounds: unknowns held at each bound, and the best point so far."""

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
    """Arrays with axes of length 1 prepended, up to `rank` axes."""

    def spread(one: Array) -> Array:
        return one.reshape((1,) * (rank - one.ndim) + one.shape)

    return jax.tree.map(spread, values)


def no_triangle(nothing: Array, size: int) -> Triangle:
    """A symmetric matrix of zeros."""
    return tuple((nothing,) * (i + 1) for i in range(size))


def add_products(sums: Triangle, left: Numbers, right: Numbers) -> Triangle:
    """Symmetric matrix plus the products of the entries of two vectors."""
    return tuple(
        tuple(s + left[i] * right[j] for j, s in enumerate(row))
        for i, row in enumerate(sums)
    )


def in_groups(
    values: Float[Array, "*batch channels pixels"], groups: int
) -> Float[Array, "*batch groups pixels"]:
    """Sum over the channels of each group: one group of all, or a group for each."""
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
    """True for pixels whose flag is set in any image and channel.

    Flags are summed as floats, since sums of booleans are slow.
    """

    def add(sums: Array, one: Array) -> Array:
        return sums + jnp.where(one, 1, 0).astype(sums.dtype)

    none = jnp.zeros(flags.shape[1:], jnp.float32)
    return in_groups(sum_over_images(add, none, flags), 1) > 0


def sum_over_images(add: Callable[[T, Any], T], none: T, images: Any) -> T:
    """Accumulate `add` over all images, which are the first axis.

    Images are added in runs of a few: sums are read and written once per run, and
    rounding grows with the number of runs instead of the number of images.

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
    """`array[index]` of each array, for an index ≥ 0.

    JAX would otherwise check the sign at every read, which costs up to a quarter of the
    time of a map.
    """
    return jax.tree.map(
        lambda array: jax.lax.dynamic_index_in_dim(
            array, index, keepdims=False, allow_negative_indices=False
        ),
        arrays,
    )
