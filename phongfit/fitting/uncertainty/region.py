"""Confidence intervals of all reported entries, at any level."""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from phongfit.fitting.uncertainty.intervals import Quadratic
from phongfit.fitting.uncertainty.quantiles import two_for_one

# Relative distance within which an end counts as at its bound, for single precision.
ROUNDED = 1e-6


class Part(NamedTuple):
    """Unknowns that share no sample with others, and quadratics that cover their box.

    - `places`: their indices in the solver's vector.
    - `quadratics`: quadratics of Δχ² about several points.
    - `searched`: whether an exponent of a faint highlight was fitted to noise, which
        counts as one more number.
    """

    places: Int[np.ndarray, " k"]
    quadratics: tuple[Quadratic, ...]
    searched: bool = False

    def ends(self, along: Float[np.ndarray, "m k"], level: float) -> np.ndarray:
        """Hull of the quadratics' intervals, (m, 2), in steps from the solution."""
        level = two_for_one(level) if self.searched else level
        least = min(quadratic.least for quadratic in self.quadratics)
        ends = [quadratic.ends(along, level + least) for quadratic in self.quadratics]
        low, high = np.moveaxis(np.array(ends), -1, 0)
        return np.stack([np.nanmin(low, axis=0), np.nanmax(high, axis=0)], axis=-1)


@dataclasses.dataclass(frozen=True)
class _AtHand:
    """A function that returns known parts."""

    parts: tuple[Part, ...]

    def __call__(self) -> tuple[Part, ...]:
        return self.parts


@dataclasses.dataclass(frozen=True, eq=False)
class Region:
    """The region that the data allow, at any level of Δχ².

    **Arguments:**

    - `values`: reported entries in the user's units.
    - `slope`: their derivatives in the solver's vector, (reported, n).
    - `logarithmic`: true for entries that are logarithms in the solver.
    - `bounds`: (reported, 2).
    - `open_ended`: true for entries that are not identified; their interval is the
        bounds.
    - `make`: returns the parts; called at their first use.
    """

    values: Float[np.ndarray, " reported"]
    slope: Float[np.ndarray, "reported n"]
    logarithmic: Bool[np.ndarray, " reported"]
    bounds: Float[np.ndarray, "reported 2"]
    open_ended: Bool[np.ndarray, " reported"]
    make: Callable[[], tuple[Part, ...]]

    @functools.cached_property
    def parts(self) -> tuple[Part, ...]:
        """The parts of the unknowns, made at the first use."""
        return self.make()

    def evaluated(self) -> "Region":
        """A copy with computed parts, which can be stored."""
        return dataclasses.replace(self, make=_AtHand(self.parts))

    def ends(self, level: float) -> Float[np.ndarray, "reported 2"]:
        r"""Ends of each interval, where the profile $\Delta\chi^2$ reaches `level`.

        **Returns:** lower and upper ends in the user's units, cut to the bounds.
        """
        moved = np.zeros((len(self.values), 2))
        for part in self.parts:
            along = self.slope[:, part.places]
            here = np.any(along != 0, axis=1)
            if here.any():
                moved[here] = part.ends(along[here], level)
        # The solution itself is always inside.
        moved = np.stack([np.minimum(moved[:, 0], 0), np.maximum(moved[:, 1], 0)], -1)
        values, logarithmic = self.values[:, None], self.logarithmic[:, None]
        shares = np.where(logarithmic, moved / np.where(logarithmic, values, 1), 0)
        ends = np.where(logarithmic, values * np.exp(shares), values + moved)
        ends = np.where(self.open_ended[:, None], self.bounds, ends)
        finite = np.where(np.isfinite(self.bounds), self.bounds, 0)
        slack = ROUNDED * (np.abs(values) + np.abs(finite))
        ends = np.where(np.abs(ends - self.bounds) <= slack, self.bounds, ends)
        return np.clip(ends, self.bounds[:, :1], self.bounds[:, 1:])
