r"""The part of the problem that does not change with the exponent, worked out once.

The measured light is freed of what the unknowns other than the highlight explain: what
is left is small where there is no highlight, so that sums over the images keep their
digits in single precision. All that a highlight is ever summed with is multiplied by
its strength beforehand, so that an exponent asks for one product a row.

Pixels are the last axis, so that each sum is a sum of long rows, and images are gone
through one by one: what a compiler would compute anew for every sum is computed once.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from phongfit.maps.pixel.small import (
    Numbers,
    Triangle,
    add_products,
    factorize,
    no_triangle,
    solve,
    sum_over_images,
)


class Columns(NamedTuple):
    r"""Columns C of weights W, and $y = y_\perp + C x_0$, channel by channel.

    With the strengths $\sigma_j$ of an image's highlights and their heights $s_j$ the
    highlight is $S = \sum_j \sigma_j s_j$. Its sums over the images are those of the
    $s_j$ and of their products, with

    - `gram`: $C^\top W C$.
    - `start`: $x_0$, the solution without a highlight and without bounds.
    - `cross`: rows $W \sigma_j C_k$ for each column.
    - `moments`: $W \sigma_j y_\perp$.
    - `squares`: $W \sigma_j \sigma_k$ for each of [`pairs`][]; twice that where
        $j \ne k$, for (k, j) is no pair of its own.
    - `rest`: $y_\perp^\top W y_\perp$, what is left without a highlight.
    """

    gram: Triangle
    start: Numbers
    cross: Float[Array, "images lobes columns #channels pixels"]
    moments: Float[Array, "images lobes channels pixels"]
    squares: Float[Array, "images pairs #channels pixels"]
    rest: Float[Array, "channels pixels"]

    @property
    def rows(self) -> tuple[Array, Array, Array]:
        """What heights are summed with: `cross`, `moments`, and their products'."""
        return self.cross, self.moments, self.squares


def make_columns(
    columns: tuple[Float[Array, "images #channels #pixels"], ...],
    target: Float[Array, "images channels pixels"],
    weight: Float[Array, "images #channels pixels"],
    strength: Float[Array, "images lobes #channels #pixels"],
) -> Columns:
    """Of all channels; where `weight` is 0, the others are only finite.

    What is the same for all channels may have one, in all but the target.
    """
    nothing = jnp.zeros(target.shape[1:], target.dtype)
    size = len(columns)

    def project(sums: tuple[Triangle, Numbers], image: tuple) -> tuple:
        columns, target, weight = image
        rows = tuple(weight * column for column in columns)
        gram = add_products(sums[0], rows, columns)
        moments = tuple(s + row * target for s, row in zip(sums[1], rows, strict=True))
        return gram, moments

    start, gram = (), ()
    if columns:
        no_weight = jnp.zeros(weight.shape[1:], weight.dtype)
        none = no_triangle(no_weight, size), (nothing,) * size
        each = columns, target, weight
        gram, moments = sum_over_images(project, none, each)
        start = solve(factorize(gram), moments)

    def free(rest: Array, image: tuple) -> tuple:
        columns, target, weight, strength = image
        left = target
        for x, column in zip(start, columns, strict=True):
            left = left - x * column
        weighed = weight[None] * strength
        cross = [weighed * column[None] for column in columns]
        moments, squares = weighed * left[None], pairs(weighed, strength, 2)
        none = jnp.zeros((len(weighed), 0, *weighed.shape[1:]), weighed.dtype)
        crossed = jnp.stack(cross, axis=1) if cross else none
        return rest + weight * left**2, (crossed, moments, jnp.stack(squares))

    each = columns, target, weight, strength
    rest, (cross, moments, squares) = jax.lax.scan(free, nothing, each)
    return Columns(gram, start, cross, moments, squares, rest)


def pairs(
    left: Sequence[Array] | Array, right: Sequence[Array] | Array, unequal: float = 1
) -> list[Array]:
    """Products of each row with itself, and `unequal` times with those before it."""
    return [
        left[j] * right[k] * (1 if j == k else unequal)
        for j in range(len(left))
        for k in range(j + 1)
    ]
