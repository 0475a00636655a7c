"""Export of maps for other programs, as materials with texture images."""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float

from phongfit.files.mesh_saving import write_mesh, write_textured_mtl
from phongfit.files.mtl import MAX_NS
from phongfit.geometry.grids import faces_within
from phongfit.geometry.height import HeightField
from phongfit.geometry.meshes import Mesh
from phongfit.maps.folder import load_folder
from phongfit.maps.textures import TextureMaps, texture_maps
from phongfit.material import Material
from phongfit.textures import Textures, VertexColours

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

    Unidentified parameters are filled in: see [`phongfit.maps.textures`][].

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
