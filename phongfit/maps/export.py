"""Maps for other programs: materials with texture images."""

from pathlib import Path

import numpy as np

from phongfit.files.gltf import pbr_material, write_gltf
from phongfit.files.mtl import MAX_NS
from phongfit.files.outputs import replacing_files
from phongfit.maps.folder import load_folder
from phongfit.maps.textures import (
    TextureMaps,
    gltf_textures,
    mtl_textures,
    rectangle,
    texture_maps,
)
from phongfit.material import Material


def export_maps(folder: Path, path: Path, to: str, *, nearest: bool) -> str:
    """Write the maps of a folder as a material with textures, all or nothing.

    What a pixel does not identify is filled in: see [`phongfit.maps.textures`][].

    **Arguments:**

    - `path`: the file to write; the textures of an `.mtl` go beside it.
    - `to`: `"mtl"` or `"gltf"`.
    - `nearest`: where the format cannot hold an exponent, write the nearest it holds.

    **Returns:** what was written, in words.

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
    height, width = maps.flags.shape
    material = pbr_material(name, typical(textured), nearest=True)
    material["extras"]["of"] = "the median of the maps; each texel has its own"
    parts = [(rectangle(height, width), material)]
    write_gltf(path, parts, gltf_textures(textured, normals))
    return f"{name}, {width} × {height} texels" + words


def _filled_words(textured: TextureMaps) -> str:
    """In how many pixels something is not their own; nothing if in none."""
    count, of = int(textured.filled.sum()), int(textured.inside.sum())
    if count == 0:
        return ""
    return (
        f"; {count:,} of {of:,} pixels do not identify all: there a highlight is 0, or "
        "has the median of the others"
    )


def typical(textured: TextureMaps) -> Material:
    """The median over all pixels, parameter by parameter."""
    inside = textured.inside[..., 0] > 0
    return Material(
        np.median(textured.diffuse[inside], axis=0),
        np.median(textured.specular[inside], axis=0),
        float(np.median(textured.shininess[inside])),
        np.median(textured.ambient[inside], axis=0),
    )


def _write_mtl(path: Path, name: str, textured: TextureMaps, nearest: bool) -> str:
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
        (folder / path.name).write_text(text, encoding="utf-8")
    return f"{name}, with {', '.join(f'{path.stem}_{key}.png' for key in textures)}"
