"""What is asked of a fit of textures, and where it stands."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from phongfit.fitting.texels.lit import Photographs
from phongfit.fitting.texels.sums import AbstractTexels

MIDDLE, RIDGE = 0.5, 1.0
"""Reflectance that texels start from, and the inverse variance that holds each to where
it stands in a step: what hardly anything sees goes nowhere.

To hold them to `MIDDLE` would draw millions of them together: it moved what they share
by more than its errors, and left residuals that are no noise. So it is done again in
each step, from where they have come: iterated regularisation. Of a texel's log f it is
what is known before any image, around the exponent that all share where a fit starts.
"""

IDENTIFIED = 0.5
"""Standard error of a texel's reflectance, or log f, from which on nothing is known."""

EXPONENTS = 1.0, 1000.0
"""Between which a highlight's is sought."""


class Few(NamedTuple):
    """One number that all of a material shares: of one channel, or of all."""

    name: str
    material: int
    channel: int | None


class Field(NamedTuple):
    """A number of each texel: of one channel, or, log f, of all."""

    name: str
    channel: int | None


class State(NamedTuple):
    """Where a fit stands.

    - `texels`: of reflectances, (3, parameters · texels).
    - `numbers`: of the materials. Of exponents with texels of their own these are what
        is expected of them.
    - `exponents`: log f of each texel, if they have their own.
    """

    texels: np.ndarray
    numbers: dict[str, np.ndarray]
    exponents: np.ndarray | None = None

    def value(self, one: Few) -> float:
        """A shared number as it stands; of several channels' one, the first's."""
        own = np.atleast_1d(self.numbers[one.name][one.material])
        return float(own[one.channel or 0])


@dataclasses.dataclass
class Job:
    """What is asked, and of what.

    **Arguments:** `smoothness`: inverse variance of what is expected between
    neighbours.
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
        """Of the photographs."""
        return self.images.given[0].image.dtype

    @property
    def coloured(self) -> tuple[str, ...]:
        """Textures with a number for each channel."""
        return tuple(name for name in self.names if name != "shininess")

    @property
    def systems(self) -> tuple[tuple[Field, ...], ...]:
        """Fields that samples couple: a channel's own, or with exponents all of them.

        Of fields of different colours a system has no entries.
        """
        apart = [tuple(Field(n, c) for n in self.coloured) for c in range(3)]
        if "shininess" in self.names:
            return ((*apart[0], *apart[1], *apart[2], Field("shininess", None)),)
        return tuple(apart) if self.names else ()

    def system_of(self, channel: int) -> int:
        """The system that light of a channel is part of."""
        return min(channel, len(self.systems) - 1)

    def of_system(self, system: int) -> list[int]:
        """The shared numbers that a system's light depends on."""
        if len(self.systems) == 1:
            return list(range(len(self.few)))
        return self.of_channel(system)

    def of_channel(self, channel: int) -> list[int]:
        """The shared numbers that light of a channel depends on."""
        return [k for k, one in enumerate(self.few) if one.channel in (None, channel)]

    def vectors(self, state: State) -> list[np.ndarray]:
        """The texels of each system, field by field."""
        if "shininess" not in self.names:
            return list(state.texels) if self.names else []
        assert state.exponents is not None
        return [np.concatenate([state.texels.ravel(), state.exponents])]

    def at(self, vectors: list[np.ndarray], state: State) -> State:
        """A state with other texels: of [`Job.vectors`][]."""
        if "shininess" not in self.names:
            return state._replace(texels=np.stack(vectors)) if vectors else state
        texels, exponents = np.split(vectors[0], [state.texels.size])
        texels = texels.reshape(state.texels.shape)
        return state._replace(texels=texels, exponents=exponents)

    def bounds(self, state: State) -> tuple[Any, Any]:
        """Between which each system's texels lie: reflectances, and log f."""
        if "shininess" not in self.names:
            return 0.0, 1.0
        low, high = np.log(EXPONENTS)
        counts = state.texels.size, self.grid.texels
        return np.repeat((0.0, low), counts), np.repeat((1.0, high), counts)

    def expected(self, state: State) -> list[np.ndarray]:
        """What ridges hold to: reflectances where they are, log f to what all share.

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
        """The same for the exponents as they stand, for which all is linear."""
        return dataclasses.replace(
            self,
            names=self.coloured,
            few=[one for one in self.few if one.name != "shininess"],
        )
