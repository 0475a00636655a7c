r"""Normal equations of a material after elimination of each pixel's own unknowns.

With u a pixel's own unknowns (normal, matte light) and θ those of its material,
$H = H_{\theta\theta} - H_{\theta u} H_{uu}^{-1} H_{u\theta}$, as in bundle adjustment.

??? cite "Source"
    Triggs et al., *Bundle adjustment: a modern synthesis*, Vision Algorithms 1999,
    section 6.1.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from phongfit.maps.pixel.small import Numbers, dot, entry, factorize
from phongfit.maps.pixel.step import Free, Move, make_move, reduce_sums
from phongfit.maps.pixel.sums import Sums, over_channels

TANGENTS = 2
"""Number of unknowns of a normal."""


class Column(NamedTuple):
    """Products of one unknown of a material with a pixel's own unknowns."""

    own: Numbers
    shared: Numbers


class Parts(NamedTuple):
    """Sums of all unknowns, separated into those of pixels and of their material.

    - `pixel`: sums of a pixel's own unknowns.
    - `columns`: products of each of the material's unknowns with a pixel's own.
    - `curvature`: matrix of the material's unknowns, (unknowns, unknowns, pixels);
        `pull`: their gradient.
    """

    pixel: Sums
    columns: tuple[Column, ...]
    curvature: Float[Array, "unknowns unknowns pixels"]
    pull: Float[Array, "unknowns pixels"]


class Reduced(NamedTuple):
    """Each pixel's gradient and curvature of its material's unknowns.

    - `pull`, `curvature`: of log f and ρ_s, as in [`Parts`][].
    - `adapting`: change of each pixel's own unknowns per unit of the material's, with
        the opposite sign.
    - `log_det`: logarithm of the determinant of the normal's curvature.
    """

    pull: Float[Array, "unknowns pixels"]
    curvature: Float[Array, "unknowns unknowns pixels"]
    adapting: tuple[Move, ...]
    log_det: Float[Array, " pixels"]


def take_apart(sums: Sums) -> Parts:
    """Separate the sums of all unknowns into a pixel's own and its material's.

    The normal's tangents, which are the pixel's, precede the material's unknowns.
    """
    mine, material = slice(TANGENTS), range(TANGENTS, len(sums.shared))
    pixel = sums._replace(
        cross=sums.cross[mine],
        shared=sums.shared[mine],
        pull_shared=sums.pull_shared[mine],
    )
    columns = tuple(Column(sums.cross[k], sums.shared[k][mine]) for k in material)
    curvature = [[entry(sums.shared, i, j) for j in material] for i in material]
    return Parts(
        pixel,
        columns,
        jnp.stack([jnp.stack(row) for row in curvature]),
        jnp.stack(sums.pull_shared[TANGENTS:]),
    )


def reduce(parts: Parts, free: Free) -> Reduced:
    """Eliminate the free ones of a pixel's own unknowns."""
    still = jnp.zeros_like(parts.pixel.cost)

    def adapted(column: Column) -> Move:
        sums = parts.pixel._replace(pull_own=column.own, pull_shared=column.shared)
        return make_move(sums, still, free)

    def product(column: Column | Sums, move: Move) -> Array:
        own, shared = (
            (column.own, column.shared)
            if isinstance(column, Column)
            else (column.pull_own, column.pull_shared)
        )
        return over_channels(dot(own, move.own)) + dot(shared, move.shared)

    moves = tuple(adapted(column) for column in parts.columns)
    pull = jnp.stack([product(parts.pixel, move) for move in moves])
    taken = [[product(column, move) for move in moves] for column in parts.columns]
    normal = reduce_sums(parts.pixel, still, free).shared
    inverse = jnp.stack(factorize(normal).inverse)
    return Reduced(
        parts.pull - pull,
        parts.curvature - jnp.stack([jnp.stack(row) for row in taken]),
        moves,
        -jnp.sum(jnp.log(jnp.where(inverse > 0, inverse, 1)), axis=0),
    )


def turns(sums: Sums, free: Free) -> tuple[Move, Move]:
    """Two steps of a pixel's own unknowns whose squares sum to its covariance.

    They cover the covariance of the normal, with matte light adapted. Errors of matte
    light alone are left out, since light is linear in it.

    **Arguments:** `sums`: of a pixel's own unknowns.
    """
    still = jnp.zeros_like(sums.cost)
    reduced = reduce_sums(sums, still, free)
    factors = factorize(reduced.shared)
    first, second = (jnp.sqrt(d) for d in factors.inverse)
    ((), (lower,)) = factors.lower

    def follow(a: Array, b: Array) -> Move:
        own = tuple(
            -(a[None] * along + b[None] * across)
            for along, across in zip(*reduced.adapted, strict=True)
        )
        return Move(own, (a, b), still)

    return follow(first, still), follow(-lower * second, second)
