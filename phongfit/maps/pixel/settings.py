"""Options, unknowns and flags of pixels; options are fixed when a fit is compiled."""

import dataclasses
import math
from enum import IntFlag
from typing import Literal, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from phongfit.fitting.problem.losses import AbstractLoss, Linear
from phongfit.maps.pixel.lobes import Lobe, any_lobe, power_lobe
from phongfit.reflectance import AbstractSpecular, BlinnPhong

COLUMNS = ("ambient", "diffuse")
"""Reflectances whose basis does not depend on the exponent."""

MAP_PARAMETERS = (*COLUMNS, "specular", "shininess")

MOST_MATERIALS = 6
"""Maximum number of shared materials."""


@dataclasses.dataclass(frozen=True)
class MapSettings:
    """Settings of the fit of a pixel.

    - `names`: the unknowns, a subset of `MAP_PARAMETERS`.
    - `bounds`: (low, high) of each of `MAP_PARAMETERS`.
    - `shared`: whether the channels share one exponent.
    - `model`: specular model, its parameters as Python numbers; `power`: whether its
        lobe is a power of one cosine.
    - `loss`: of the residuals.
    - `scanned`: whether the exponent is searched over its whole range, or only
        downhill from its start.
    - `min_cosine`: a sample that no light reaches at a cosine above this is left out.
    - `noise_given`: whether the noise is known, or estimated from each pixel's
        residuals.
    - `weighted`: whether each sample is weighted with the inverse of its noise.
    - `normals`: whether normals are given, or fitted with the material.
    - `one_specular`: whether the channels share ρ_s; only if normals are fitted.
    - `materials`: number of shared materials, `"auto"` to choose it from the data;
        `None`: pixels share no material.
    - `cutoff`: values from this one on are saturated; `exactly`: only this value is.
    """

    names: tuple[str, ...] = MAP_PARAMETERS
    bounds: tuple[tuple[float, float], ...] = ((0, 1), (0, 1), (0, 1), (1, 1000))
    shared: bool = True
    model: AbstractSpecular = BlinnPhong()
    power: bool = True
    loss: AbstractLoss = Linear()
    scanned: bool = True
    min_cosine: float = 0.0
    noise_given: bool = False
    weighted: bool = False
    normals: Literal["given", "fit"] = "given"
    one_specular: bool = False
    materials: int | Literal["auto"] | None = None
    cutoff: float = 1.0
    exactly: bool = True

    @property
    def columns(self) -> tuple[str, ...]:
        """Unknown reflectances whose basis does not depend on the exponent."""
        return tuple(name for name in COLUMNS if name in self.names)

    @property
    def shiny(self) -> bool:
        """True if the strength of the highlight is unknown."""
        return "specular" in self.names

    @property
    def searched(self) -> bool:
        """True if the exponent is unknown."""
        return "shininess" in self.names

    def bound(self, name: str) -> tuple[float, float]:
        """(low, high) of a parameter."""
        return self.bounds[MAP_PARAMETERS.index(name)]

    def lobe(self, t: Float[Array, " pixels"]) -> Lobe:
        """The model's lobe at exponents e^t."""
        return (power_lobe if self.power else any_lobe)(self.model, t)

    @property
    def log_bounds(self) -> tuple[float, float]:
        """(low, high) of the logarithm of the exponent."""
        low, high = self.bound("shininess")
        return math.log(low), math.log(high)

    def unknowns(self, channels: int = 3) -> int:
        """Number of unknowns in a pixel with a given number of channels."""
        exponents = 1 if self.shared else channels
        own = len(self.columns) + (self.shiny and not self.one_specular)
        shared = (self.shiny and self.one_specular) + 2 * (self.normals == "fit")
        return channels * own + shared + self.searched * exponents


class Flag(IntFlag):
    """Reasons why parameters of a pixel are not identified or need care.

    - `OUTSIDE`: it sees no surface, or is masked; it was not fitted.
    - `BLACK`: all its samples are zero: nothing is identified.
    - `NOT_FINITE`: it has NaN or infinite samples, which are left out.
    - `TOO_FEW`: it has no more samples in use than unknowns: nothing is identified.
    - `NO_HIGHLIGHT`: ρ_s is 0 within its error: the exponent is not identified.
    - `DEGENERATE`: some unknowns change its samples in the same way, or not at all.
    - `AT_BOUND`: an estimate lies at its bound: an exponent is then not identified, and
        a reflectance has the error that it would have without the bound.
    - `NOT_CONVERGED`: the last step of an estimate was more than a tenth of its error:
        nothing is identified.
    - `MISFIT`: χ² is too large for the noise that was given (by 4.5 standard deviations
        of a normal distribution): the model does not describe the pixel, or the noise
        is larger. Its errors are widened by the root of χ² per degree of freedom. With
        a robust loss the median of the residuals replaces χ².
    - `IN_A_PLANE`: all lamps that light it lie in one plane with it, or they are fewer
        than three: a fitted normal is not identified, since its mirror image in that
        plane, or a steeper normal of a brighter material, gives equal samples.
    - `AMBIGUOUS`: another normal, more than 5° away, explains it as well.
    - `SEVERAL_MATERIALS`: more than one of the shared materials explains it: none has a
        probability of 95 %, and its highlight is not identified.
    """

    OUTSIDE = 1
    BLACK = 2
    NOT_FINITE = 4
    TOO_FEW = 8
    NO_HIGHLIGHT = 16
    DEGENERATE = 32
    AT_BOUND = 64
    NOT_CONVERGED = 128
    MISFIT = 256
    IN_A_PLANE = 512
    AMBIGUOUS = 1024
    SEVERAL_MATERIALS = 2048


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
