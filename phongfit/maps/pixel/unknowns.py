"""The unknowns of a pixel and their values."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from phongfit.maps.pixel.settings import MapSettings


class Point(NamedTuple):
    """Normals and materials of pixels.

    - `normal`: (3, pixels) unit vectors.
    - `log_exponent`: (pixels,), log f.
    - `ambient`, `diffuse`, `specular`: (channels, pixels); (1, pixels) for a ρ_s that
        the channels share.
    """

    normal: Float[Array, "3 pixels"]
    log_exponent: Float[Array, " pixels"]
    ambient: Float[Array, "channels pixels"]
    diffuse: Float[Array, "channels pixels"]
    specular: Float[Array, "some_channels pixels"]


class Unknowns(NamedTuple):
    """The unknowns of a [`Point`][].

    - `normal`: whether the normal is unknown.
    - `own`: reflectances that are unknown in each channel separately.
    - `exponent`: whether f is unknown.
    - `one_specular`: whether one ρ_s of all channels is unknown.
    - `each_specular`: whether the ρ_s of each of three channels is among the shared
        unknowns, instead of the channel's own.
    """

    own: tuple[str, ...]
    exponent: bool
    one_specular: bool
    normal: bool = True
    each_specular: bool = False

    @property
    def n_shared(self) -> int:
        """Number of unknowns that the channels share: two of the normal, f, ρ_s."""
        strengths = self.one_specular + 3 * self.each_specular
        return self.place + self.exponent + strengths

    @property
    def place(self) -> int:
        """Index of log f among the unknowns that the channels share."""
        return 2 * self.normal


def unknowns_of(settings: MapSettings) -> Unknowns:
    """The unknowns of settings."""
    shared = settings.one_specular and settings.shiny
    own = tuple(
        name
        for name in ("ambient", "diffuse", "specular")
        if name in settings.names and not (name == "specular" and shared)
    )
    return Unknowns(own, settings.searched, shared, settings.normals == "fit")


def tangents(
    normal: Float[Array, "3 pixels"],
) -> tuple[Float[Array, "3 pixels"], Float[Array, "3 pixels"]]:
    """Two unit vectors perpendicular to the normal and to each other.

    ??? cite "Source"
        Duff et al., *Building an orthonormal basis, revisited*, J. Comput. Graph.
        Tech. 6(1), 2017.
    """
    x, y, z = normal
    sign = jnp.where(z >= 0, 1.0, -1.0).astype(z.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    first = jnp.stack([1 + sign * x * x * a, sign * b, -sign * x])
    second = jnp.stack([b, sign + y * y * a, -y])
    return first, second


def unit(vector: Float[Array, "3 pixels"]) -> Float[Array, "3 pixels"]:
    """Vectors scaled to length 1; a zero vector stays zero."""
    squared = jnp.sum(vector**2, axis=0)
    return vector / jnp.sqrt(jnp.where(squared > 0, squared, 1))[None]


FACING = 0.02
"""Least cosine between a normal and the viewer, since visible surfaces face it."""


def turned_to(
    vector: Float[Array, "3 pixels"], to_viewer: Float[Array, "3 #pixels"]
) -> Float[Array, "3 pixels"]:
    """Unit vectors, moved to the viewer's side if they face away."""
    normal = unit(vector)
    cosine = jnp.sum(normal * to_viewer, axis=0)
    return unit(normal + jnp.maximum(FACING - cosine, 0)[None] * to_viewer)
