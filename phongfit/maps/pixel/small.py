r"""Linear algebra of one to four unknowns, written out number by number.

A library call for a 3 × 3 matrix costs more than the rest of a pixel's fit. A vector is
therefore a tuple of numbers, and a symmetric matrix a tuple of the rows of its lower
triangle. In a batch, each entry is an array whose last axis is the pixels.
"""

from typing import Any, NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array

Numbers: TypeAlias = tuple[Array, ...]
Triangle: TypeAlias = tuple[Numbers, ...]


T = TypeVar("T")

KEEP_BARRIERS = {"xla_disable_hlo_passes": "cse_barrier_expander"}
"""XLA option for programs with [`optimization_barrier`][], not documented by XLA.

Otherwise XLA removes barriers on a CPU before it fuses operations.
"""


def optimization_barrier(values: T) -> T:
    """Return the values unchanged, and have XLA compute them once.

    XLA fuses each result with everything that it depends on, so it computes
    intermediate values again for each result; in a chain of solutions that multiplies.
    Measured on two cores with 96² pixels, warm: maps with fitted normals under 49
    lights take 2.5 s with all barriers, 6.3 s without those of this module, 17 to 22 s
    without any.
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


def dot(a: Numbers, b: Numbers) -> Any:
    """Sum of products; 0 for no pair."""
    total: Any = 0
    for left, right in zip(a, b, strict=True):
        total = total + left * right
    return total


def curvatures(matrix: Triangle) -> Numbers:
    """Curvature of each unknown when the others adapt to it.

    Its inverse is the unknown's variance. It is 0 if it is lost in rounding, or if the
    other unknowns can compensate for this one.
    """
    return tuple(factorize(matrix, last=k).last for k in range(len(matrix)))
