"""A page that shows maps under a lamp at the pointer: WebGL 2, no network.

Maps are stored as lossless WebP pictures: diffuse, specular and ambient in 8 bits,
each scaled to its range and sRGB-encoded; logarithms of exponents; normals in
octahedral coordinates of 12 bits; heights in 16 bits. Height for parallel rays, and
inverse depth for a pinhole, are linear along lines in the picture, so the same ray
marching of shadows serves both.

??? cite "Source"
    Cigolle et al., *A survey of efficient representations for independent unit
    vectors*, Journal of Computer Graphics Techniques 3(2), 2014.
"""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt

from phongfit.edge import checked
from phongfit.files.formats import data_uri, encode_webp
from phongfit.files.outputs import replacing
from phongfit.geometry.height import HeightField
from phongfit.geometry.integration import camera_rays
from phongfit.maps.pixel.settings import Flag
from phongfit.maps.result import Maps
from phongfit.reflectance import AbstractSpecular, BlinnPhong, Phong
from phongfit.rendering.film import encode
from phongfit.report.html import fill

NORMAL_LEVELS = 2**12 - 1
HEIGHT_LEVELS = 2**16 - 1
EXTREMES = (1e-3, 1e6)
"""Range of exponents, to which others are clipped without a visible difference."""


@checked
def write_view(
    path: str | os.PathLike[str],
    maps: Maps,
    *,
    surface: HeightField | None = None,
    title: str = "maps",
) -> None:
    """Write a page on which the pointer moves a lamp over the object.

    The page is a single file and needs no network. It shows the light that
    [`Maps`][]`.relight` gives for a distant light of strength 1, sRGB-encoded.

    **Arguments:**

    - `path`: the file, `.html` by custom.
    - `surface`: the height, if it is known; default that of `maps`.
    - `title`: of the page.

    **Raises:** `ValueError` that names missing data, or a specular model that the page
    does not support; `OSError` that names `path`.
    """
    surface = maps.height() if surface is None else surface
    model, content = _model(maps.specular_model), _packed(maps, surface)
    data = {"model": model, "title": title, **content}
    text = fill(
        "view.html",
        title=title,
        warnings=surface.warnings,
        # Escaped, since "</" could end the script element.
        data=json.dumps(data).replace("</", "<\\/"),
    )
    with replacing(path) as temporary:
        Path(temporary).write_text(text, encoding="utf-8")


def _model(model: AbstractSpecular | None) -> dict[str, Any]:
    match model:
        case Phong(gate=gate):
            return {"mirror": True, "gate": gate, "normalized": False}
        case BlinnPhong(gate=gate, normalized=normalized):
            return {"mirror": False, "gate": gate, "normalized": normalized}
    raise ValueError(
        "specular_model: expected Phong or BlinnPhong, which the page knows, got "
        f"{type(model).__name__}"
    )


def _packed(maps: Maps, surface: HeightField) -> dict[str, Any]:
    """Textures as data URIs, their ranges, and the camera."""
    material = maps.material
    inside = surface.mask & ~maps.flagged(Flag.OUTSIDE)
    height, width = inside.shape
    textures: dict[str, str] = {}
    ranges: dict[str, list[float]] = {}
    for name in ("diffuse", "specular", "ambient"):
        colours = np.where(inside[..., None], getattr(material, name), 0)
        top = max(float(colours.max()), 1e-6)
        levels = np.asarray(encode(colours / top, "srgb")) * 255
        textures[name], ranges[name] = _picture(levels), [0.0, top]
    exponents = np.clip(np.asarray(material.shininess, float), *EXTREMES)
    logarithms = np.log(np.broadcast_to(exponents, (height, width, 3)))
    low, high = (
        (float(edge(logarithms[inside])) if inside.any() else 0.0)
        for edge in (np.min, np.max)
    )
    spread = max(high - low, 1e-6)
    shares = np.where(inside[..., None], (logarithms - low) / spread, 0)
    textures["shininess"] = _picture(255 * shares)
    ranges["shininess"] = [low, low + spread]
    textures["normals"] = _picture(octahedral(maps.normals))
    relief, ranges["relief"], view = _relief(surface, inside)
    textures["relief"] = _picture(relief)
    ambient = np.asarray(maps.ambient_light, float).tolist()
    return {
        "size": [width, height],
        "textures": textures,
        "ranges": ranges,
        "ambient": ambient,
        "heights": [float(edge(surface.height)) for edge in (np.nanmin, np.nanmax)],
        **view,
    }


def _relief(
    surface: HeightField, inside: np.ndarray
) -> tuple[np.ndarray, list[float], dict[str, Any]]:
    """Relief for ray marching of shadows: two bytes and mask, range, and camera."""
    camera, rays = surface.camera, camera_rays(surface.camera)
    parallel = rays.parallel
    plane = rays.origin if parallel else rays.direction
    first, last = plane[0, 0, :2], plane[-1, -1, :2]
    steps = max(inside.shape[1] - 1, inside.shape[0] - 1, 1)
    pixel = float(np.abs(last - first).max() / steps) or 1.0
    if parallel:
        values = surface.height / pixel
    else:
        axis = np.asarray(camera.rotation, float)[:, 2]
        depth = float(np.dot(camera.position, axis)) - surface.height
        values = 1 / depth
        values = values / np.nanmax(values)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    spread = max(high - low, 1e-9)
    # Parts of the surface outside the shown pixels still cast shadows.
    shares = np.where(surface.mask, (values - low) / spread, 0)
    levels = np.round(shares * HEIGHT_LEVELS).astype(int)
    mask = 255 * inside + 128 * (surface.mask & ~inside)
    relief = np.stack([levels // 256, levels % 256, mask], axis=-1)
    # Position of texel (x, y): on the plane of the picture, or at depth 1.
    unit = pixel if parallel else 1.0
    view = {
        "parallel": parallel,
        "corner": (first / unit).tolist(),
        "step": pixel / unit,
    }
    return relief, [low, low + spread], view


def octahedral(
    normals: Float[np.ndarray, "height width 3"],
) -> UInt[np.ndarray, "height width 3"]:
    """Unit vectors as two numbers of 12 bits, in three bytes.

    The high 8 bits of both, then their low 4 bits; a zero vector becomes +z.
    """
    size = np.abs(normals).sum(axis=-1, keepdims=True)
    unit = np.where(size > 0, normals, [0, 0, 1]) / np.where(size > 0, size, 1)
    flat, below = unit[..., :2], unit[..., 2:] < 0
    folded = (1 - np.abs(flat[..., ::-1])) * np.where(flat < 0, -1, 1)
    share = (np.where(below, folded, flat) + 1) / 2
    levels = np.round(share * NORMAL_LEVELS).astype(np.uint32)
    low = (levels[..., 0] & 15) * 16 + (levels[..., 1] & 15)
    return np.stack([levels[..., 0] >> 4, levels[..., 1] >> 4, low], axis=-1)


def _picture(levels: Any) -> str:
    """A data URI of a lossless picture, from numbers 0 to 255."""
    return data_uri(encode_webp(np.round(levels)), "webp")
