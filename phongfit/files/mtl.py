"""Materials of Wavefront OBJ files: `.mtl`.

??? cite "Source"
    Alias|Wavefront, *Object files (.obj) and material library files (.mtl)*, appendix
    B1 of the Advanced Visualizer manual, 1992.
"""

import io
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from phongfit.codes import warn
from phongfit.edge import checked
from phongfit.files.inputs import inside, naming, read_text
from phongfit.files.limits import colour, exponent, limited
from phongfit.files.outputs import replacing
from phongfit.material import Material

MAX_NS = 1000.0
FORMAT = ".mtl"
MOST = 10_000
"""Materials in a file."""

MOST_UNUSED = 20
"""Warnings of keys that have no place here."""

FEW = 5
"""Warnings of one sort: more say no more."""

COLOURS = {"Ka": "ambient", "Kd": "diffuse", "Ks": "specular", "Ke": "emission"}
USUAL = {"d": 1, "Tr": 0, "Tf": 1}
"""Of what is opaque: keys that change nothing where they have this value."""
SILENT = ("", "Ni", "sharpness")
"""Of refraction, and of a reflection map: keys that change nothing by themselves."""
TEXTURES = ("map_", "bump", "disp", "decal", "refl", "norm")


class TextureLine(NamedTuple):
    """A line of a `.mtl` that names a texture."""

    number: int
    material: str | None
    key: str
    words: list[str]


class Library(NamedTuple):
    """What a `.mtl` says.

    - `materials`: the numbers of each by their keys.
    - `textures`: lines that name one.
    - `unused`: what has no place here, in words, once each.
    """

    materials: dict[str, dict[str, Any]]
    textures: list[TextureLine]
    unused: list[str]


@checked
def read_mtl(path: str | os.PathLike[str]) -> dict[str, Material]:
    """The materials of a `.mtl` file by their names, in the file's order.

    Ka, Kd, Ks, Ke and Ns are read; what a material leaves out is the default of
    [`Material`][]. With `illum 0` the colour Kd is shown as it is, and with `illum 1`
    there is no highlight. What else the file says, such as transparency, is named in a
    warning. So are textures, with a warning that says whether the file is there:
    [`load_mesh`][] reads them, with the mesh that they lie on.

    **Raises:** `ValueError` that names the file and the line.
    """
    path = Path(path)
    found, textures, unused = parse_mtl(path)
    materials = {}
    for name, fields in found.items():
        with naming(f"{path}: material {name!r}"):
            materials[name] = as_material(fields)
    for words in unused:
        warn("part-unused", f"{path}: {words}", stacklevel=2)
    for line in textures[:FEW]:
        told = f"line {line.number}: {_of_texture(path, line.material, line.words)}"
        told = f"{path}: {told}: the material has one colour"
        warn("texture-unread", told, stacklevel=2)
    if textures[FEW:]:
        told = f"{len(textures) - FEW} other textures are not read either"
        warn("texture-unread", f"{path}: {told}", stacklevel=2)
    return materials


def parse_mtl(path: Path) -> Library:
    """What a `.mtl` says.

    **Raises:** `ValueError` that names the file and the line.
    """
    found: dict[str, dict[str, Any]] = {}
    textures: list[TextureLine] = []
    unused: dict[str, str] = {}
    name = None
    for number, line in enumerate(io.StringIO(read_text(path)), start=1):
        key, *words = line.split("#", 1)[0].split() or [""]
        with naming(f"{path}: line {number}"):
            if key == "newmtl":
                if not words:
                    raise ValueError("newmtl: expected a name")
                name = " ".join(words)
                found[name] = {}
                if len(found) > MOST:
                    raise ValueError(f"expected at most {MOST} materials, got more")
            elif key in COLOURS or key in ("Ns", "illum"):
                if name is None:
                    raise ValueError(f"{key}: came before the first newmtl")
                found[name][key] = _numbers(key, words)
                if key == "illum" and found[name][key] > 2:
                    shown = " ".join(words)[:20]
                    told = f"illum {shown}, of mirrors and glass, is taken as 2"
                    unused.setdefault(key, f"line {number}: {told}")
            elif key.lower().startswith(TEXTURES):
                textures.append(TextureLine(number, name, key, words))
            elif key not in SILENT and not _is_usual(key, words):
                told = f"line {number}: {key[:20]} is not used"
                if len(unused) < MOST_UNUSED:
                    unused.setdefault(key, told)
    return Library(found, textures, list(unused.values()))


def _is_usual(key: str, words: list[str]) -> bool:
    try:
        return key in USUAL and {float(word) for word in words} == {USUAL[key]}
    except ValueError:
        return False


def _numbers(key: str, words: list[str]) -> Any:
    wanted = (1, 3) if key in COLOURS else (1,)
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) not in wanted or not np.isfinite(numbers).all() or min(numbers) < 0:
        count = "1 or 3 numbers" if key in COLOURS else "1 number"
        raise ValueError(f"{key}: expected {count} ≥ 0, got {' '.join(words)[:60]!r}")
    return numbers[0] if len(numbers) == 1 else numbers


def as_material(fields: dict[str, Any]) -> Material:
    """The material of what stands in a `.mtl`, by its keys."""
    leaves = {leaf: fields[key] for key, leaf in COLOURS.items() if key in fields}
    if "Ns" in fields:
        leaves["shininess"] = fields["Ns"]
    illumination = fields.get("illum", 2)
    if illumination < 2:
        leaves["specular"] = 0.0
    if illumination == 0:
        leaves |= {"ambient": 0.0, "diffuse": 0.0, "emission": fields.get("Kd", 0.8)}
    return Material(**leaves)


def _of_texture(path: Path, name: str | None, words: list[str]) -> str:
    # Options such as `-s 1 1 1` come before the file's name.
    file = words[-1] if words else ""
    try:
        here = inside(path.parent, file).is_file()
    except (ValueError, OSError):
        # No name of a file here, such as one that is too long.
        here = False
    return (
        f"texture {file[:60]!r} of material {name if name is None else name[:60]!r} "
        f"{'is not read' if here else 'is missing'}"
    )


@checked
def write_mtl(
    path: str | os.PathLike[str],
    materials: Mapping[str, Material],
    *,
    nearest: bool = False,
) -> None:
    """Write materials as a `.mtl` file, in one piece.

    **Arguments:**

    - `materials`: by name; several in one go through [`unstack_materials`][].
    - `nearest`: write the nearest that `.mtl` holds, with a warning, where it cannot
        hold a material: colours above 1 (but for Ke), an exponent above 1000, or one
        for each channel.

    **Raises:** `ValueError` that names the material and the leaf, unless `nearest`, and
    for a name that is empty or has line breaks; `OSError` that names the file.
    """
    blocks = [
        mtl_block(name, material, nearest) for name, material in materials.items()
    ]
    with replacing(path) as temporary:
        temporary.write_text("\n".join(blocks), encoding="utf-8")


def mtl_block(name: str, material: Material, nearest: bool) -> str:
    """The lines of one material; raises as [`write_mtl`][] does."""
    if not name or name != " ".join(name.split()) or "#" in name:
        raise ValueError(f"materials: expected a name on one line, got {name!r}")
    lines = [f"newmtl {name}"]
    with naming(name):
        for key, leaf in COLOURS.items():
            rgb = colour(leaf, getattr(material, leaf))
            if key != "Ke":
                rgb = limited(leaf, rgb, 1.0, FORMAT, nearest)
            lines.append(f"{key} {' '.join(f'{channel:.9g}' for channel in rgb)}")
        lines.append(f"Ns {exponent(material, MAX_NS, FORMAT, nearest):.9g}")
    return "\n".join([*lines, "illum 2", ""])
