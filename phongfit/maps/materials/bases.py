"""Shared materials: highlights of several pixels, with separate matte light."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from phongfit.maps.pixel.samples import Known
from phongfit.maps.pixel.settings import MapSettings, Unknowns, unknowns_of
from phongfit.maps.pixel.small import dot, factorize, solve
from phongfit.maps.pixel.step import Free, Move, reduce_sums
from phongfit.maps.pixel.sums import Sums

LOBE = ("specular", "shininess")
"""Parameters that pixels of one material share."""


class Bases(NamedTuple):
    r"""K shared materials.

    - `values`: (K, unknowns), $\log f$ and $\rho_s$, one number or one per channel.
    - `covariance`: (K, unknowns, unknowns), of each material.
    - `shares`: (K,), fractions of the pixels: they sum to 1.
    - `noise`: of a typical sample, in the samples' units.
    """

    values: Float[Array, "materials unknowns"]
    covariance: Float[Array, "materials unknowns unknowns"]
    shares: Float[Array, " materials"]
    noise: Float[Array, ""]


def held(settings: MapSettings) -> MapSettings:
    """Settings of a pixel whose highlight is known."""
    own = tuple(name for name in settings.names if name not in LOBE)
    return dataclasses.replace(settings, names=own, one_specular=False, materials=None)


def sought(settings: MapSettings) -> Unknowns:
    """Unknowns of a pixel whose highlight is known."""
    return unknowns_of(held(settings))


def everything(settings: MapSettings) -> Unknowns:
    """Unknowns of a pixel, followed by its material's, which the channels share."""
    one = settings.one_specular
    return sought(settings)._replace(
        exponent=True, one_specular=one, each_specular=not one
    )


def size_of(settings: MapSettings) -> int:
    """Number of unknowns of a material's highlight."""
    return 2 if settings.one_specular else 4


def as_known(values: Float[Array, " unknowns"], known: Known) -> Known:
    """Known parameters of a pixel of a given material."""
    return known._replace(
        specular=jnp.broadcast_to(values[1:], known.specular.shape),
        shininess=jnp.exp(values[:1]),
    )


TANGENTS = 2
"""Number of unknowns of a normal, which precede those of the material."""


class Reduced(NamedTuple):
    """Each pixel's gradient and curvature of its material's unknowns, log f and ρ_s.

    - `adapting`: change of each pixel's own unknowns per unit of the material's, with
        the opposite sign.
    - `turns`: two steps of a pixel's own unknowns whose squares sum to the covariance
        of the normal, with matte light adapted. Errors of matte light alone are left
        out, since light is linear in it.
    - `log_det`: logarithm of the determinant of the normal's curvature.
    """

    pull: Float[Array, "unknowns pixels"]
    curvature: Float[Array, "unknowns unknowns pixels"]
    adapting: tuple[Move, ...]
    turns: tuple[Move, Move]
    log_det: Float[Array, " pixels"]


def reduce(sums: Sums, free: Free) -> Reduced:
    r"""Eliminate the free ones of a pixel's own unknowns, as in bundle adjustment.

    With u a pixel's own unknowns (normal, matte light) and θ those of its material,
    $H = H_{\theta\theta} - H_{\theta u} H_{uu}^{-1} H_{u\theta}$.

    **Arguments:** `sums`: of all unknowns; `free`: of the pixel's own.

    ??? cite "Source"
        Triggs et al., *Bundle adjustment: a modern synthesis*, Vision Algorithms 1999,
        section 6.1.
    """
    still = jnp.zeros_like(sums.cost)
    material = range(TANGENTS, len(sums.shared))
    every = (jnp.ones(still.shape, bool),) * len(sums.shared)
    reduced = reduce_sums(sums, still, Free(free.own, every))
    normal, rows = factorize(reduced.shared[:TANGENTS]), reduced.shared[TANGENTS:]
    columns = [row[:TANGENTS] for row in rows]
    moves = [solve(normal, column) for column in columns]

    def follow(a: Array, b: Array, own: tuple[Array, ...] | None = None) -> Move:
        """The step of a pixel's own unknowns with a turn of its normal."""
        along, across = reduced.adapted[:TANGENTS]
        own = tuple(map(jnp.zeros_like, along)) if own is None else own
        own = tuple(
            mine - (a[None] * one + b[None] * other)
            for mine, one, other in zip(own, along, across, strict=True)
        )
        return Move(own, (a, b), still)

    curvature = [
        [
            rows[max(i, j)][TANGENTS + min(i, j)] - dot(columns[i], moves[j])
            for j in range(len(rows))
        ]
        for i in range(len(rows))
    ]
    pull = [
        reduced.pull[k] - dot(move, reduced.pull[:TANGENTS])
        for k, move in zip(material, moves, strict=True)
    ]
    first, second = (jnp.sqrt(d) for d in normal.inverse)
    ((), (lower,)) = normal.lower
    inverse = jnp.stack(normal.inverse)
    return Reduced(
        jnp.stack(pull),
        jnp.stack([jnp.stack(row) for row in curvature]),
        tuple(
            follow(move[0], move[1], reduced.adapted[k])
            for k, move in zip(material, moves, strict=True)
        ),
        (follow(first, still), follow(-lower * second, second)),
        -jnp.sum(jnp.log(jnp.where(inverse > 0, inverse, 1)), axis=0),
    )
