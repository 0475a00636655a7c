"""Meshes on disk, of every format, with the materials that their files name.

Colours of vertices are linear in glTF, by its specification; those of other formats,
which define no encoding, are taken to be sRGB-encoded, as most programs write them.
"""

import os
from pathlib import Path
from typing import Any

import numpy as np

from phongfit.codes import warn
from phongfit.edge import checked
from phongfit.files.gltf_materials import GltfShade
from phongfit.files.gltf_reading import GltfPart, read_gltf
from phongfit.files.inputs import Note, naming
from phongfit.files.mesh_parts import (
    UNNAMED,
    LoadedMesh,
    MeshPart,
    join_parts,
    white,
)
from phongfit.files.mtl_textures import Shaded
from phongfit.files.obj import read_obj
from phongfit.files.off import read_off
from phongfit.files.ply import read_ply
from phongfit.files.stl import read_stl

MOST_NOTES = 20
"""Warnings of what a file holds and is not used."""


@checked
def load_mesh(path: str | os.PathLike[str], **options: Any) -> LoadedMesh:
    """A triangle mesh from OBJ (with .mtl), PLY, STL, glTF, GLB or OFF.

    Several objects in a file become one mesh, in the file's world coordinates. Normals
    are those of the file; where it has none, they are computed, and vertices that STL
    or OBJ hold several times are one. An OBJ with `s` is smooth within each smoothing
    group and flat where it is off; one without `s` is smooth everywhere. Polygons are
    cut into triangles, concave ones too.

    Materials of an .mtl are read as by [`read_mtl`][]; one that is missing is the
    default [`Material`][], with a warning, and still a material of its own. If the
    faces name none and there is only one, it is theirs. Of glTF's, which are of another
    model (metallic-roughness, specular-glossiness), the nearest of Phong's is taken:
    see `phongfit.files.gltf_materials`. A material that phongfit wrote is what it was.
    glTF's faces are flat where the file has no normals.

    An .mtl or a texture that is named with backslashes, in letters of the other case or
    in a folder of another computer is looked for beside the file, and below it.

    Textures of colours (map_Ka, map_Kd, map_Ks, map_Ke; glTF's base colour, specular
    and emission; the TextureFile of a PLY), of the exponent (map_Ns, map_Pr; glTF's
    roughness), normal maps and colours of vertices become the mesh's `textures`;
    `mesh.with_textures(None)` is the mesh without. Colours of vertices multiply ρ_d and
    ρ_a, where there is no texture of these; of a PLY or OFF, and of an OBJ without
    materials, they are these. Colours of a PLY's or OFF's faces are taken where there
    are none of vertices. They are sRGB-encoded, but linear in glTF. What a file has
    besides that is not used (more uv, skins, other maps, transparency, unknown
    extensions) is named in a warning, each.

    **Arguments:**

    - `path`: the suffix tells the format.
    - `options`: of [`Mesh`][], such as `two_sided` or `crease_angle`, with which the
        file's normals are not used.

    **Returns:** `(mesh, material, names)`: see [`LoadedMesh`][].

    **Raises:** `ValueError` that names the file: it is missing, broken, of an unknown
    format, or holds no triangles.
    """
    path = Path(path)
    notes: dict[str, None] = {}
    loaded = _load(path, options, notes.setdefault)
    for words in list(notes)[:MOST_NOTES]:
        warn("part-unused", words, stacklevel=2)
    if len(notes) > MOST_NOTES:
        left = f"{len(notes) - MOST_NOTES} other parts of it are not used"
        warn("part-unused", f"{path}: {left}", stacklevel=2)
    return loaded


def _load(path: Path, options: dict[str, Any], note: Note) -> LoadedMesh:
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise ValueError(f"{path}: its suffix is none of {', '.join(FORMATS)}")
    if suffix == ".obj":
        # Notes and errors of its .mtl name that file.
        parts = read_obj(path, note)
    else:
        with naming(str(path)):
            parts = READERS[suffix](path, lambda words: note(f"{path}: {words}"))
    with naming(str(path)):
        return join_parts(parts, options)


def _read_gltf(path: Path, note: Note) -> list[MeshPart]:
    return _named(*read_gltf(path, note))


READERS = {
    ".gltf": _read_gltf,
    ".glb": _read_gltf,
    ".ply": read_ply,
    ".stl": read_stl,
    ".off": read_off,
}
FORMATS = (".obj", *READERS)


def _named(parts: list[GltfPart], shades: dict[int, GltfShade]) -> list[MeshPart]:
    """Parts of a glTF file with a name of its own for each of its materials."""
    names: dict[int | None, str] = {None: UNNAMED}
    taken = {UNNAMED} if any(part.material is None for part in parts) else set()
    times: dict[str, int] = {}
    for number in dict.fromkeys(part.material for part in parts):
        if number is None:
            continue
        name = given = shades[number].name or UNNAMED
        while name in taken:
            times[given] = times.get(given, 1) + 1
            name = f"{given}-{times[given]}"
        names[number] = name
        taken.add(name)
    bare = Shaded(), white()
    return [
        MeshPart(
            part.vertices,
            part.faces,
            names[part.material],
            bare[bool(part.colours)]
            if part.material is None
            else shades[part.material].shaded,
            part.normals,
            None if part.uv is None else part.uv[part.faces],
            part.colours,
            np.zeros(len(part.vertices), int),
        )
        for part in parts
        if len(part.faces)
    ]
