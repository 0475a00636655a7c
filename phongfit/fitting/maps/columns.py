r"""The part of the problem that does not change with the exponent, worked out once.

The measured light is freed of what the unknowns other than the highlight explain: what
is left is small where there is no highlight, so that sums over the lights keep their
digits in single precision.
"""

from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Float

from phongfit.fitting.maps.small import (
    Numbers,
    Triangle,
    factorize,
    settled,
    solve,
)

Lights: TypeAlias = tuple[Float[Array, "*channels images"], ...]
"""An array for each light of an image, most often one."""


class Columns(NamedTuple):
    r"""One channel: weighted columns C, and $y = y_\perp + C x_0$.

    - `fixed`: C.
    - `gram`: $C^\top C$.
    - `start`: $x_0$, the solution without a highlight and without bounds.
    - `rest`: $y_\perp$.
    - `strength`: of the highlights, weighted.
    """

    fixed: Lights
    gram: Triangle
    start: Numbers
    rest: Float[Array, " images"]
    strength: Lights


def make_columns(columns: Lights, target: Array, strength: Lights) -> Columns:
    """Columns of one channel; everything comes weighted."""
    columns, target, strength = settled((columns, target, strength))
    if not columns:
        return Columns((), (), (), target, strength)
    gram = tuple(
        tuple(jnp.sum(columns[i] * columns[j]) for j in range(i + 1))
        for i in range(len(columns))
    )
    moments = tuple(jnp.sum(column * target) for column in columns)
    gram, moments = settled((gram, moments))
    start = solve(factorize(gram), moments)
    rest = target
    for column, x in zip(columns, start, strict=True):
        rest = rest - x * column
    return settled(Columns(columns, gram, start, rest, strength))
