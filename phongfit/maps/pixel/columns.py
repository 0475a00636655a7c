r"""The part of the problem that does not depend on the exponent, computed once.

The light that the fixed columns explain is subtracted from the measured light. The
residual is small where there is no highlight, so that sums over the images keep their
precision in float32. Everything that is summed with a highlight is multiplied by its
strength beforehand, so that each exponent needs one product per row.

Pixels are the last axis, so that each sum adds long rows. Images are processed one by
one: a compiler would otherwise repeat intermediate computations for every sum.
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
    highlight is $S = \sum_j \sigma_j s_j$. Its sums over the images follow from the
    $s_j$, their products, and these arrays:

    - `gram`: $C^\top W C$.
    - `start`: $x_0$, the solution without a highlight and without bounds.
    - `cross`: rows $W \sigma_j C_k$ for each column.
    - `moments`: $W \sigma_j y_\perp$.
    - `squares`: $W \sigma_j \sigma_k$ for each of [`pairs`][]; twice that where
        $j \ne k$, since (j, k) and (k, j) are one pair.
    - `rest`: $y_\perp^\top W y_\perp$, the sum of squares without a highlight.
    """

    gram: Triangle
    start: Numbers
    cross: Float[Array, "images lobes columns #channels pixels"]
    moments: Float[Array, "images lobes channels pixels"]
    squares: Float[Array, "images pairs #channels pixels"]
    rest: Float[Array, "channels pixels"]

    @property
    def rows(self) -> tuple[Array, Array, Array]:
        """Factors of heights in `cross` and `moments`, and of their products."""
        return self.cross, self.moments, self.squares


def make_columns(
    columns: tuple[Float[Array, "images #channels #pixels"], ...],
    target: Float[Array, "images channels pixels"],
    weight: Float[Array, "images #channels pixels"],
    strength: Float[Array, "images lobes #channels #pixels"],
) -> Columns:
    """Columns of all channels; the other arrays must be finite if `weight` is 0.

    The channel axis may have length 1 in all arrays but the target.
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
    """Products of each row with itself, and with earlier rows times `unequal`."""
    return [
        left[j] * right[k] * (1 if j == k else unequal)
        for j in range(len(left))
        for k in range(j + 1)
    ]
