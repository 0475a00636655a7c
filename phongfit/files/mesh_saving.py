"""Write meshes with their materials and textures to files that `load_mesh` reads.

Textures have 16 bits: colours sRGB-encoded, exponents and normals linear. Colours of
vertices are linear floats in glTF, sRGB-encoded floats in OBJ, and sRGB-encoded 8-bit
numbers in PLY.
"""

import dataclasses
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from phongfit.edge import checked
from phongfit.files.formats import encode_png
from phongfit.files.gltf import (
    COLOURS as ATTRIBUTES,
    Part,
    Picture,
    pbr_material,
    roughness,
    specular_colour,
    write_gltf,
)
from phongfit.files.images import to_levels
from phongfit.files.limits import exponent, limited, lost
from phongfit.files.mtl import COLOURS, mtl_block
from phongfit.files.outputs import replacing
from phongfit.files.usd import COLOUR, SUFFIXES, write_usd
from phongfit.geometry.meshes import Mesh
from phongfit.material import Material, unstack_materials
from phongfit.rendering.film import encode
from phongfit.textures import AbstractTexture, Texture, Textures, VertexColours

FORMATS = {
    **{".obj": "obj", ".ply": "ply", ".stl": "stl", ".glb": "gltf", ".gltf": "gltf"},
    **dict.fromkeys(SUFFIXES, "usd"),
}

MTL_MAPS = {leaf: f"map_{key}" for key, leaf in COLOURS.items()} | {
    "shininess": "map_Ns",
    "normal": "norm",
}


class _Own(NamedTuple):
    """One material of a mesh, with its faces.

    - `bits`: of pictures of its textures.
    - `opacity`: of the texels of ρ_d; `None` if all are opaque.
    """

    name: str
    material: Material
    textures: Textures
    faces: np.ndarray
    bits: int = 16
    opacity: np.ndarray | None = None

    def png(self, name: str, values: Any = None) -> bytes:
        """A picture of a texture.

        **Arguments:** `values`: from 0 to 1; default those of the texture, scaled.
        """
        if values is None:
            texture = getattr(self.textures, name)
            values = _scaled(texture)
            if name == "normal":
                values = (np.asarray(texture.values, float) + 1) / 2
        encoding = "linear" if name in ("normal", "shininess") else "srgb"
        colours = np.broadcast_to(values, (*values.shape[:2], 3))
        levels = to_levels(colours, encoding, self.bits)
        if self.opacity is not None and name == "diffuse":
            opacity = to_levels(self.opacity, "linear", self.bits)
            levels = np.concatenate([levels, opacity], axis=-1)
        return encode_png(levels)


@checked
def save_mesh(
    path: str | os.PathLike[str],
    mesh: Mesh,
    material: Material,
    names: Sequence[str] | None = None,
    *,
    nearest: bool = False,
) -> None:
    """Write a mesh, its materials and its textures: the inverse of [`load_mesh`][].

    Materials are those of the un-normalised Blinn-Phong model. [`load_mesh`][] reads
    them unchanged, up to the rounding of 16-bit textures. Formats differ:

    - glTF has no ambient reflectance: its textures are left out, and its values are in
        `extras`. Parameters at vertices are all written: `COLOR_0`, which other
        programs show, and custom attributes.
    - OBJ has colours of vertices, which multiply both ρ_d and ρ_a.
    - PLY has only colours of vertices, which are ρ_d.
    - STL has only triangles.
    - USD is for other programs: [`load_mesh`][] does not read it.

    **Arguments:**

    - `path`: `.obj`, with an `.mtl` and the textures beside it, `.glb`, `.gltf`, `.ply`
        or `.stl`; with `pip install 'phongfit[usd]'` also `.usda`, `.usd`, `.usdc`,
        with textures beside them, or `.usdz`.
    - `material`: of all faces, or with a row for each of the mesh's materials. Textures
        of the mesh multiply it.
    - `names`: of the materials; default `material0`, `material1`, …
    - `nearest`: replace values that the format cannot hold by the nearest, with a
        warning.

    **Raises:** `ValueError` that names the argument, or the part that the format cannot
    hold; `OSError` that names the file.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise ValueError(
            f"{path}: expected .obj, .glb, .gltf, .ply, .stl or .usda, got {suffix!r}"
        )
    if suffix == ".stl":
        lost("material: STL has triangles alone", nearest)
    write_mesh(path, FORMATS[suffix], mesh, material, names, nearest=nearest)


def write_mesh(
    path: Path,
    to: str,
    mesh: Mesh,
    material: Material,
    names: Sequence[str] | None = None,
    *,
    nearest: bool,
    bits: int = 16,
    opacity: Float[np.ndarray, "rows columns 1"] | None = None,
) -> None:
    """Write a mesh as [`save_mesh`][] does, in a format that is independent of `path`.

    **Arguments:**

    - `to`: `"obj"`, `"ply"`, `"stl"`, `"gltf"` or `"usd"`.
    - `bits`: of the textures.
    - `opacity`: for glTF, of the texels of ρ_d: 0 where a viewer shows nothing.
    """
    own = [
        one._replace(bits=bits, opacity=opacity)
        for one in _apart(mesh, material, names)
    ]
    if to == "obj":
        _write_obj(path, mesh, own, nearest)
    elif to == "ply":
        _write_ply(path, mesh, own, nearest)
    elif to == "stl":
        _write_triangles(path, "stl", mesh.vertices, mesh.faces)
    else:
        parts = [(_part(mesh, one), _gltf_material(one, nearest)) for one in own]
        if to == "usd":
            write_usd(path, parts, nearest=nearest)
        else:
            write_gltf(path, parts)


def _apart(mesh: Mesh, material: Material, names: Sequence[str] | None) -> list[_Own]:
    count = mesh.materials
    names = [f"material{k}" for k in range(count)] if names is None else list(names)
    if len(names) != count or len(set(names)) < count:
        raise ValueError(f"names: expected {count}, each once, got {names}")
    of = np.zeros(len(mesh.faces), int)
    if mesh.material_index is not None:
        of = np.asarray(mesh.material_index)
    textures = mesh.textures or (Textures(),)
    each = zip(names, unstack_materials(material, count), strict=True)
    return [
        _Own(name, one, textures[min(k, len(textures) - 1)], np.flatnonzero(of == k))
        for k, (name, one) in enumerate(each)
        if (of == k).any()
    ]


def _factor(texture: AbstractTexture) -> float:
    """The largest value of a texture."""
    return max(float(np.max(texture.values)), 1e-12)


def _scaled(texture: AbstractTexture) -> np.ndarray:
    """Values of a texture, scaled to a largest value of 1."""
    return np.asarray(texture.values, float) / _factor(texture)


def _multiplied(own: _Own, names: Iterable[str]) -> Material:
    """The material, multiplied by the factors of some of its textures."""
    leaves = _leaves(own.material)
    for name in names:
        texture = getattr(own.textures, name)
        if texture is not None:
            leaves[name] = leaves[name] * _factor(texture)
    return Material(**leaves)


def _leaves(material: Material) -> dict[str, np.ndarray]:
    """The parameters of one material, of shape () or (3,)."""
    leaves = vars(material).items()
    return {name: np.asarray(leaf, float).squeeze() for name, leaf in leaves}


def _flattened(own: _Own, nearest: bool) -> _Own:
    """A material with colours at vertices for ρ_d and ρ_a only, as OBJ and PLY have."""
    at = own.textures.at_vertices
    diffuse, ambient = at.get("diffuse"), own.textures.ambient
    alike = diffuse is not None and "ambient" in at
    alike = alike and np.array_equal(_rows(at["ambient"]), _rows(at["diffuse"]))
    if diffuse is not None and ambient is None and np.any(own.material.ambient):
        lost("ambient: colours of vertices multiply it, too", nearest)
    leaves, none = _leaves(own.material), {}
    for name, colours in at.items():
        if name == "diffuse" or (name == "ambient" and alike):
            continue
        lost(f"{name}: the format has no colours of vertices for it", nearest)
        mean = np.asarray(colours.values, float).mean(axis=0)
        leaves[name] = leaves[name] * mean.squeeze()
        none[name] = None
    textures = dataclasses.replace(own.textures, **none)
    return own._replace(material=Material(**leaves), textures=textures)


def _rows(colours: VertexColours) -> np.ndarray:
    """Colours of vertices, (V, 3), scaled to a largest value of 1."""
    values = _scaled(colours)
    return np.broadcast_to(values, (len(values), 3))


def _write_obj(path: Path, mesh: Mesh, own: list[_Own], nearest: bool) -> None:
    _check_name(path)
    own = [_flattened(one, nearest) for one in own]
    with replacing(path) as temporary:
        _write_library(temporary.with_suffix(".mtl"), own, nearest)
        text = _obj_text(mesh, own, f"{path.stem}.mtl")
        temporary.write_text(text, encoding="utf-8")


def write_textured_mtl(
    path: Path, name: str, material: Material, textures: Textures, *, nearest: bool
) -> None:
    """Write an `.mtl` of one material, with textures of 8 bits beside it.

    **Raises:** `ValueError` that names the parameter, `OSError` that names `path`.
    """
    _check_name(path)
    own = _Own(name, material, textures, np.zeros(0, int), bits=8)
    with replacing(path) as temporary:
        _write_library(temporary, [own], nearest)


def _check_name(path: Path) -> None:
    if any(blank in path.stem for blank in " \t#"):
        raise ValueError(f"{path}: expected a name without blanks, for the textures")


def _write_library(path: Path, own: list[_Own], nearest: bool) -> None:
    """Write an `.mtl`, and the textures of its materials beside it."""
    text = ["# Textures multiply the numbers; those of colours are sRGB-encoded."]
    for number, one in enumerate(own):
        names = [n for n in MTL_MAPS if getattr(one.textures, n) is not None]
        material = _multiplied(one, [name for name in names if name != "normal"])
        text.append(mtl_block(one.name, material, nearest).rstrip("\n"))
        for name in names:
            texture = getattr(one.textures, name)
            if not isinstance(texture, Texture):
                continue
            key = MTL_MAPS[name].removeprefix("map_")
            file = f"{path.stem}{f'_{number}' * (len(own) > 1)}_{key}.png"
            (path.parent / file).write_bytes(one.png(name))
            clamp = "-clamp on " if texture.wrap == "clamp" else ""
            text.append(f"{MTL_MAPS[name]} {clamp}{file}")
        text.append("")
    path.write_text("\n".join(text), encoding="utf-8")


def _obj_text(mesh: Mesh, own: list[_Own], library: str) -> str:
    text = [f"mtllib {library}"]
    points, normals = np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals())
    faces = np.asarray(mesh.faces)
    corners = [faces, faces]
    if any("diffuse" in one.textures.at_vertices for one in own):
        # A vertex has one colour, so each material gets separate vertices.
        whole = _coloured(mesh, own, [1] * len(own))
        colours = encode(whole.colours[COLOUR], "srgb")
        points, normals = np.column_stack([whole.positions, colours]), whole.normals
        corners = [whole.faces, whole.faces]
    text += _lines(" ".join(["v", *["%.9g"] * points.shape[1]]), points)
    text += _lines("vn %.9g %.9g %.9g", normals)
    if mesh.uv is not None:
        uv, places = _indexed_uv(mesh)
        # In OBJ v points up.
        text += _lines("vt %.9g %.9g", uv * [1, -1] + [0, 1])
        corners.insert(1, places)
    form = "f " + " ".join([("%d//%d", "%d/%d/%d")[len(corners) - 2]] * 3)
    rows = np.stack(corners, axis=-1).reshape(len(faces), -1) + 1
    for one in own:
        text += [f"usemtl {one.name}", *_lines(form, rows[one.faces])]
    return "\n".join([*text, ""])


def _lines(form: str, rows: Any) -> list[str]:
    """Rows of numbers as lines of text, by a % format."""
    return [form % tuple(row) for row in np.asarray(rows).tolist()]


def _indexed_uv(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Rows of uv, and the row of each corner: of its vertex if this has only one uv."""
    faces, uv = np.asarray(mesh.faces), np.asarray(mesh.uv, float)
    rows = np.zeros((len(mesh.vertices), 2))
    rows[faces] = uv
    if np.array_equal(rows[faces], uv):
        return rows, faces
    return uv.reshape(-1, 2), np.arange(faces.size).reshape(faces.shape)


def _write_ply(path: Path, mesh: Mesh, own: list[_Own], nearest: bool) -> None:
    """Write a PLY with ρ_d as colours of vertices, the only material in this format."""
    own, diffuse = [_flattened(one, nearest) for one in own], []
    for one in own:
        leaves = _leaves(_multiplied(one, one.textures.at_vertices))
        for name in ("specular", "emission"):
            if leaves[name].any():
                lost(f"{name}: PLY has colours of vertices alone, of ρ_d", nearest)
        if np.any(leaves["ambient"] != leaves["diffuse"]):
            lost("ambient: colours of a PLY's vertices are read as it, too", nearest)
        for name, texture in vars(one.textures).items():
            if isinstance(texture, Texture):
                lost(f"{name}: PLY has no place for a texture", nearest)
        diffuse.append(limited("diffuse", leaves["diffuse"], 1, "PLY", nearest))
    whole = _coloured(mesh, own, diffuse)
    levels = to_levels(whole.colours[COLOUR], "srgb", 8)
    more = {"vertex_normals": whole.normals, "vertex_colors": levels}
    _write_triangles(path, "ply", whole.positions, whole.faces, **more)


def _write_triangles(
    path: Path, kind: str, vertices: Any, faces: Any, **more: Any
) -> None:
    """Write a binary `.ply` or `.stl`."""
    # Imported here, since trimesh takes long to import.
    import trimesh

    vertices, faces = np.asarray(vertices, float), np.asarray(faces)
    mesh = trimesh.Trimesh(vertices, faces, process=False, **more)
    options: dict[str, Any] = {"vertex_normal": True} if kind == "ply" else {}
    content: Any = mesh.export(file_type=kind, **options)
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def _coloured(mesh: Mesh, own: list[_Own], factors: Iterable[Any]) -> Part:
    """All faces, with separate vertices for each material: a vertex has one colour.

    **Arguments:** `factors`: of the colours of each material's vertices.
    """
    parts = [_part(mesh, one, with_uv=False) for one in own]
    starts = np.cumsum([0] + [len(part.positions) for part in parts])
    faces = np.zeros(mesh.faces.shape, int)
    colours = []
    for one, part, start, factor in zip(own, parts, starts, factors, strict=False):
        faces[one.faces] = part.faces + start
        own_colours = part.colours.get(COLOUR, np.ones_like(part.positions))
        colours.append(factor * own_colours)
    positions = np.concatenate([part.positions for part in parts])
    normals = np.concatenate([np.asarray(part.normals) for part in parts])
    return Part(positions, faces, normals, None, {COLOUR: np.concatenate(colours)})


def _part(mesh: Mesh, own: _Own, with_uv: bool = True) -> Part:
    """One material's faces, with vertices repeated for each of their uv."""
    place = vertex = np.asarray(mesh.faces)[own.faces].ravel()
    uv = None
    if mesh.uv is not None and with_uv:
        rows, places = _indexed_uv(mesh)
        place = places[own.faces].ravel()
        uv = rows[place]
        if len(rows) != len(mesh.vertices):
            pairs = np.column_stack([vertex, uv])
            place = np.unique(pairs, axis=0, return_inverse=True)[1].ravel()
    _, first, faces = np.unique(place, return_index=True, return_inverse=True)
    at, used = own.textures.at_vertices, vertex[first]
    return Part(
        np.asarray(mesh.vertices, float)[used],
        faces.reshape(-1, 3),
        np.asarray(mesh.vertex_normals(), float)[used],
        None if uv is None else uv[first],
        {
            name: _rows(at[leaf])[used]
            for name, leaf in ATTRIBUTES.items()
            if leaf in at
        },
    )


def _gltf_material(own: _Own, nearest: bool) -> dict[str, Any]:
    at = own.textures.at_vertices
    scaled = dict.fromkeys(("diffuse", "emission", "shininess", *at))
    material = _multiplied(own, scaled)
    textures = dataclasses.replace(own.textures, **dict.fromkeys(at))
    own = own._replace(textures=textures)
    made = pbr_material(own.name, material, nearest)
    pbr = made["pbrMetallicRoughness"]

    def picture(name: str, values: Any = None) -> Picture:
        of = getattr(textures, name)
        png = own.png(name, values)
        return Picture(png, of.filter == "nearest", of.wrap == "repeat")

    if textures.diffuse is not None:
        pbr["baseColorTexture"] = picture("diffuse")
        made |= {} if own.opacity is None else {"alphaMode": "MASK"}
    if textures.emission is not None:
        made["emissiveTexture"] = picture("emission")
    if textures.normal is not None:
        made["normalTexture"] = picture("normal")
    if textures.ambient is not None and textures.ambient is not textures.diffuse:
        lost("ambient: glTF has no texture of it", nearest)
    f: Any = exponent(material, np.inf, "glTF", nearest)
    if textures.shininess is not None:
        f = f * _scaled(textures.shininess)
        # Roughness is green; red is unused; blue is metallic.
        pbr["metallicRoughnessTexture"] = picture("shininess", roughness(f) * [0, 1, 0])
        pbr["roughnessFactor"] = 1.0
        if textures.specular is None:
            # glTF's specular colour depends on f, so it varies with the exponent.
            same = textures.shininess.of_ones()
            textures = dataclasses.replace(textures, specular=same)
    if textures.specular is not None:
        values = np.asarray(textures.specular.values, float)
        values = values * np.asarray(own.material.specular, float)
        if np.ndim(f) and f.shape[:2] != values.shape[:2]:
            lost("specular: glTF needs its texture as large as the exponent's", nearest)
            f = np.exp(np.log(np.maximum(f, 1e-6)).mean())
        tint = specular_colour(values * np.ones(3), f)
        factor = np.maximum(tint.reshape(-1, 3).max(axis=0), 1e-12)
        made["extensions"]["KHR_materials_specular"] = {
            "specularColorFactor": factor,
            "specularColorTexture": picture("specular", tint / factor),
        }
    return made
