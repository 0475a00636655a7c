"""Unknowns and options of a fit of every pixel, fixed when it is compiled."""

import dataclasses
import math
from typing import Literal

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
