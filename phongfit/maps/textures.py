"""Maps as textures of a material.

Unidentified parameters are arbitrary in the maps, which mark them by infinite errors; a
texture has no errors. So a highlight that is 0 within its error becomes 0, and other
unidentified parameters become the median of the pixels that identify them.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from phongfit.files.limits import as_blinn
from phongfit.maps.pixel.flags import Flag
from phongfit.maps.result import MAP_PARAMETERS, Maps
from phongfit.material import Material
from phongfit.reflectance import AbstractSpecular
from phongfit.textures import Texture, Textures


class TextureMaps(NamedTuple):
    """Maps of the un-normalised Blinn-Phong model, (H, W, 3), with masks.

    - `inside`: 1 for pixels that were fitted, else 0.
    - `filled`: pixels in which a parameter was filled in.
    """

    ambient: Float[np.ndarray, "height width 3"]
    diffuse: Float[np.ndarray, "height width 3"]
    specular: Float[np.ndarray, "height width 3"]
    shininess: Float[np.ndarray, "height width 1"]
    inside: Float[np.ndarray, "height width 1"]
    filled: Bool[np.ndarray, "height width"]

    def textures(
        self, normals: Float[np.ndarray, "height width 3"] | None = None
    ) -> Textures:
        """Textures of a material whose parameters are 1; ρ_a and ρ_d are at most 1.

        Without interpolation or repetition, since a texel is one pixel of the maps.

        **Arguments:** `normals`: in the axes of the image (right, up, to the viewer);
        `None` if the vertices have normals.
        """
        maps = {
            "ambient": np.minimum(self.ambient, 1),
            "diffuse": np.minimum(self.diffuse, 1),
            "specular": self.specular,
            "shininess": self.shininess,
        }
        if normals is not None:
            maps["normal"] = np.where(self.inside > 0, normals, [0, 0, 1])
        made = {name: Texture(one, "nearest", "clamp") for name, one in maps.items()}
        return Textures(**made)


def texture_maps(maps: Maps, model: AbstractSpecular) -> TextureMaps:
    """Filled maps in the model of textures, with one exponent for all channels.

    The exponent is the geometric mean over the channels, since ratios of exponents are
    visible.
    """
    filled, is_filled = filled_in(maps)
    material = as_blinn(filled, model)
    inside = ~maps.flagged(Flag.OUTSIDE)[..., None]
    exponents = np.maximum(np.asarray(material.shininess, float), 1e-6)
    return TextureMaps(
        np.asarray(material.ambient, float),
        np.asarray(material.diffuse, float),
        np.asarray(material.specular, float),
        np.where(inside, np.exp(np.log(exponents).mean(axis=-1, keepdims=True)), 0),
        inside.astype(float),
        is_filled,
    )


def filled_in(maps: Maps) -> tuple[Material, Bool[np.ndarray, "height width"]]:
    """The maps with unidentified parameters filled in, and a mask of these pixels."""
    inside = ~maps.flagged(Flag.OUTSIDE)[..., None]
    # Not BLACK pixels, which stay black, and not AT_BOUND, where f is not arbitrary.
    vague = maps.flagged(Flag.TOO_FEW | Flag.NO_HIGHLIGHT | Flag.DEGENERATE)[..., None]
    filled, touched = {}, np.zeros(maps.flags.shape, bool)
    for name in MAP_PARAMETERS:
        values, errors = getattr(maps, name), getattr(maps.stderr, name)
        chance = inside & vague & ~np.isfinite(errors)
        filled[name] = np.where(chance, _medians(values, inside & ~chance), values)
        touched |= chance.any(axis=-1)
    # With a finite error ρ_s is small, and its exponent is not identified.
    matte = maps.flagged(Flag.NO_HIGHLIGHT)[..., None]
    matte = matte & np.isfinite(maps.stderr.specular)
    filled["specular"] = np.where(matte, 0, filled["specular"])
    return dataclasses.replace(maps.material, **filled), touched


def _medians(values: np.ndarray, identified: np.ndarray) -> np.ndarray:
    """Median of each channel over the pixels that identify it; 0 without any."""
    kept = [channel[own] for channel, own in zip(values.T, identified.T, strict=True)]
    return np.array([np.median(one) if one.size else 0 for one in kept], values.dtype)
