"""A fit of textures: photographs, unknowns and the state of the solver."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from phongfit.fitting.texels.lit import Photographs
from phongfit.fitting.texels.sums import AbstractTexels

MIDDLE, RIDGE = 0.5, 1.0
"""Reflectance at which texels start, and the inverse variance of a prior (a ridge) that
holds each texel to its current value in a step, so that texels which hardly any sample
sees stay where they are.

A ridge around `MIDDLE` would pull millions of texels at once: it moved shared numbers
by more than their errors, and left residuals that are not noise. Each step therefore
centres the ridge anew on the current values (iterated regularisation). For a texel's
log f the ridge is a prior with a fixed centre, the shared exponent of the start.
"""

IDENTIFIED = 0.5
"""A texel is not identified if the error of its reflectance or log f is larger."""

EXPONENTS = 1.0, 1000.0
"""Bounds of a highlight's exponent."""


class Few(NamedTuple):
    """A number that a whole material shares, for one channel or (None) for all."""

    name: str
    material: int
    channel: int | None


class Field(NamedTuple):
    """An unknown of each texel: of one channel, or (None) log f for all three."""

    name: str
    channel: int | None


class State(NamedTuple):
    """Current values of all unknowns of a fit.

    - `texels`: reflectances, (3, parameters · texels).
    - `numbers`: the materials' parameters. If texels have exponents of their own, the
        entry "shininess" is the centre of their prior.
    - `exponents`: log f of each texel, if texels have their own exponents.
    """

    texels: np.ndarray
    numbers: dict[str, np.ndarray]
    exponents: np.ndarray | None = None

    def value(self, one: Few) -> float:
        """Current value of a shared number; the first channel's if three share it."""
        own = np.atleast_1d(self.numbers[one.name][one.material])
        return float(own[one.channel or 0])


@dataclasses.dataclass
class Job:
    """Photographs, unknowns and options of a fit.

    **Arguments:**

    - `images`: the photographs.
    - `names`: the textured parameters.
    - `few`: the shared unknowns.
    - `clamp`: whether the film clips light to between 0 and 1.
    - `smoothness`: inverse variance of differences between neighbours in the prior.
    - `floor`: the least noise level.
    - `lossy`: whether photographs are JPEG files.
    """

    images: Photographs
    names: tuple[str, ...]
    few: list[Few]
    clamp: bool
    smoothness: float | None
    floor: float
    lossy: bool

    @property
    def grid(self) -> AbstractTexels:
        return self.images.grid

    @property
    def dtype(self) -> np.dtype:
        """Data type of the photographs."""
        return self.images.given[0].image.dtype

    @property
    def coloured(self) -> tuple[str, ...]:
        """Textures with a number for each channel."""
        return tuple(name for name in self.names if name != "shininess")

    @property
    def systems(self) -> tuple[tuple[Field, ...], ...]:
        """Groups of fields that samples couple: one a channel, or one with exponents.

        A system's matrix has no entries between fields of different channels.
        """
        apart = [tuple(Field(n, c) for n in self.coloured) for c in range(3)]
        if "shininess" in self.names:
            return ((*apart[0], *apart[1], *apart[2], Field("shininess", None)),)
        return tuple(apart) if self.names else ()

    def system_of(self, channel: int) -> int:
        """Index of the system to which a channel's light belongs."""
        return min(channel, len(self.systems) - 1)

    def of_system(self, system: int) -> list[int]:
        """Indices of shared numbers on which a system's light depends."""
        if len(self.systems) == 1:
            return list(range(len(self.few)))
        return self.of_channel(system)

    def of_channel(self, channel: int) -> list[int]:
        """Indices of shared numbers on which a channel's light depends."""
        return [k for k, one in enumerate(self.few) if one.channel in (None, channel)]

    def vectors(self, state: State) -> list[np.ndarray]:
        """Each system's unknowns of texels as one vector, field by field."""
        if "shininess" not in self.names:
            return list(state.texels) if self.names else []
        assert state.exponents is not None
        return [np.concatenate([state.texels.ravel(), state.exponents])]

    def at(self, vectors: list[np.ndarray], state: State) -> State:
        """The state with texels from `vectors`, ordered as in [`Job.vectors`][]."""
        if "shininess" not in self.names:
            return state._replace(texels=np.stack(vectors)) if vectors else state
        texels, exponents = np.split(vectors[0], [state.texels.size])
        texels = texels.reshape(state.texels.shape)
        return state._replace(texels=texels, exponents=exponents)

    def bounds(self, state: State) -> tuple[Any, Any]:
        """Lower and upper bounds of a system's texels (reflectances and log f)."""
        if "shininess" not in self.names:
            return 0.0, 1.0
        low, high = np.log(EXPONENTS)
        counts = state.texels.size, self.grid.texels
        return np.repeat((0.0, low), counts), np.repeat((1.0, high), counts)

    def expected(self, state: State) -> list[np.ndarray]:
        """Centres of the ridges: current reflectances, and the shared log f.

        ??? cite "Source"
            King and Chillingworth, *Approximation of generalized inverses by iterated
            regularization*, Numer. Funct. Anal. Optim. 1(5), 1979.
        """
        if "shininess" not in self.names:
            return self.vectors(state)
        own = np.log(state.numbers["shininess"])[: self.grid.layers]
        logs = np.repeat(own, self.grid.texels // self.grid.layers)
        return [np.concatenate([state.texels.ravel(), logs])]

    def without_exponents(self) -> "Job":
        """This job with exponents fixed at current values, so that light is linear."""
        return dataclasses.replace(
            self,
            names=self.coloured,
            few=[one for one in self.few if one.name != "shininess"],
        )
