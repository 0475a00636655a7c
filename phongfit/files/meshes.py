"""Meshes from files of every supported format, with their materials.

Colours of vertices are linear in glTF, by its specification; those of other formats,
which define no encoding, are read as sRGB-encoded, as most programs write them.
"""

import os
from pathlib import Path
from typing import Any

from phongfit.codes import warn
from phongfit.edge import checked
from phongfit.files.gltf_reading import read_gltf
from phongfit.files.inputs import Note, naming
from phongfit.files.mesh_parts import LoadedMesh, join_parts
from phongfit.files.obj import read_obj
from phongfit.files.off import read_off
from phongfit.files.ply import read_ply
from phongfit.files.stl import read_stl

MOST_NOTES = 20
"""Maximum number of warnings on unused parts of a file."""


@checked
def load_mesh(path: str | os.PathLike[str], **options: Any) -> LoadedMesh:
    """A triangle mesh from OBJ (with .mtl), PLY, STL, glTF, GLB or OFF.

    Several objects in a file become one mesh, in the file's world coordinates. Normals
    are those of the file. If it has none, they are computed, and repeated vertices of
    STL and OBJ are merged. An OBJ with `s` is smooth within each smoothing group and
    flat where smoothing is off; an OBJ without `s` is smooth everywhere. Polygons, also
    concave ones, are cut into triangles.

    Materials of an .mtl are read as by [`read_mtl`][]. A missing one is replaced by the
    default [`Material`][], with a warning, and remains a separate material. If the
    faces name no material and there is only one, they get it. Materials of glTF, which
    has other models (metallic-roughness, specular-glossiness), are converted to the
    nearest of Phong's: see `phongfit.files.gltf_materials`. Materials that phongfit
    wrote are read unchanged. glTF's faces are flat if the file has no normals.

    If an .mtl or a texture is named with backslashes, in letters of the other case or
    in a folder of another computer, it is looked for beside the mesh's file and below.

    Textures of colours (map_Ka, map_Kd, map_Ks, map_Ke; glTF's base colour, specular
    and emission; the TextureFile of a PLY), of the exponent (map_Ns, map_Pr; glTF's
    roughness), normal maps and colours of vertices become the mesh's `textures`;
    `mesh.with_textures(None)` removes them. Colours of vertices multiply ρ_d and ρ_a,
    unless these have textures. In a PLY or OFF, and in an OBJ without materials, they
    are ρ_d and ρ_a. Colours of faces of a PLY or OFF are used if there are none of
    vertices. Colours are sRGB-encoded, but linear in glTF. Each other part of a file
    (more uv, skins, other maps, transparency, unknown extensions) is named in a
    warning.

    **Arguments:**

    - `path`: the suffix determines the format.
    - `options`: of [`Mesh`][], such as `two_sided` or `crease_angle`, which replaces
        the file's normals.

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
        # Without a prefix, since notes and errors of its .mtl name that file.
        parts = read_obj(path, note)
    else:
        with naming(str(path)):
            parts = READERS[suffix](path, lambda words: note(f"{path}: {words}"))
    with naming(str(path)):
        return join_parts(parts, options)


READERS = {
    ".gltf": read_gltf,
    ".glb": read_gltf,
    ".ply": read_ply,
    ".stl": read_stl,
    ".off": read_off,
}
FORMATS = (".obj", *READERS)
