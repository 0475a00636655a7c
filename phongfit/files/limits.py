"""Limits of formats that cannot hold every `Material`: error or nearest value."""

import dataclasses
import math
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from phongfit.codes import warn
from phongfit.material import Material
from phongfit.microfacets import GGX, Ward
from phongfit.reflectance import (
    AbstractSpecular,
    BlinnPhong,
    Phong,
    blinn_from_phong,
)


def limited(
    name: str, value: Any, highest: float, format: str, nearest: bool
) -> Float[np.ndarray, "..."]:
    """`value`, clipped to `highest` with a warning, or an error.

    **Arguments:**

    - `name`: name of the value; `format`: name of the format; both for the message.
    - `nearest`: clip with a warning instead of an error.

    **Raises:** `ValueError` that names `name`, unless `nearest`.
    """
    array = np.asarray(value, float)
    if array.max(initial=0) <= highest:
        return array
    lost(f"{name}: {format} holds at most {highest:g}, got {array.max():g}", nearest)
    return np.asarray(np.minimum(array, highest))


def lost(message: str, nearest: bool) -> None:
    """Report a value that a format cannot hold: warn if `nearest`, else raise."""
    if not nearest:
        raise ValueError(f"{message} (nearest=True takes the nearest that it holds)")
    warn("nearest-taken", f"{message}; the nearest is taken", stacklevel=4)


def colour(name: str, leaf: Float[Array, "..."]) -> Float[np.ndarray, "3"]:
    """A parameter of one material as RGB; `ValueError` for several materials."""
    values = np.asarray(leaf, float)
    if values.size not in (1, 3) or values.shape[:-1] not in ((), (1,)):
        raise ValueError(f"{name}: expected one material, got shape {leaf.shape}")
    return np.broadcast_to(values.ravel(), (3,)).copy()


def exponent(material: Material, highest: float, format: str, nearest: bool) -> float:
    """The exponent of a material, for formats with one exponent for all channels.

    **Raises:** `ValueError` that names `shininess`, as [`limited`][] does.
    """
    channels = colour("shininess", material.shininess)
    if np.ptp(channels) > 0:
        came = ", ".join(f"{channel:g}" for channel in channels)
        lost(f"shininess: {format} holds one for all channels, got {came}", nearest)
        # Geometric mean, since ratios of exponents determine the appearance.
        channels = np.exp(np.log(np.maximum(channels, 1e-6)).mean(keepdims=True))
    return float(limited("shininess", channels[0], highest, format, nearest))


def as_blinn(material: Material, model: AbstractSpecular) -> Material:
    r"""A material of any model as one of the un-normalised Blinn-Phong model.

    Phong's exponents become Blinn's by [`blinn_from_phong`][]; normalised reflectances
    are multiplied by the model's factors: $1 / \pi$, and $(f + 2) / (2 \pi)$. Roughness
    becomes the exponent of [`shininess_from_roughness`][], and ρ_s the height of the
    highlight seen head-on.

    **Raises:** `ValueError` for another model.
    """
    match model:
        case Phong():
            shininess = blinn_from_phong(material.shininess)
            return dataclasses.replace(material, shininess=shininess)
        case BlinnPhong(normalized=True):
            lobe = (material.shininess + 2) / (2 * math.pi)
            specular = np.asarray(material.specular) * np.asarray(lobe)
            return dataclasses.replace(
                material, diffuse=material.diffuse / math.pi, specular=specular
            )
        case BlinnPhong():
            return material
        case GGX() | Ward():
            exponent = 2 / model.alpha_squared(material.shininess) - 2
            peak = model.peak(material.shininess)
            specular = np.asarray(material.specular) * np.asarray(peak)
            return dataclasses.replace(material, specular=specular, shininess=exponent)
    raise ValueError(
        "model: expected Phong, BlinnPhong, GGX or Ward, got " + type(model).__name__
    )
