"""Maps as texture images of 8 bits, with sRGB-encoded colours as renderers expect.

Unidentified parameters are arbitrary in the maps, which mark them by infinite errors; a
texture has no errors. So a highlight that is 0 within its error becomes 0, and other
unidentified parameters become the median of the pixels that identify them.
"""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from phongfit.files.formats import encode_png
from phongfit.files.gltf import Part, Picture, roughness, specular_colour
from phongfit.files.images import to_levels
from phongfit.files.limits import as_blinn
from phongfit.maps.pixel.flags import Flag
from phongfit.maps.result import MAP_PARAMETERS, Maps
from phongfit.material import Material
from phongfit.reflectance import AbstractSpecular


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


def gltf_textures(
    textured: TextureMaps, normals: Float[np.ndarray, "height width 3"] | None
) -> dict[str, Any]:
    """Keys of a glTF material with the maps as textures: see [`phongfit.files.gltf`][].

    **Arguments:** `normals`: in the axes of the image (right, up, to the viewer);
    `None` if the vertices have normals.
    """

    def picture(*channels: np.ndarray) -> Picture:
        # No interpolation or repetition, since a texel is one pixel of the maps.
        png = encode_png(np.concatenate(channels, axis=-1))
        return Picture(png, nearest=True, repeat=False)

    tint = specular_colour(textured.specular, textured.shininess)
    factor = np.maximum(tint.reshape(-1, 3).max(axis=0), 1e-6)
    # glTF does not use red; green is roughness, and blue is metallic.
    rough = np.zeros_like(textured.diffuse)
    rough[..., 1] = roughness(textured.shininess)[..., 0]
    inside = to_levels(textured.inside, "linear", 8)
    keys: dict[str, Any] = {
        "alphaMode": "MASK",
        "pbrMetallicRoughness": {
            "baseColorTexture": picture(to_levels(textured.diffuse, "srgb", 8), inside),
            "metallicRoughnessTexture": picture(to_levels(rough, "linear", 8)),
            "metallicFactor": 0.0,
            "roughnessFactor": 1.0,
        },
        "extensions": {
            "KHR_materials_specular": {
                "specularColorFactor": factor,
                "specularColorTexture": picture(to_levels(tint / factor, "srgb", 8)),
            }
        },
    }
    if normals is not None:
        ahead = np.where(textured.inside > 0, normals, [0, 0, 1])
        keys["normalTexture"] = picture(to_levels((ahead + 1) / 2, "linear", 8))
    return keys


def mtl_textures(textured: TextureMaps) -> dict[str, tuple[bytes, list[float]]]:
    """Bytes of each texture of an `.mtl`, and the numbers that it multiplies."""
    highest = float(max(textured.shininess.max(), 1.0))
    white = [1.0, 1.0, 1.0]
    grey = np.repeat(textured.shininess / highest, 3, axis=-1)
    return {
        "Ka": (encode_png(to_levels(textured.ambient, "srgb", 8)), white),
        "Kd": (encode_png(to_levels(textured.diffuse, "srgb", 8)), white),
        "Ks": (encode_png(to_levels(textured.specular, "srgb", 8)), white),
        "Ns": (encode_png(to_levels(grey, "linear", 8)), [highest]),
    }


def rectangle(height: int, width: int) -> Part:
    """Rectangle for the textures of maps: 2 high, in their aspect ratio, facing +z."""
    x, y = width / height, 1.0
    corners = np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]])
    return Part(
        corners,
        np.array([[0, 1, 2], [0, 2, 3]]),
        np.tile([0.0, 0.0, 1.0], (4, 1)),
        np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]]),
    )
