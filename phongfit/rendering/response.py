"""Response curves of cameras: the number that is stored for each amount of light."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from phongfit.edge import checked
from phongfit.rendering.jpeg import namespace

TINY = np.finfo(np.float32).tiny
MOST = 65_536
"""Largest number of samples of a curve: files of 16 bits have no more levels."""


@dataclass(frozen=True, init=False, repr=False)
class ResponseCurve:
    """An encoding that is given by samples of a rising curve.

    The samples are the linear light for equally spaced stored numbers from 0 to 1; they
    begin with 0 and end with 1. Between them the curve is linear, so that its inverse
    is exact. All channels share the curve. Arguments named `encoding` accept a
    `ResponseCurve`.

        gamma = pf.ResponseCurve([(k / 256) ** 1.8 for k in range(257)])
        image = pf.read_image("ball.png", gamma)
    """

    light: tuple[float, ...]

    @checked
    def __init__(self, light: Sequence[float] | Float[np.ndarray, " samples"]):
        """**Arguments:** `light`: at least two numbers, rising from 0 to 1.

        **Raises:** `ValueError` that names the argument.
        """
        samples = np.asarray(light, float)
        wanted = f"2 … {MOST} numbers that rise from 0 to 1"
        if samples.ndim != 1 or not 2 <= len(samples) <= MOST:
            raise ValueError(f"light: expected {wanted}, got shape {samples.shape}")
        if samples[0] != 0 or samples[-1] != 1:
            ends = f"{samples[0]:g} … {samples[-1]:g}"
            raise ValueError(f"light: expected {wanted}, got {ends}")
        # Steps must be representable in single precision.
        if not (np.diff(samples) > 0).all() or samples[1] < TINY:
            index = int(np.argmin(np.diff(samples)))
            step = f"{samples[index]:g} and then {samples[index + 1]:g}"
            raise ValueError(f"light: expected {wanted}, got {step}")
        object.__setattr__(self, "light", tuple(samples.tolist()))

    def encode(self, light: Any) -> Any:
        """Stored numbers for linear light, both in [0, 1]; arrays of JAX or NumPy.

        Light outside of [0, 1] is clipped.
        """
        xp = namespace(light)
        numbers, curve = self._samples(xp, light.dtype)
        return xp.interp(light, curve, numbers).astype(light.dtype)

    def decode(self, numbers: Any) -> Any:
        """Linear light of stored numbers: the inverse of [`encode`][]."""
        xp = namespace(numbers)
        stored, curve = self._samples(xp, numbers.dtype)
        return xp.interp(numbers, stored, curve).astype(numbers.dtype)

    def _samples(self, xp: Any, dtype: Any) -> tuple[Any, Any]:
        """Stored numbers and their light, as arrays of `xp`: NumPy or `jax.numpy`."""
        numbers = np.linspace(0, 1, len(self.light))
        return xp.asarray(numbers, dtype), xp.asarray(np.array(self.light), dtype)

    def __repr__(self) -> str:
        return f"ResponseCurve({len(self.light)} samples)"

    def __str__(self) -> str:
        return "response curve"


AS_STORED = ResponseCurve((0.0, 1.0))
"""The curve that returns the numbers of a file unchanged."""
