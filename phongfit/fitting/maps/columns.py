r"""The part of the problem that does not change with the exponent, worked out once.

Columns of the unknowns other than the highlight are made orthonormal, and the measured
light is freed of them: what is left is small where there is no highlight, so that sums
over the lights keep their digits in single precision.
"""

from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from phongfit.fitting.maps.small import Numbers, Triangle, settled

Lights: TypeAlias = tuple[Float[Array, "*channels images"], ...]
"""An array for each light of an image, most often one."""


class Columns(NamedTuple):
    r"""One channel: weighted columns $C = Q R$, $y = y_\perp + C x_0$.

    - `basis`: Q, orthonormal; zeros for a column that is none, or lies in the span of
        those before it.
    - `triangle`: $R^\top$.
    - `gram`: $C^\top C$.
    - `start`: $x_0$, the solution without a highlight and without bounds.
    - `rest`: $y_\perp$.
    - `strength`: of the highlights, weighted.
    """

    basis: tuple[Float[Array, " images"], ...]
    triangle: Triangle
    gram: Triangle
    start: Numbers
    rest: Float[Array, " images"]
    strength: Lights


def make_columns(
    columns: tuple[Float[Array, " images"], ...],
    target: Float[Array, " images"],
    strength: Lights,
) -> Columns:
    """Columns of one channel by Gram and Schmidt; everything comes weighted."""
    columns, target, strength = settled((columns, target, strength))
    smallest = 100 * jnp.finfo(target.dtype).eps
    basis: list[Array] = []
    triangle: list[Numbers] = []
    for column in columns:
        shares = [jnp.sum(direction * column) for direction in basis]
        rest = column
        for share, direction in zip(shares, basis, strict=True):
            rest = rest - share * direction
        length = jnp.sum(rest**2)
        whole = length
        for share in shares:
            whole = whole + share**2
        told = length > smallest * whole
        inverse = jnp.where(told, jax.lax.rsqrt(jnp.where(told, length, 1)), 0)
        basis.append(settled(rest * inverse))
        triangle.append((*shares, length * inverse))
    shares = [jnp.sum(direction * target) for direction in basis]
    rest = target
    for share, direction in zip(shares, basis, strict=True):
        rest = rest - share * direction
    gram = tuple(
        tuple(
            sum((triangle[i][k] * triangle[j][k] for k in range(1, j + 1)),
                start=triangle[i][0] * triangle[j][0])
            for j in range(i + 1)
        )
        for i in range(len(triangle))
    )  # fmt: skip
    start = _backwards(tuple(triangle), shares)
    return settled(Columns(tuple(basis), tuple(triangle), gram, start, rest, strength))


def _backwards(triangle: Triangle, shares: list[Array]) -> Numbers:
    """The x of $R x = b$; 0 for columns that are none."""
    x = list(shares)
    for i in reversed(range(len(x))):
        for k in range(i + 1, len(x)):
            x[i] = x[i] - triangle[k][i] * x[k]
        pivot = triangle[i][i]
        x[i] = jnp.where(pivot > 0, x[i] / jnp.where(pivot > 0, pivot, 1), 0)
    return tuple(x)
