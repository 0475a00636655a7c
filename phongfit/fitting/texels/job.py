"""What is asked of a fit of textures, and where it stands."""

import dataclasses
from typing import NamedTuple

import numpy as np
from scipy import sparse

from phongfit.fitting.texels.lit import Photographs
from phongfit.fitting.texels.sums import Grid

PRIOR = 0.5, 1.0
"""Mean and standard deviation of what is known of a reflectance before any image."""

EXPONENTS = 1.0, 1000.0
"""Between which a highlight's is sought."""


class Few(NamedTuple):
    """One number that all of a material shares: of one channel, or of all."""

    name: str
    material: int
    channel: int | None


class State(NamedTuple):
    """Textures, (3, parameters · texels), and the materials' numbers."""

    texels: np.ndarray
    numbers: dict[str, np.ndarray]

    def value(self, one: Few) -> float:
        """A shared number as it stands; of several channels' one, the first's."""
        own = np.atleast_1d(self.numbers[one.name][one.material])
        return float(own[one.channel or 0])


@dataclasses.dataclass
class Job:
    """What is asked, and of what."""

    images: Photographs
    names: tuple[str, ...]
    few: list[Few]
    clamp: bool
    smoothness: sparse.csr_array | None
    floor: float
    lossy: bool

    @property
    def grid(self) -> Grid:
        return self.images.grid

    @property
    def dtype(self) -> np.dtype:
        """Of the photographs."""
        return self.images.given[0].image.dtype

    @property
    def size(self) -> int:
        return len(self.names) * self.grid.texels

    def of_channel(self, channel: int) -> list[int]:
        """The shared numbers that light of a channel depends on."""
        return [k for k, one in enumerate(self.few) if one.channel in (None, channel)]
