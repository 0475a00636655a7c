"""Materials of Wavefront OBJ files: `.mtl`.

??? cite "Source"
    Alias|Wavefront, *Object files (.obj) and material library files (.mtl)*, appendix
    B1 of the Advanced Visualizer manual, 1992.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from phongfit.codes import warn
from phongfit.edge import checked
from phongfit.files.inputs import (
    beside,
    floats,
    joined_lines,
    listed,
    naming,
    read_bytes,
    uncommented,
)
from phongfit.files.limits import colour, exponent, limited
from phongfit.files.outputs import replacing
from phongfit.material import Material

MAX_NS = 1000.0
FORMAT = ".mtl"
MOST = 10_000
"""Maximum number of materials in a file."""

MOST_BYTES = 2**24
FEW = 5
"""Maximum number of warnings of one kind."""

COLOURS = {"Ka": "ambient", "Kd": "diffuse", "Ks": "specular", "Ke": "emission"}
USUAL = {"d": "1", "Tr": "0", "Tf": "1"}
"""Values with which keys of transparency have no effect."""
SILENT = ("Ni", "sharpness")
"""Keys of refraction and reflection maps, without effect by themselves."""
MAPS = {
    "map_ka": ("Ka", "ambient"),
    "map_kd": ("Kd", "diffuse"),
    "map_ks": ("Ks", "specular"),
    "map_ke": ("Ke", "emission"),
    "map_ns": ("Ns", "shininess"),
    "map_pr": ("Ns", "shininess"),
    "norm": ("", "normal"),
    "map_norm": ("", "normal"),
    "bump": ("", "normal"),
    "map_bump": ("", "normal"),
}
"""For each key of a texture, in small letters: the key of the number that it
multiplies, and the parameter."""

# For each option of a texture: the smallest and largest number of words that follow,
# and the words with which it has no effect.
OPTIONS = {
    "-blendu": (1, 1, {"on"}),
    "-blendv": (1, 1, {"on"}),
    "-boost": (1, 1, {"0"}),
    "-mm": (2, 2, {"0 1"}),
    "-o": (1, 3, {"0", "0 0", "0 0 0"}),
    "-s": (1, 3, {"1", "1 1", "1 1 1"}),
    "-t": (1, 3, {"0", "0 0", "0 0 0"}),
    "-texres": (1, 1, set()),
    "-clamp": (1, 1, {"on", "off"}),
    "-bm": (1, 1, {"1"}),
    "-imfchan": (1, 1, set()),
    "-cc": (1, 1, {"off"}),
    "-type": (1, 1, set()),
}


class TextureLine(NamedTuple):
    """A line of a `.mtl` that names a texture's file, with its options."""

    number: int
    material: str | None
    key: str
    file: str
    options: dict[str, list[str]]

    @property
    def unused(self) -> list[str]:
        """Options that would change the texture, but are not supported."""
        return [
            name
            for name, words in self.options.items()
            if name != "-type" and _as_numbers(words) not in OPTIONS[name][2]
        ]


class Library(NamedTuple):
    """Contents of a `.mtl`.

    - `materials`: numbers by key, for each material.
    - `textures`: lines that name textures.
    - `notes`: sentences on unused or doubtful contents.
    """

    materials: dict[str, dict[str, Any]]
    textures: list[TextureLine]
    notes: list[str]


@checked
def read_mtl(path: str | os.PathLike[str]) -> dict[str, Material]:
    """The materials of a `.mtl` file by their names, in the file's order.

    Ka, Kd, Ks, Ke and Ns are read; missing keys have the defaults of [`Material`][].
    With `illum 0` the colour Kd becomes emission, and with `illum 1` there is no
    highlight. Other keys, such as those of transparency, are listed in a warning.
    Textures are not read either: [`load_mesh`][] reads them with their mesh. Warnings
    name the first few of them, and state if a file is missing.

    **Raises:** `ValueError` that names the file and the line.
    """
    path = Path(path)
    found, textures, notes = parse_mtl(path)
    materials = {}
    for name, fields in found.items():
        with naming(f"{path}: material {name!r}"):
            materials[name] = as_material(fields)
    for words in notes:
        warn("part-unused", f"{path}: {words}", stacklevel=2)
    for line in textures[:FEW]:
        told = f"line {line.number}: {_of_texture(path, line)}"
        told = f"{path}: {told}: the material has one colour"
        warn("texture-unread", told, stacklevel=2)
    if textures[FEW:]:
        told = f"{len(textures) - FEW} other textures are not read either"
        warn("texture-unread", f"{path}: {told}", stacklevel=2)
    return materials


def parse_mtl(path: Path) -> Library:
    """Read the contents of a `.mtl`.

    **Raises:** `ValueError` that names the file and the line.
    """
    found: dict[str, dict[str, Any]] = {}
    textures: list[TextureLine] = []
    unused: dict[str, str] = {}
    doubtful: dict[str, str] = {}
    name = None
    for number, line in joined_lines(read_bytes(path, MOST_BYTES)):
        key, *words = line.split() or ["#"]
        with naming(f"{path}: line {number}"):
            if key == "newmtl":
                if not words:
                    raise ValueError("newmtl: expected a name")
                # A # belongs to the name, as in "Anodized Grey #1".
                name = " ".join(words)
                if name in found:
                    told = f"line {number}: material {name[:60]!r} goes on"
                    doubtful.setdefault(key, f"{told}: it was there before")
                found.setdefault(name, {})
                if len(found) > MOST:
                    raise ValueError(f"expected at most {MOST} materials, got more")
            elif key in COLOURS or key in ("Ns", "illum"):
                if name is None:
                    raise ValueError(f"{key}: came before the first newmtl")
                words = uncommented(words)
                found[name][key] = _numbers(key, words)
                if doubt := _doubt(key, found[name][key]):
                    told = f"line {number}: {key} {' '.join(words)[:40]}{doubt}"
                    doubtful.setdefault(key, told)
            elif key.lower() in MAPS:
                textures.append(_texture_line(number, name, key, words))
                if len(textures) > MOST:
                    raise ValueError(f"expected at most {MOST} textures, got more")
            elif key == "bsdf" and words == ["pbr"] and name is not None:
                found[name][key] = words
            elif not key.startswith("#") and not _is_usual(key, uncommented(words)):
                unused.setdefault(key, f"{key[:20]} (line {number})")
    packed = {name for name, fields in found.items() if fields.pop("bsdf", None)}
    for name in packed & {one.material for one in textures if _is_packed(one)}:
        found[name].pop("Ks", None)
        told = f"material {name[:60]!r}: its map_Ks is roughness and metalness, by "
        doubtful.setdefault("bsdf", f"{told}'bsdf pbr', and is not used")
    textures = [k for k in textures if k.material not in packed or not _is_packed(k)]
    notes = list(doubtful.values())
    if unused:
        notes.append(f"not used: {listed([*unused.values()])}")
    return Library(found, textures, notes)


def _is_packed(line: TextureLine) -> bool:
    """True if, under `bsdf pbr`, a texture holds occlusion, roughness and metalness.

    ??? cite "Source"
        Munkberg et al., *Extracting triangular 3D models, materials, and lighting from
        images*, 2022: nvdiffrec writes such files.
    """
    return line.key.lower() == "map_ks"


def _doubt(key: str, value: Any) -> str:
    """End of a sentence on a doubtful value of a key; empty if there is no doubt."""
    if key == "illum" and value > 2:
        return ", of mirrors and glass, is taken as 2"
    if key in ("Ka", "Kd", "Ks") and np.max(value) > 1:
        return " is taken as it is; expected 0 to 1 (of 0 to 255, divide it by 255)"
    return ""


def _texture_line(
    number: int, material: str | None, key: str, words: list[str]
) -> TextureLine:
    """Parse a texture's line; options may come before or after the file's name."""
    options, file, at = {}, [], 0
    while at < len(words):
        word, at = words[at], at + 1
        if word.lower() not in OPTIONS:
            file.append(word)
            continue
        least, most, _ = OPTIONS[word.lower()]
        end = at + least
        while end < min(len(words), at + most) and floats([words[end]]):
            end += 1
        options[word.lower()], at = words[at:end], end
    return TextureLine(number, material, key, " ".join(file), options)


def _as_numbers(words: list[str]) -> str:
    """Words in the notation of [`OPTIONS`][], such as 1 for 1.000."""
    return " ".join(f"{float(k):g}" if floats([k]) else k.lower() for k in words)


def _is_usual(key: str, words: list[str]) -> bool:
    """True if a key has no effect, in general or with these numbers."""
    if key in SILENT:
        return True
    return key in USUAL and set(_as_numbers(words).split()) == {USUAL[key]}


def _numbers(key: str, words: list[str]) -> Any:
    wanted = (1, 3) if key in COLOURS else (1,)
    numbers = floats(words)
    if len(numbers) not in wanted or not np.isfinite(numbers).all() or min(numbers) < 0:
        count = "1 or 3 numbers" if key in COLOURS else "1 number"
        raise ValueError(f"{key}: expected {count} ≥ 0, got {' '.join(words)[:60]!r}")
    return numbers[0] if len(numbers) == 1 else numbers


def as_material(fields: dict[str, Any]) -> Material:
    """A material from the values of a `.mtl`, by key."""
    leaves = {leaf: fields[key] for key, leaf in COLOURS.items() if key in fields}
    if "Ns" in fields:
        leaves["shininess"] = fields["Ns"]
    illumination = fields.get("illum", 2)
    if illumination < 2:
        leaves["specular"] = 0.0
    if illumination == 0:
        leaves |= {"ambient": 0.0, "diffuse": 0.0, "emission": fields.get("Kd", 0.8)}
    return Material(**leaves)


def _of_texture(path: Path, line: TextureLine) -> str:
    here = beside(path.parent, line.file) is not None
    material = line.material if line.material is None else line.material[:60]
    return (
        f"texture {line.file[:60]!r} of material {material!r} "
        f"{'is not read' if here else 'is missing'}"
    )


@checked
def write_mtl(
    path: str | os.PathLike[str],
    materials: Mapping[str, Material],
    *,
    nearest: bool = False,
) -> None:
    """Write materials as a `.mtl` file, whole or not at all.

    **Arguments:**

    - `materials`: by name; split stacked materials with [`unstack_materials`][].
    - `nearest`: replace values that `.mtl` cannot hold by the nearest, with a warning:
        colours above 1 (except Ke), an exponent above 1000, or one for each channel.

    **Raises:** `ValueError` that names the material and the parameter, unless
    `nearest`, and for a name that is empty or has line breaks; `OSError` that names the
    file.
    """
    blocks = [
        mtl_block(name, material, nearest) for name, material in materials.items()
    ]
    with replacing(path) as temporary:
        temporary.write_text("\n".join(blocks), encoding="utf-8")


def mtl_block(name: str, material: Material, nearest: bool) -> str:
    """The lines of one material; raises as [`write_mtl`][] does."""
    if not name or name != " ".join(name.split()):
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
