"""What a fit of every pixel looks for, and how: fixed when it is compiled."""

import dataclasses
import math
from typing import Literal

from phongfit.fitting.problem.losses import AbstractLoss, Linear
from phongfit.maps.pixel.lobes import AbstractLobes, AnyLobes, PowerLobes
from phongfit.reflectance import AbstractSpecular, BlinnPhong

COLUMNS = ("ambient", "diffuse")
"""Reflectances whose basis no exponent changes."""

MAP_PARAMETERS = (*COLUMNS, "specular", "shininess")

MOST_MATERIALS = 6
"""So many materials pixels share at most."""


@dataclasses.dataclass(frozen=True)
class MapSettings:
    """How one pixel is fitted.

    - `names`: the unknowns, a subset of `MAP_PARAMETERS`.
    - `bounds`: (low, high) of each of `MAP_PARAMETERS`.
    - `shared`: whether the channels share one exponent.
    - `model`: of the highlight, its own numbers as Python's; `power`: whether its lobe
        is a power of one cosine.
    - `loss`: how much a residual counts.
    - `scanned`: whether the exponent is looked for everywhere, or only downhill from
        where it starts.
    - `min_cosine`: a sample that no light reaches at a cosine above this is left out.
    - `noise_given`: whether the noise is known, or estimated from each pixel's
        residuals.
    - `weighted`: whether each sample's weight is the inverse of its own noise.
    - `normals`: whether normals are given, or sought with the material.
    - `one_specular`: whether the channels share ρ_s; only where normals are sought.
    - `materials`: how many pixels share, `"auto"` to find out, `None` for each its own.
    - `cutoff`: values from this one on are saturated; `exactly`: only this one is.
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
        """The unknowns that the exponent does not touch."""
        return tuple(name for name in COLUMNS if name in self.names)

    @property
    def shiny(self) -> bool:
        """Whether the strength of the highlight is unknown."""
        return "specular" in self.names

    @property
    def searched(self) -> bool:
        """Whether the exponent is unknown."""
        return "shininess" in self.names

    def bound(self, name: str) -> tuple[float, float]:
        """(low, high) of a parameter."""
        return self.bounds[MAP_PARAMETERS.index(name)]

    @property
    def lobes(self) -> AbstractLobes:
        """The model's lobes."""
        return PowerLobes(self.model) if self.power else AnyLobes(self.model)

    @property
    def log_bounds(self) -> tuple[float, float]:
        """(low, high) of the logarithm of the exponent."""
        low, high = self.bound("shininess")
        return math.log(low), math.log(high)

    def unknowns(self, channels: int = 3) -> int:
        """How many numbers are unknown in a pixel of so many channels."""
        exponents = 1 if self.shared else channels
        own = len(self.columns) + (self.shiny and not self.one_specular)
        shared = (self.shiny and self.one_specular) + 2 * (self.normals == "fit")
        return channels * own + shared + self.searched * exponents
