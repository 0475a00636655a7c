"""Export of maps for other programs, as materials with texture images."""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from phongfit.files.limits import as_blinn
from phongfit.files.mesh_saving import write_mesh, write_textured_mtl
from phongfit.files.mtl import MAX_NS
from phongfit.geometry.grids import faces_within
from phongfit.geometry.height import HeightField
from phongfit.geometry.meshes import Mesh
from phongfit.maps.folder import load_folder
from phongfit.maps.pixel.settings import Flag
from phongfit.maps.result import MAP_PARAMETERS, Maps
from phongfit.material import Material
from phongfit.reflectance import AbstractSpecular
from phongfit.textures import Texture, Textures, VertexColours


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
    """The maps with unidentified parameters filled in, and a mask of these pixels.

    Unidentified parameters are arbitrary in the maps, which mark them by infinite
    errors; a texture has no errors. So a highlight that is 0 within its error becomes
    0, and other unidentified parameters become the median of the pixels that identify
    them.
    """
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


BITS = 8
"""Bits of the textures, since maps have more noise than these round."""


def export_maps(
    folder: Path,
    path: Path,
    to: str,
    *,
    nearest: bool,
    surface: bool = False,
    distance: float | None = None,
) -> str:
    """Write the maps of a folder as a material with textures, all or nothing.

    Unidentified parameters are filled in: see [`filled_in`][].

    **Arguments:**

    - `path`: the file to write; the textures of an `.mtl` are written beside it.
    - `to`: `"mtl"`, `"gltf"`, or `"obj"`, `"ply"` and `"stl"`, which hold a mesh.
    - `nearest`: if the format cannot hold an exponent, write the nearest possible one.
    - `surface`: for glTF the mesh of the maps' height, in place of a rectangle.
    - `distance`: as for [`Maps`][]`.height`.

    **Returns:** a description of the written files.

    **Raises:** `ValueError` that names the file or the parameter, `OSError` that names
    `path`.
    """
    maps, record, normals = load_folder(folder)
    textured, name = texture_maps(maps, record.model.build()), record.data.name
    if not textured.inside.any():
        raise ValueError(f"{folder}: no pixel of these maps was fitted")
    words = _filled_words(textured)
    if nearest and to in ("mtl", "obj"):
        textured = textured._replace(
            specular=np.minimum(textured.specular, 1),
            shininess=np.minimum(textured.shininess, MAX_NS),
        )
    material, names = Material(1.0, 1.0, 1.0, 1.0), ["_".join(name.split())]
    if to == "mtl":
        textures = textured.textures()
        write_textured_mtl(path, names[0], material, textures, nearest=nearest)
        return name + words
    if to in ("obj", "ply", "stl") or surface:
        field = maps.height(distance=distance)
        mesh = relief(field, maps.normals)
        warned = "".join(f"; {warning}" for warning in field.warnings)
        words = f"; {len(mesh.faces):,} triangles" + warned + words
        # No normal texture, since each texel is a vertex and vertices have normals.
        textures, inside = textured.textures(), field.mask
    else:
        mesh, inside = rectangle(*maps.flags.shape), None
        textures = textured.textures(normals)
    if to == "stl":
        words = f", the shape alone{words}"
    if to == "ply":
        rows = VertexColours(np.minimum(textured.diffuse, 1)[inside])
        material = Material(1.0, 0.0, 1.0, 1.0)
        textures = Textures(diffuse=rows, ambient=rows)
    opacity = None
    if to == "gltf":
        # glTF has no ambient texture.
        ambient = textured.ambient[textured.inside[..., 0] > 0]
        material = dataclasses.replace(material, ambient=np.median(ambient, axis=0))
        textures = dataclasses.replace(textures, ambient=None)
        opacity, names = textured.inside, [name]
        height, width = maps.flags.shape
        words = f", {width} × {height} texels" + words
    mesh = mesh.with_textures(textures)
    write_mesh(
        path, to, mesh, material, names, nearest=nearest, bits=BITS, opacity=opacity
    )
    return name + words


def relief(field: HeightField, normals: Float[np.ndarray, "height width 3"]) -> Mesh:
    """A height field as triangles, with a vertex and a normal for each pixel.

    **Raises:** `ValueError` if no three neighbours have heights.
    """
    height, width = field.mask.shape
    vertices, faces = field.positions().reshape(-1, 3), faces_within(field.mask)
    if not len(faces):
        raise ValueError("mask: expected neighbouring pixels, got none")
    inside = field.mask.ravel()
    faces = (np.cumsum(inside) - 1)[faces]
    y, x = np.mgrid[:height, :width] + 0.5
    uv = np.stack([x / width, y / height], axis=-1).reshape(-1, 2)[inside]
    axes = np.asarray(field.camera.rotation, float)
    # A normal of 0 is not identified: it is replaced by the camera's axis.
    own = np.where(normals.any(axis=-1, keepdims=True), normals, [0, 0, 1])
    own = (own @ axes.T).reshape(-1, 3)[inside]
    return Mesh(vertices[inside], faces, own, uv=uv[faces])


def rectangle(height: int, width: int) -> Mesh:
    """Rectangle for the textures of maps: 2 high, in their aspect ratio, facing +z."""
    x, y = width / height, 1.0
    corners = np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uv = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])
    return Mesh(corners, faces, uv=uv[faces])


def _filled_words(textured: TextureMaps) -> str:
    """Text with the number of pixels that were filled in; empty for none."""
    count, of = int(textured.filled.sum()), int(textured.inside.sum())
    if count == 0:
        return ""
    return (
        f"; {count:,} of {of:,} pixels do not identify all: there a highlight is 0, or "
        "has the median of the others"
    )
