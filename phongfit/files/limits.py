"""Formats that hold less than a `Material` does: an error, or the nearest they hold."""

import warnings
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from phongfit.material import Material


def limited(
    name: str, value: Any, highest: float, format: str, nearest: bool
) -> Float[np.ndarray, "..."]:
    """`value` if none of it is above `highest`, else the nearest that is not.

    **Arguments:**

    - `name`: what `value` is; `format`: what cannot hold more.
    - `nearest`: cut off with a warning, rather than an error.

    **Raises:** `ValueError` that names `name`, unless `nearest`.
    """
    array = np.asarray(value, float)
    if array.max(initial=0) <= highest:
        return array
    lost(f"{name}: {array.max():g} came, {format} holds at most {highest:g}", nearest)
    return np.minimum(array, highest)


def lost(message: str, nearest: bool) -> None:
    """Say what a format cannot hold: a warning if `nearest`, else a `ValueError`."""
    if not nearest:
        raise ValueError(f"{message} (nearest=True takes the nearest that it holds)")
    warnings.warn(f"{message}; the nearest is taken", stacklevel=4)


def colour(name: str, leaf: Float[Array, "..."]) -> Float[np.ndarray, "3"]:
    """A leaf of one material as RGB; `ValueError` for a map or several materials."""
    values = np.asarray(leaf, float)
    if values.size not in (1, 3) or values.shape[:-1] not in ((), (1,)):
        raise ValueError(
            f"{name}: shape {leaf.shape} came, that of one material wanted"
        )
    return np.broadcast_to(values.ravel(), (3,)).copy()


def exponent(material: Material, highest: float, format: str, nearest: bool) -> float:
    """The one exponent of a material, for formats that know no other.

    **Raises:** `ValueError` that names `shininess`, as [`limited`][] does.
    """
    channels = colour("shininess", material.shininess)
    if np.ptp(channels) > 0:
        came = ", ".join(f"{channel:g}" for channel in channels)
        lost(f"shininess: {came} came, {format} holds one for all channels", nearest)
        # The mean of logarithms: it is ratios of exponents that are seen.
        channels = np.exp(np.log(np.maximum(channels, 1e-6)).mean(keepdims=True))
    return float(limited("shininess", channels[0], highest, format, nearest))
