"""Parts of a mesh as read from a file, and their union in one mesh.

In files v points up, except in glTF; here it points down.
"""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from phongfit.files.inputs import Note
from phongfit.files.mtl_textures import Shaded
from phongfit.geometry.meshes import Mesh
from phongfit.material import Material, stack_materials
from phongfit.rendering.film import decode
from phongfit.textures import Textures, VertexColours

UNNAMED = "default"


class LoadedMesh(NamedTuple):
    """Contents of a file: `mesh`, its M materials in one `material`, and their `names`.

    If M > 1, the mesh's `material_index` refers to this order. Textures are stored in
    the mesh, and multiply the parameters of the materials.
    """

    mesh: Mesh
    material: Material
    names: tuple[str, ...]


class MeshPart(NamedTuple):
    """Triangles of one named material, in world coordinates.

    - `normals`: of the vertices; 0 where the file has none.
    - `uv`: of each corner of the faces.
    - `colours`: rows for the vertices, (V, 3), by the parameter that they multiply.
    - `groups`: smoothing groups of the vertices: vertices of equal place and group are
        merged. `None` if no vertices are merged.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    name: str
    shaded: Shaded
    normals: Float[np.ndarray, "vertices 3"] | None = None
    uv: Float[np.ndarray, "faces 3 2"] | None = None
    colours: dict[str, np.ndarray] = {}  # noqa: RUF012
    groups: Int[np.ndarray, " vertices"] | None = None


def white() -> Shaded:
    """A material with ρ_d = ρ_a = 1: texture or colours are then the reflectances."""
    return Shaded(Material(diffuse=1.0, ambient=1.0))


def uv_from_below(uv: Float[np.ndarray, "*corners 2"]) -> Float[np.ndarray, "..."]:
    """uv converted from files where v points up; 0 in place of non-finite values."""
    return np.where(np.isfinite(uv), uv, 0) * [1, -1] + [0, 1]


def linear_colours(
    colours: Float[np.ndarray, "rows 3"], note: Note
) -> dict[str, np.ndarray]:
    """Linear colours from sRGB-encoded ones, by the parameters that they multiply."""
    if not ((colours >= 0) & (colours <= 1)).all():
        got = f"{colours.min():g} to {colours.max():g}"
        note(f"its colours are not used: expected 0 to 1, got {got}")
        return {}
    light = decode(colours, "srgb")
    return {"diffuse": light, "ambient": light}


def with_colours(part: MeshPart, colours: dict[str, np.ndarray]) -> MeshPart:
    """A part whose reflectances are the colours of its vertices, if there are any."""
    return part._replace(shaded=white(), colours=colours) if colours else part


def with_face_colours(part: MeshPart, colours: dict[str, np.ndarray]) -> MeshPart:
    """A part with a colour for each triangle, whose corners become vertices."""
    each = {name: np.repeat(rows, 3, axis=0) for name, rows in colours.items()}
    return with_colours(apart(part), each) if colours else part


def apart(part: MeshPart) -> MeshPart:
    """A part in which each corner of a triangle is a vertex."""
    corners = part.faces.ravel()
    return part._replace(
        vertices=part.vertices[corners],
        faces=np.arange(len(corners)).reshape(-1, 3),
        normals=None if part.normals is None else part.normals[corners],
        colours={name: rows[corners] for name, rows in part.colours.items()},
        groups=np.zeros(len(corners), int),
    )


def join_parts(parts: list[MeshPart], options: dict[str, Any]) -> LoadedMesh:
    """All parts of a file as one mesh.

    **Arguments:** `options`: of [`Mesh`][].

    **Raises:** `ValueError` if there are no parts, or [`Mesh`][] refuses them.
    """
    if not parts:
        raise ValueError("it holds no triangles")
    shades = {part.name: part.shaded for part in parts}
    place = {name: k for k, name in enumerate(shades)}
    starts = np.cumsum([0] + [len(part.vertices) for part in parts])
    faces = np.concatenate(
        [part.faces + start for part, start in zip(parts, starts[:-1], strict=True)]
    )
    index = None
    if len(place) > 1:
        counts = [len(part.faces) for part in parts]
        index = np.repeat([place[part.name] for part in parts], counts)
    uv = None
    if any(part.uv is not None for part in parts):
        none = [np.zeros((*part.faces.shape, 2)) for part in parts]
        each = zip(parts, none, strict=True)
        uv = np.concatenate([k if part.uv is None else part.uv for part, k in each])
    vertices = _joined(parts, faces, options)
    textures = _textures(parts, shades, vertices.colours)
    textured = any(vars(one)[k] is not None for one in textures for k in vars(one))
    mesh = Mesh(
        vertices.places,
        vertices.at[faces],
        vertices.normals,
        index,
        uv=uv,
        textures=textures if textured else None,
        **options,
    )
    materials = [shaded.material for shaded in shades.values()]
    material = stack_materials(materials) if len(place) > 1 else materials[0]
    return LoadedMesh(mesh, material, tuple(place))


class _Vertices(NamedTuple):
    """Vertices of the mesh, and the index `at` in it of each of the parts' vertices."""

    places: np.ndarray
    at: np.ndarray
    normals: np.ndarray | None
    colours: dict[str, np.ndarray]


def _joined(
    parts: list[MeshPart], faces: np.ndarray, options: dict[str, Any]
) -> _Vertices:
    """The vertices of all parts; those of equal place and group are merged."""
    places = np.concatenate([part.vertices for part in parts])
    zero = np.zeros_like
    normals = np.concatenate(
        [zero(k.vertices) if k.normals is None else k.normals for k in parts]
    )
    colours = _colours(parts)
    groups = [part.groups for part in parts if part.groups is not None]
    # crease_angle replaces the file's normals and groups.
    smooth = options.get("crease_angle") is None
    known = np.any(normals, axis=1) & smooth
    first = at = own = np.arange(len(places))
    if groups and not known.all():
        labels = np.concatenate(groups) * smooth
        first, at = _unique(np.column_stack([places, labels]))

    def computed() -> np.ndarray:
        weighting = options.get("weighting", "area")
        whole = Mesh(places[first], at[faces], weighting=weighting)
        return np.asarray(whole.vertex_normals())[at]

    if known.any():
        if not known.all():
            normals = np.where(known[:, None], normals, computed())
        return _Vertices(places, own, normals, colours)
    kept, rows = own, own
    if groups:
        kept, rows = _unique(np.column_stack([at, *colours.values()]))
    # A vertex split by colours keeps its smooth normal.
    split = smooth and len(kept) > len(first)
    taken = {name: values[kept] for name, values in colours.items()}
    return _Vertices(places[kept], rows, computed()[kept] if split else None, taken)


def _unique(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the first occurrences of unique rows, and the index for each row."""
    _, first, at = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    return first, at.ravel()


def _colours(parts: list[MeshPart]) -> dict[str, np.ndarray]:
    """Rows for the vertices of all parts; 1 where a part has none."""
    names = dict.fromkeys(name for part in parts for name in part.colours)
    return {
        name: np.concatenate(
            [part.colours.get(name, np.ones((len(part.vertices), 3))) for part in parts]
        )
        for name in names
    }


def _textures(
    parts: list[MeshPart], shades: dict[str, Shaded], colours: dict[str, np.ndarray]
) -> list[Textures]:
    """Textures of each material, including the colours of its parts' vertices."""
    rows = {
        name: VertexColours(values[:, :1] if name == "shininess" else values)
        for name, values in colours.items()
    }
    own: dict[str, dict[str, Any]] = {name: {} for name in shades}
    for part in parts:
        given = shades[part.name].textures
        own[part.name] |= {k: rows[k] for k in part.colours if vars(given)[k] is None}
    return [
        dataclasses.replace(shades[name].textures, **more) for name, more in own.items()
    ]
