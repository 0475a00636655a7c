"""Export of maps for other programs, as materials with texture images."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from phongfit.files.gltf import Part, pbr_material, write_gltf
from phongfit.files.images import to_levels
from phongfit.files.mesh_writing import obj_text, write_ply, write_stl
from phongfit.files.mtl import MAX_NS
from phongfit.files.outputs import replacing_files
from phongfit.geometry.grids import faces_within
from phongfit.geometry.height import HeightField
from phongfit.maps.folder import load_folder
from phongfit.maps.textures import (
    TextureMaps,
    gltf_textures,
    mtl_textures,
    rectangle,
    texture_maps,
)
from phongfit.material import Material


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
    if to == "mtl":
        return _write_mtl(path, name, textured, nearest) + words
    if to in ("obj", "ply", "stl") or surface:
        field = maps.height(distance=distance)
        part = relief(field, maps.normals)
        warned = "".join(f"; {warning}" for warning in field.warnings)
        words = f"; {len(part.faces):,} triangles" + warned + words
        if to == "obj":
            return _write_mtl(path, name, textured, nearest, part) + words
        if to == "ply":
            write_ply(path, part, to_levels(textured.diffuse, "srgb", 8)[field.mask])
            return name + words
        if to == "stl":
            write_stl(path, part)
            return f"{name}, the shape alone{words}"
        # No normal texture, since each texel is a vertex and vertices have normals.
        textures = gltf_textures(textured, None)
    else:
        part = rectangle(*maps.flags.shape)
        textures = gltf_textures(textured, normals)
    material = pbr_material(name, typical(textured), nearest=True)
    material["extras"]["of"] = "the median of the maps; each texel has its own"
    write_gltf(path, [(part, material | textures)])
    height, width = maps.flags.shape
    return f"{name}, {width} × {height} texels" + words


def relief(field: HeightField, normals: Float[np.ndarray, "height width 3"]) -> Part:
    """A height field as triangles, with a vertex and a normal for each pixel.

    **Raises:** `ValueError` if no three neighbours have heights.
    """
    height, width = field.mask.shape
    vertices, faces = field.positions().reshape(-1, 3), faces_within(field.mask)
    if not len(faces):
        raise ValueError("mask: expected neighbouring pixels, got none")
    number = np.cumsum(field.mask.ravel()) - 1
    inside = field.mask.ravel()
    y, x = np.mgrid[:height, :width] + 0.5
    axes = np.asarray(field.camera.rotation, float)
    # A normal of 0 is not identified: it is replaced by the camera's axis.
    own = np.where(normals.any(axis=-1, keepdims=True), normals, [0, 0, 1])
    return Part(
        vertices[inside],
        number[faces],
        (own @ axes.T).reshape(-1, 3)[inside],
        np.stack([x / width, y / height], axis=-1).reshape(-1, 2)[inside],
    )


def _filled_words(textured: TextureMaps) -> str:
    """Text with the number of pixels that were filled in; empty for none."""
    count, of = int(textured.filled.sum()), int(textured.inside.sum())
    if count == 0:
        return ""
    return (
        f"; {count:,} of {of:,} pixels do not identify all: there a highlight is 0, or "
        "has the median of the others"
    )


def typical(textured: TextureMaps) -> Material:
    """Material with the median of each parameter over all pixels."""
    inside = textured.inside[..., 0] > 0
    return Material(
        np.median(textured.diffuse[inside], axis=0),
        np.median(textured.specular[inside], axis=0),
        float(np.median(textured.shininess[inside])),
        np.median(textured.ambient[inside], axis=0),
    )


def _write_mtl(
    path: Path,
    name: str,
    textured: TextureMaps,
    nearest: bool,
    part: Part | None = None,
) -> str:
    """Write an `.mtl` with its textures, and with a part also an `.obj` that names it.

    **Returns:** a description of the written files.
    """
    if any(blank in path.stem for blank in " \t#"):
        raise ValueError(f"{path}: expected a name without blanks, for the textures")
    highest = float(textured.shininess.max())
    if highest > MAX_NS and not nearest:
        raise ValueError(
            f"shininess: expected at most {MAX_NS:g} for .mtl, got {highest:g} "
            "(nearest=True takes the nearest that it holds)"
        )
    capped = np.minimum(textured.shininess, MAX_NS)
    textures = mtl_textures(textured._replace(shininess=capped))
    lines = [
        "# Textures multiply the numbers; those of colours are sRGB-encoded.",
        f"newmtl {'_'.join(name.split())}",
    ]
    for key, (_, numbers) in textures.items():
        shown = " ".join(f"{number:.9g}" for number in numbers)
        lines += [f"{key} {shown}", f"map_{key} {path.stem}_{key}.png"]
    text = "\n".join([*lines, "illum 2", ""])
    with replacing_files(path) as folder:
        for key, (image, _) in textures.items():
            (folder / f"{path.stem}_{key}.png").write_bytes(image)
        library = f"{path.stem}.mtl" if part is not None else path.name
        (folder / library).write_text(text, encoding="utf-8")
        if part is not None:
            mesh = obj_text(part, library, "_".join(name.split()))
            (folder / path.name).write_text(mesh, encoding="utf-8")
    return f"{name}, with {', '.join(f'{path.stem}_{key}.png' for key in textures)}"
