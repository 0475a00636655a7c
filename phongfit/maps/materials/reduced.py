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

from phongfit.maps.normals.step import EXPONENT, Free, Move, make_move, reduce_sums
from phongfit.maps.normals.sums import Sums, over_channels
from phongfit.maps.normals.unknowns import Unknowns
from phongfit.maps.pixel.small import Numbers, dot, factorize

STRENGTH = EXPONENT + 1
"""Index of a shared ρ_s among the unknowns that the channels share: after log f."""


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


def take_apart(sums: Sums, which: Unknowns) -> Parts:
    """Separate the sums of all unknowns into a pixel's own and its material's.

    **Arguments:** `which`: all unknowns, including log f and ρ_s.
    """
    n_own = len(which.own) - (not which.one_specular)
    pixel = Sums(
        sums.own[:n_own],
        tuple(row[:n_own] for row in sums.cross[:EXPONENT]),
        sums.shared[:EXPONENT],
        sums.pull_own[:n_own],
        sums.pull_shared[:EXPONENT],
        sums.cost,
    )

    def of_shared(place: int) -> Column:
        return Column(sums.cross[place][:n_own], sums.shared[place][:EXPONENT])

    columns = [of_shared(EXPONENT)]
    if which.one_specular:
        columns.append(of_shared(STRENGTH))
        shared, last = sums.shared, STRENGTH
        curvature = jnp.stack(
            [
                jnp.stack([shared[EXPONENT][EXPONENT], shared[last][EXPONENT]]),
                jnp.stack([shared[last][EXPONENT], shared[last][last]]),
            ]
        )
        pull = jnp.stack(sums.pull_shared[EXPONENT:])
        return Parts(pixel, tuple(columns), curvature, pull)
    strength = sums.own[n_own]
    channels = strength[-1].shape[0]
    # Each channel has a separate ρ_s, which has no products with other channels.
    for channel in range(channels):
        mine = (jnp.arange(channels) == channel)[:, None]
        own = tuple(jnp.where(mine, entry, 0) for entry in strength[:n_own])
        columns.append(
            Column(own, tuple(row[n_own][channel] for row in sums.cross[:EXPONENT]))
        )
    along = sums.cross[EXPONENT][n_own]
    curvature = jnp.zeros((1 + channels, 1 + channels, along.shape[-1]), along.dtype)
    curvature = curvature.at[0, 0].set(sums.shared[EXPONENT][EXPONENT])
    curvature = curvature.at[0, 1:].set(along).at[1:, 0].set(along)
    diagonal = jnp.arange(1, 1 + channels)
    curvature = curvature.at[diagonal, diagonal].set(strength[n_own])
    pull = jnp.concatenate([sums.pull_shared[EXPONENT][None], sums.pull_own[n_own]])
    return Parts(pixel, tuple(columns), curvature, pull)


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
