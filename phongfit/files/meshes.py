"""Meshes on disk, through trimesh, with the materials that their files name."""

import io
import os
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh

from phongfit.files.inputs import inside, naming, read_bytes, read_text
from phongfit.files.mtl import read_mtl
from phongfit.geometry.meshes import Mesh
from phongfit.material import Material, stack_materials

FORMATS = (".obj", ".ply", ".stl", ".gltf", ".glb", ".off")
MAX_BYTES = 2**31
UNNAMED = "default"


class LoadedMesh(NamedTuple):
    """What a file holds: `mesh`, its M materials in one `material`, and their `names`.

    Where M > 1, the mesh's `material_index` counts them in this order.
    """

    mesh: Mesh
    material: Material
    names: tuple[str, ...]


def load_mesh(path: str | os.PathLike[str], **options: Any) -> LoadedMesh:
    """A triangle mesh from OBJ (with .mtl), PLY, STL, glTF, GLB or OFF.

    Several objects in a file become one mesh, in the file's world coordinates. Normals
    are those of the file; where it has none, they are computed, and vertices that STL
    or OBJ hold several times are one.

    Materials of an .mtl are read by [`read_mtl`][]; one that is missing is the default
    [`Material`][], with a warning, and still a material of its own. Of glTF's, which
    are of another model, base colour (as diffuse and ambient) and emission are taken,
    and the highlight is left to the fit. Textures are not read.

    **Arguments:**

    - `path`: the suffix tells the format.
    - `options`: of [`Mesh`][], such as `two_sided` or `crease_angle`, with which the
        file's normals are not used.

    **Returns:** `(mesh, material, names)`: see [`LoadedMesh`][].

    **Raises:** `ValueError` that names the file: it is missing, broken, of an unknown
    format, or holds no triangles.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise ValueError(f"{path}: its suffix is none of {', '.join(FORMATS)}")
    library: dict[str, Material] = {}
    if suffix == ".obj":
        text = read_text(path, MAX_BYTES)
        library = _library(path, text)
        # trimesh gets a library that has nothing but names: textures stay closed.
        names = "".join(f"newmtl {name}\nKd 1 1 1\n" for name in library)
        scene = _parse(
            path, f"mtllib names\n{text}".encode(), {"names": names.encode()}
        )
    else:
        scene = _parse(path, read_bytes(path, MAX_BYTES), _Folder(path.parent))
    with naming(str(path)):
        return _join(_parts(scene), library, suffix in (".stl", ".obj"), options)


class _Folder:
    """Files that a glTF file names, from its own folder only."""

    def __init__(self, folder: Path):
        self.folder = folder

    def __getitem__(self, name: str) -> bytes:
        return read_bytes(inside(self.folder, name), MAX_BYTES)


def _parse(path: Path, content: bytes, resolver: Any) -> trimesh.Scene:
    try:
        with warnings.catch_warnings():
            # How trimesh parses is not for its callers to hear.
            warnings.simplefilter("ignore")
            return trimesh.load_scene(
                io.BytesIO(content),
                file_type=path.suffix.lower()[1:],
                resolver=resolver,
                process=False,
            )
    except Exception as error:
        # Each of trimesh's readers fails in ways of its own.
        raise ValueError(f"{path}: cannot be read: {error}") from error


def _library(path: Path, text: str) -> dict[str, Material]:
    """The materials that an OBJ file uses, in the order in which it does."""
    found: dict[str, Material] = {}
    used: dict[str, None] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        key, _, rest = line.partition(" ")
        if key == "usemtl":
            used.setdefault(" ".join(rest.split()))
        elif key == "mtllib":
            with naming(f"{path}: line {number}"):
                file = inside(path.parent, rest.strip())
            if file.is_file():
                found |= read_mtl(file)
            else:
                _warn(f"{path}: line {number}: {rest.strip()} is missing")
    for name in used:
        if name not in found:
            _warn(f"{path}: no .mtl has its material {name!r}, a default one is taken")
    return {name: found.get(name, Material()) for name in used}


def _warn(message: str) -> None:
    warnings.warn(message, stacklevel=4)


class _Part(NamedTuple):
    """One object of a file, in world coordinates."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    material: Any


def _parts(scene: trimesh.Scene) -> list[_Part]:
    parts = []
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        # Files may hold points and curves as well.
        if len(getattr(mesh, "faces", ())) > 0:
            parts.append(_part(mesh, np.asarray(transform)))
    return parts


def _part(mesh: Any, transform: np.ndarray) -> _Part:
    linear, shift = transform[:3, :3], transform[:3, 3]
    vertices = np.asarray(mesh.vertices) @ linear.T + shift
    faces, normals = np.asarray(mesh.faces), None
    if np.linalg.det(linear) < 0:
        # A mirror turns the order of the corners.
        faces = faces[:, ::-1]
    # There is no other way to tell normals of the file from computed ones.
    if "vertex_normals" in mesh._cache:
        normals = np.asarray(mesh.vertex_normals) @ np.linalg.inv(linear)
    return _Part(vertices, faces, normals, getattr(mesh.visual, "material", None))


def _join(
    parts: list[_Part],
    library: dict[str, Material],
    repeats: bool,
    options: dict[str, Any],
) -> LoadedMesh:
    """All parts as one mesh; where the format `repeats` vertices, each comes once."""
    if not parts:
        raise ValueError("it holds no triangles")
    # Objects share a material where trimesh gives them the same one, or the same name.
    names = _names([part.material for part in parts])
    order = [name for name in library if name in names]
    order += [name for name in dict.fromkeys(names) if name not in library]
    first = {name: parts[names.index(name)].material for name in order}
    materials = [
        library[name] if name in library else _from_gltf(first[name]) for name in order
    ]
    starts = np.cumsum([0] + [len(part.vertices) for part in parts])
    faces = np.concatenate(
        [part.faces + start for part, start in zip(parts, starts[:-1], strict=True)]
    )
    vertices = np.concatenate([part.vertices for part in parts])
    index = None
    if len(order) > 1:
        counts = [len(part.faces) for part in parts]
        index = np.repeat([order.index(name) for name in names], counts)
    normals = [part.normals for part in parts if part.normals is not None]
    given = len(normals) == len(parts) and options.get("crease_angle") is None
    if repeats and not given:
        vertices, place = np.unique(vertices, axis=0, return_inverse=True)
        faces = place.ravel()[faces]
    mesh = Mesh(
        vertices,
        faces,
        np.concatenate(normals) if given else None,
        index,
        **options,
    )
    material = stack_materials(materials) if len(order) > 1 else materials[0]
    return LoadedMesh(mesh, material, tuple(order))


def _names(materials: list[Any]) -> list[str]:
    """A name for each, the same for the same material only."""
    names: dict[int, str] = {}
    for material in materials:
        name = getattr(material, "name", None) or UNNAMED
        taken = names.values()
        if id(material) not in names and name in taken and material is not None:
            name = next(n for i in range(2, 10**6) if (n := f"{name}-{i}") not in taken)
        names.setdefault(id(material), name)
    return [names[id(material)] for material in materials]


def _from_gltf(material: Any) -> Material:
    """A material with glTF's base colour and emission, if it has any."""
    base = getattr(material, "baseColorFactor", None)
    glow = getattr(material, "emissiveFactor", None)
    leaves = {}
    if base is not None:
        leaves |= {"diffuse": _rgb(base), "ambient": _rgb(base)}
    if glow is not None:
        leaves |= {"emission": _rgb(glow)}
    return Material(**leaves)


def _rgb(color: Any) -> np.ndarray:
    array = np.asarray(color)
    return array[:3] / 255 if array.dtype.kind in "ui" else array[:3]
