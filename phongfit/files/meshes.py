"""Meshes on disk, through trimesh, with the materials that their files name.

OBJ and PLY count v upwards; here, and in glTF, it runs down. Colours of vertices are
linear in glTF, by its specification; those of OBJ and PLY, which do not say, are taken
to be sRGB-encoded, as most programs write them.
"""

import dataclasses
import io
import logging
import os
import re
import struct
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh

from phongfit.codes import warn
from phongfit.edge import checked
from phongfit.files.budget import afford
from phongfit.files.gltf_materials import GltfShade
from phongfit.files.gltf_reading import GltfPart, read_gltf
from phongfit.files.images import read_texels
from phongfit.files.inputs import inside, naming, read_bytes, read_text, reason
from phongfit.files.mtl import FEW, MOST
from phongfit.files.mtl_textures import Note, Shaded, read_textured
from phongfit.geometry.meshes import Mesh
from phongfit.material import Material, stack_materials
from phongfit.rendering.film import decode
from phongfit.textures import Texture, Textures, VertexColours

# What trimesh minds and bears is for whoever asks for logs, not for the terminal.
logging.getLogger("trimesh").addHandler(logging.NullHandler())

TAKEN_APART = {".obj": 12, ".ply": 18, ".stl": 12, ".off": 12}
"""Memory that trimesh and the joining take, in files of that size: as measured."""

FORMATS = (".obj", ".ply", ".stl", ".gltf", ".glb", ".off")
UNNAMED = "default"

MOST_NOTES = 20
"""Warnings of what a file holds and is not used."""

OBJ_READ = ("", "v", "vt", "vn", "f", "o", "g", "s", "usemtl", "mtllib")
PLY_READ = [
    *(b"x", b"y", b"z", b"nx", b"ny", b"nz"),
    *(b"texture_u", b"texture_v", b"u", b"v", b"s", b"t"),
    *(b"red", b"green", b"blue", b"alpha"),
]
HIGHEST = {
    **dict.fromkeys((b"uchar", b"uint8"), 255.0),
    **dict.fromkeys((b"ushort", b"uint16"), 65535.0),
    **dict.fromkeys((b"float", b"float32", b"double", b"float64"), 1.0),
}
"""What is white, by a PLY's type."""

OBJ_COLOURS = re.compile(r"(?m)^v(?:[ \t]+[^\s#]+){6}")


class LoadedMesh(NamedTuple):
    """What a file holds: `mesh`, its M materials in one `material`, and their `names`.

    Where M > 1, the mesh's `material_index` counts them in this order. Textures are the
    mesh's own, and multiply the numbers of the materials.
    """

    mesh: Mesh
    material: Material
    names: tuple[str, ...]


@checked
def load_mesh(path: str | os.PathLike[str], **options: Any) -> LoadedMesh:
    """A triangle mesh from OBJ (with .mtl), PLY, STL, glTF, GLB or OFF.

    Several objects in a file become one mesh, in the file's world coordinates. Normals
    are those of the file; where it has none, they are computed, and vertices that STL
    or OBJ hold several times are one.

    Materials of an .mtl are read as by [`read_mtl`][]; one that is missing is the
    default [`Material`][], with a warning, and still a material of its own. Of glTF's,
    which are of another model (metallic-roughness, specular-glossiness), the nearest of
    Phong's is taken: see `phongfit.files.gltf_materials`. A material that phongfit
    wrote is what it was. glTF's faces are flat where the file has no normals.

    Textures of colours (map_Ka, map_Kd, map_Ks, map_Ke; glTF's base colour, specular
    and emission; the TextureFile of a PLY), of the exponent (map_Ns, map_Pr; glTF's
    roughness), normal maps and colours of vertices become the mesh's `textures`;
    `mesh.with_textures(None)` is the mesh without. Colours of vertices multiply ρ_d and
    ρ_a, where there is no texture of these; of a PLY, and of an OBJ without materials,
    they are these. They are sRGB-encoded in OBJ and PLY, and linear in glTF. What a
    file has besides that is not used (more uv, skins, other maps, transparency, unknown
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
    order: list[str] = []
    if suffix == ".obj":
        parts, order = _read_obj(path, note)
    elif suffix in (".gltf", ".glb"):
        with naming(str(path)):
            say = lambda words: note(f"{path}: {words}")  # noqa: E731
            parts = _named(*read_gltf(path, say))
    else:
        content = read_bytes(path)
        scene = _parse(path, _whole(path, content))
        parts = _parts(scene, Shaded())
        if suffix == ".ply":
            head, _, _ = content.partition(b"end_header")
            parts = _with_colours(path, head, scene, parts, note)
            parts = _with_picture(path, head, parts, note)
    with naming(str(path)):
        repeats = suffix in (".stl", ".obj", ".gltf", ".glb")
        return _join(parts, order, repeats, options, note)


def _white() -> Material:
    """Of what a texture or colours are the reflectances themselves."""
    return Material(diffuse=1.0, ambient=1.0)


def _read_obj(path: Path, note: Note) -> tuple[list["_Part"], list[str]]:
    """Its parts, and names of materials in the order in which it uses them."""
    text = read_text(path, None)
    with naming(str(path)):
        afford(TAKEN_APART[".obj"] * len(text), "triangles")
        text, coloured = _take_colours(text)
    default = Shaded() if coloured is None else Shaded(_white())
    library = _library(path, text, default, note)
    # trimesh gets a library that has nothing but names: textures stay closed.
    names = "".join(f"newmtl {name}\nKd 1 1 1\n" for name in library)
    content = f"mtllib names\n{text}".encode()
    scene = _parse(path, content, {"names": names.encode()})
    parts = [
        part._replace(shaded=library.get(part.name, default))
        for part in _parts(scene, default)
    ]
    if coloured is not None:
        parts = [_put_back(path, part, coloured, note) for part in parts]
    return parts, list(library)


def _take_colours(text: str) -> tuple[str, np.ndarray | None]:
    """An OBJ's text with the numbers of its vertices in place of where they are.

    trimesh rounds colours to 8 bits, and does not say which vertex is which.

    **Returns:** besides, x, y, z and colour of each vertex; `None`, and the text as it
    is, where they have no colours.
    """
    if not OBJ_COLOURS.search(text):
        return text, None
    lines, rows = text.splitlines(), []
    for k, line in enumerate(lines):
        if line.startswith("v "):
            # Those without a colour are white.
            row = line.partition("#")[0].split()[1:7]
            rows.append(row if len(row) == 6 else [*row[:3], "1", "1", "1"])
            lines[k] = f"v {len(rows) - 1} 0 0"
    try:
        return "\n".join([*lines, ""]), np.array(rows, float)
    except ValueError:
        raise ValueError("its vertices: expected x y z r g b, all numbers") from None


def _put_back(path: Path, part: "_Part", rows: np.ndarray, note: Note) -> "_Part":
    """A part whose vertices are where they are again, with their colours."""
    own = rows[part.vertices[:, 0].astype(int)]
    part = part._replace(vertices=own[:, :3])
    if part.shaded.textures.diffuse is not None:
        note(f"{path}: its vertices' colours are not used where map_Kd is")
        return part
    return part._replace(colours=_decoded(path, own[:, 3:], note))


def _decoded(path: Path, colours: np.ndarray, note: Note) -> dict[str, np.ndarray]:
    """sRGB-encoded colours of vertices as what they multiply."""
    if not ((colours >= 0) & (colours <= 1)).all():
        low, high = colours.min(), colours.max()
        ends = f"expected 0 to 1, got {low:g} to {high:g}"
        note(f"{path}: its vertices' colours are not used: {ends}")
        return {}
    light = decode(colours, "srgb")
    return {"diffuse": light, "ambient": light}


def _with_colours(
    path: Path, head: bytes, scene: trimesh.Scene, parts: list["_Part"], note: Note
) -> list["_Part"]:
    """A PLY's parts with the colours of its vertices."""
    types = {name: kind for kind, name in _vertex_properties(head)}
    names = ("red", "green", "blue")
    highest = [HIGHEST.get(types.get(name.encode(), b"")) for name in names]
    if len(parts) != 1 or not any(name.encode() in types for name in names):
        return parts
    raw = [one.metadata.get("_ply_raw") for one in scene.geometry.values()]
    if None in highest or parts[0].uv is not None or None in raw or len(raw) != 1:
        why = "it has uv" if parts[0].uv is not None else "they are of another kind"
        note(f"{path}: its vertices' colours are not used: {why}")
        return parts
    data = raw[0]["vertex"]["data"]
    if b"alpha" in types and np.ptp(np.asarray(data["alpha"], float)) > 0:
        note(f"{path}: its vertices are partly transparent, which is not used")
    columns = [np.asarray(data[name], float).ravel() for name in names]
    rows = np.stack(columns, axis=-1) / highest
    count = len(parts[0].vertices)
    if len(rows) != count:
        why = f"expected {count}, one a vertex, got {len(rows)}"
        note(f"{path}: its vertices' colours are not used: {why}")
    elif colours := _decoded(path, rows, note):
        return [parts[0]._replace(shaded=Shaded(_white()), colours=colours)]
    return parts


def _vertex_properties(head: bytes) -> list[tuple[bytes, bytes]]:
    """Types and names of what a PLY has of its vertices."""
    vertex = re.search(rb"(?ms)^element\s+vertex.*?(?=^element|\Z)", head)
    return re.findall(rb"(?m)^property\s+(\S+)\s+(\S+)", vertex[0] if vertex else b"")


def _with_picture(
    path: Path, head: bytes, parts: list["_Part"], note: Note
) -> list["_Part"]:
    """A PLY's parts with the picture that a comment of its head names."""
    names = [name for _, name in _vertex_properties(head)]
    others = [name.decode("ascii", "replace") for name in names if name not in PLY_READ]
    if others:
        shown = ", ".join(others[:9])
        note(f"{path}: its vertices' {shown} are not used")
    named = re.findall(rb"(?mi)^comment\s+TextureFile\s+(.+?)\s*$", head)
    if not named:
        return parts
    if all(part.uv is None for part in parts):
        note(f"{path}: its TextureFile is not used, for it has no uv")
        return parts
    if len(named) > 1:
        note(f"{path}: of its {len(named)} textures only the first is used")
    with naming(str(path)):
        file = inside(path.parent, named[0].decode("utf-8", "replace"))
    if not file.is_file():
        note(f"{path}: its texture {file.name} is missing")
        return parts
    values = read_texels(read_bytes(file), file, "srgb").values
    picture = Textures(diffuse=Texture(values), ambient=Texture(values))
    return [
        part if part.uv is None else part._replace(shaded=Shaded(_white(), picture))
        for part in parts
    ]


def _whole(path: Path, content: bytes) -> bytes:
    """A PLY, STL or OFF file's bytes, if they are as many as they say, or text."""
    suffix = path.suffix.lower()
    with naming(str(path)):
        afford(TAKEN_APART[suffix] * len(content), "triangles")
    if suffix == ".ply":
        head, end, body = content.partition(b"end_header")
        if not end:
            raise ValueError(f"{path}: cannot be read: its header has no end")
        with naming(str(path)):
            _check_counts(head, len(body))
        # Pictures stay closed.
        return re.sub(rb"(?m)^comment.*$", b"comment", head) + end + body
    if suffix == ".stl" and len(content) >= 84:
        (faces,) = struct.unpack_from("<I", content, 80)
        if len(content) == 84 + 50 * faces:
            return content
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        wanted = "a binary or text file of its length" if suffix == ".stl" else "text"
        raise ValueError(
            f"{path}: is broken or truncated: expected {wanted} in UTF-8"
        ) from None
    if suffix == ".off":
        numbers = re.search(r"OFF\s+(?:#.*\s+)*(\d+)\s+(\d+)", text)
        if numbers and int(numbers[1]) + int(numbers[2]) > len(text):
            raise ValueError(f"{path}: is truncated: it says that it holds more")
    return content


def _check_counts(head: bytes, length: int) -> None:
    """Does a PLY file have as many elements as its header says?"""
    for name, count in re.findall(rb"(?m)^element\s+(\S+)\s+(\d+)", head):
        # Each takes a byte at the least.
        if int(count) > length:
            raise ValueError(
                f"element {name.decode('ascii', 'replace')}: expected {int(count)}, "
                f"got {length} bytes: it is truncated"
            )


def _parse(
    path: Path, content: bytes, files: dict[str, bytes] | None = None
) -> trimesh.Scene:
    try:
        with warnings.catch_warnings():
            # How trimesh parses is not for its callers to hear.
            warnings.simplefilter("ignore")
            return trimesh.load_scene(
                io.BytesIO(content),
                file_type=path.suffix.lower()[1:],
                resolver={} if files is None else files,
                process=False,
            )
    except MemoryError:
        raise
    except Exception as error:
        # Each of trimesh's readers fails in ways of its own.
        raise ValueError(f"{path}: cannot be read: {reason(error)}") from error


def _library(path: Path, text: str, default: Shaded, note: Note) -> dict[str, Shaded]:
    """The materials that an OBJ file uses, in the order in which it does."""
    found: dict[str, Shaded] = {}
    used: dict[str, None] = {}
    for number, line in enumerate(io.StringIO(text), start=1):
        key, _, rest = line.partition(" ")
        if key == "usemtl":
            used.setdefault(" ".join(rest.split()))
        elif key == "mtllib":
            with naming(f"{path}: line {number}"):
                file = inside(path.parent, rest.strip())
            if file.is_file():
                found |= read_textured(file, note)
            else:
                note(f"{path}: line {number}: {rest.strip()} is missing")
        elif key.strip() not in OBJ_READ and not key.startswith("#"):
            note(f"{path}: its lines of {key.strip()[:20]!r} are not used")
    if len(used) > MOST:
        raise ValueError(f"{path}: expected at most {MOST} materials, got {len(used)}")
    missing = [name for name in used if name not in found]
    for name in missing[:FEW]:
        note(f"{path}: no .mtl has its material {name!r}, a default one is taken")
    if missing[FEW:]:
        note(f"{path}: nor {len(missing) - FEW} others of its materials")
    return {name: found.get(name, default) for name in used}


class _Part(NamedTuple):
    """One object of a file, in world coordinates, of one material by its name.

    `colours` are rows for its vertices, (V, 3), by the parameter that they multiply.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    name: str
    shaded: Shaded
    uv: np.ndarray | None = None
    colours: dict[str, np.ndarray] = {}  # noqa: RUF012


def _parts(scene: trimesh.Scene, shaded: Shaded) -> list[_Part]:
    """All objects, of one material until others are known."""
    parts = []
    for node in scene.graph.nodes_geometry:
        _, name = scene.graph[node]
        mesh = scene.geometry[name]
        # Files may hold points and curves as well.
        if len(getattr(mesh, "faces", ())) > 0:
            parts.append(_part(mesh, shaded))
    return parts


def _part(mesh: Any, shaded: Shaded) -> _Part:
    normals = None
    # There is no other way to tell normals of the file from computed ones.
    if "vertex_normals" in mesh._cache:
        normals = np.asarray(mesh.vertex_normals)
    name = getattr(getattr(mesh.visual, "material", None), "name", None)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    uv = getattr(mesh.visual, "uv", None)
    if uv is not None:
        # Whatever stands in place of uv that are missing.
        uv = np.where(np.isfinite(uv), uv, 0)[:, :2] * [1, -1] + [0, 1]
    return _Part(vertices, faces, normals, name or UNNAMED, shaded, uv)


def _named(parts: list[GltfPart], shades: dict[int, GltfShade]) -> list[_Part]:
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
    bare = Shaded(), Shaded(_white())
    return [
        _Part(
            part.vertices,
            part.faces,
            part.normals,
            names[part.material],
            bare[bool(part.colours)]
            if part.material is None
            else shades[part.material].shaded,
            part.uv,
            part.colours,
        )
        for part in parts
        if len(part.faces)
    ]


def _join(
    parts: list[_Part],
    order: list[str],
    repeats: bool,
    options: dict[str, Any],
    note: Note,
) -> LoadedMesh:
    """All parts as one mesh; where the format `repeats` vertices, each comes once."""
    if not parts:
        raise ValueError("it holds no triangles")
    found = {part.name: part.shaded for part in parts}
    names = dict.fromkeys([*(name for name in order if name in found), *found])
    place = {name: k for k, name in enumerate(names)}
    materials = [found[name].material for name in place]
    starts = np.cumsum([0] + [len(part.vertices) for part in parts])
    faces = np.concatenate(
        [part.faces + start for part, start in zip(parts, starts[:-1], strict=True)]
    )
    vertices = np.concatenate([part.vertices for part in parts])
    index = None
    if len(place) > 1:
        counts = [len(part.faces) for part in parts]
        index = np.repeat([place[part.name] for part in parts], counts)
    each = [part.normals for part in parts if part.normals is not None]
    smooth = options.get("crease_angle") is None
    normals = np.concatenate(each) if len(each) == len(parts) and smooth else None
    uv = None
    if any(part.uv is not None for part in parts):
        uv = np.concatenate([_uv_of(part) for part in parts])
    colours = _colours_of(parts)
    if repeats and normals is None:
        points, at = np.unique(vertices, axis=0, return_inverse=True)
        at = at.ravel()
        keys = np.column_stack([at, *colours.values()])
        _, first, same = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        if len(first) > len(points) and smooth:
            # Where colours end the surface goes on.
            whole = Mesh(points, at[faces], weighting=options.get("weighting", "area"))
            normals = np.asarray(whole.vertex_normals())[at[first]]
        vertices, faces = vertices[first], same.ravel()[faces]
        colours = {name: rows[first] for name, rows in colours.items()}
    textures = _with_rows(parts, place, found, colours)
    textured = any(vars(one)[k] is not None for one in textures for k in vars(one))
    mesh = Mesh(
        vertices,
        faces,
        normals,
        index,
        uv=uv,
        textures=textures if textured else None,
        **options,
    )
    material = stack_materials(materials) if len(place) > 1 else materials[0]
    return LoadedMesh(mesh, material, tuple(place))


def _colours_of(parts: list[_Part]) -> dict[str, np.ndarray]:
    """Rows for the vertices of all parts; 1 where a part has none."""
    names = dict.fromkeys(name for part in parts for name in part.colours)
    return {
        name: np.concatenate(
            [part.colours.get(name, np.ones((len(part.vertices), 3))) for part in parts]
        )
        for name in names
    }


def _with_rows(
    parts: list[_Part],
    place: dict[str, int],
    found: dict[str, Shaded],
    colours: dict[str, np.ndarray],
) -> list[Textures]:
    """Each material's textures, with the colours of the vertices of its parts."""
    rows = {
        name: VertexColours(values[:, :1] if name == "shininess" else values)
        for name, values in colours.items()
    }
    own: dict[str, dict[str, Any]] = {name: {} for name in place}
    for part in parts:
        given = found[part.name].textures
        own[part.name] |= {k: rows[k] for k in part.colours if vars(given)[k] is None}
    return [
        dataclasses.replace(found[name].textures, **more) for name, more in own.items()
    ]


def _uv_of(part: _Part) -> np.ndarray:
    """Of each corner of its faces, (F, 3, 2); 0 where the part has none."""
    if part.uv is None:
        return np.zeros((*part.faces.shape, 2))
    return part.uv[part.faces]
