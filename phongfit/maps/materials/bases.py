"""Shared materials: highlights of several pixels, with separate matte light."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from phongfit.maps.pixel.pixel import Known
from phongfit.maps.pixel.settings import MapSettings
from phongfit.maps.pixel.unknowns import Unknowns, unknowns_of

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


def alone(settings: MapSettings) -> MapSettings:
    """Settings of a pixel whose highlight is fitted separately."""
    return dataclasses.replace(settings, materials=None)


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
