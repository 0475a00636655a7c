r"""Materials of `.mtl` files with their textures: those of a mesh's faces.

`map_Ka`, `map_Kd`, `map_Ks` and `map_Ke` are sRGB-encoded colours, `map_Ns` numbers
from 0 to 1; each multiplies the number of its name. `norm` is a normal map, and so is
`map_Bump` where it is coloured; a grey one holds heights, which are not read. `map_Pr`
is roughness, of which $f = 2 / r^4 - 2$ is the exponent: see
[`phongfit.files.gltf`][].

??? cite "Source"
    Alias|Wavefront, 1992, as in [`phongfit.files.mtl`][]; Exocortex, *Physically based
    rendering extension of .mtl*, 2014, for `norm` and `map_Pr`.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from phongfit.files.gltf import exponents
from phongfit.files.images import read_texels
from phongfit.files.inputs import inside, naming, read_bytes
from phongfit.files.mtl import TextureLine, as_material, parse_mtl
from phongfit.material import Material
from phongfit.rendering.film import NamedEncoding
from phongfit.textures import Texture, Textures

Note = Callable[[str], None]
"""Takes what of a file is not used, in words."""

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

# How many words follow an option, at the most and at the least.
OPTIONS = {
    "-blendu": (1, 1),
    "-blendv": (1, 1),
    "-boost": (1, 1),
    "-mm": (2, 2),
    "-o": (1, 3),
    "-s": (1, 3),
    "-t": (1, 3),
    "-texres": (1, 1),
    "-clamp": (1, 1),
    "-bm": (1, 1),
    "-imfchan": (1, 1),
    "-cc": (1, 1),
    "-type": (1, 1),
}

BLUE = 0.1
"""A normal map is so much bluer, in the mean, than grey is."""


@dataclasses.dataclass(frozen=True, eq=False)
class Shaded:
    """A material as a file has it: numbers, and textures that multiply them."""

    # Made when asked for: its arrays start JAX, which an import must not.
    material: Material = dataclasses.field(default_factory=Material)
    textures: Textures = dataclasses.field(default_factory=Textures)


def read_textured(path: Path, note: Note) -> dict[str, Shaded]:
    """The materials of a `.mtl` file with their textures, by name.

    **Raises:** `ValueError` that names the file and the line.
    """
    found, lines, unused = parse_mtl(path)
    for words in unused:
        note(f"{path}: {words}")
    opened: dict[tuple[Path, str], np.ndarray] = {}
    textures: dict[str, dict[str, Texture]] = {name: {} for name in found}
    for line in lines:
        if line.material is None:
            note(f"{path}: line {line.number}: {line.key} is of no material")
            continue
        with naming(f"{path}: line {line.number}"):
            fields, own = found[line.material], textures[line.material]
            _add(path, line, fields, own, opened, note)
    shaded = {}
    for name, fields in found.items():
        with naming(f"{path}: material {name!r}"):
            shaded[name] = Shaded(as_material(fields), Textures(**textures[name]))
    return shaded


def _add(
    path: Path,
    line: TextureLine,
    fields: dict[str, Any],
    own: dict[str, Texture],
    opened: dict[tuple[Path, str], np.ndarray],
    note: Note,
) -> None:
    """Add what one line says to a material's textures, and to its numbers."""
    where = f"{path}: line {line.number}"
    if line.key.lower() not in MAPS:
        note(f"{where}: {line.key} is not used")
        return
    key, leaf = MAPS[line.key.lower()]
    file, options = _options(line.words)
    told = f"{where}: texture {file[:60]!r} of material {(line.material or '')[:60]!r}"
    for option in options:
        if option not in ("-clamp", "-type"):
            note(f"{told}: its option {option} is not used")
    if leaf in own:
        note(f"{told}: is a second one of its {leaf}, and not used")
        return
    values = _open(path, file, leaf, opened)
    if values is None:
        note(f"{told} is missing")
        return
    wrap = "clamp" if options.get("-clamp") == ["on"] else "repeat"
    if leaf == "normal":
        if values.shape[-1] != 3 or values[..., 2].mean() < values.mean() + BLUE:
            note(f"{told}: holds heights, which are not used; expected a normal map")
            return
        own[leaf] = Texture(2 * values - 1, wrap=wrap)
        return
    if leaf == "shininess":
        values = values.mean(axis=-1, keepdims=True)
        if line.key.lower() == "map_pr":
            values = exponents(values)
            fields["Ns"] = max(float(values.max()), 1e-6)
            values = values / fields["Ns"]
        elif key not in fields:
            note(f"{told}: there is no Ns that it multiplies, and it is not used")
            return
    if key not in fields:
        fields[key] = 1.0
    own[leaf] = Texture(values, wrap=wrap)


def _options(words: list[str]) -> tuple[str, dict[str, list[str]]]:
    """The file's name, which may have blanks, and the options before it."""
    options, at = {}, 0
    while at < len(words) - 1 and words[at].lower() in OPTIONS:
        name = words[at].lower()
        least, most = OPTIONS[name]
        end = at + 1 + least
        while end < len(words) - 1 and end < at + 1 + most and _is_number(words[end]):
            end += 1
        options[name] = words[at + 1 : end]
        at = end
    return " ".join(words[at:]), options


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _open(
    path: Path, file: str, leaf: str, opened: dict[tuple[Path, str], np.ndarray]
) -> np.ndarray | None:
    """The numbers of a texture's file; `None` if it is missing."""
    try:
        place = inside(path.parent, file)
        there = place.is_file()
    except (ValueError, OSError):
        # No name of a file here, such as one that is too long.
        return None
    if not there:
        return None
    data_like = leaf in ("shininess", "normal")
    encoding: NamedEncoding = "linear" if data_like else "srgb"
    if (place, encoding) not in opened:
        read = read_texels(read_bytes(place), place, encoding)
        opened[place, encoding] = read.values
    return opened[place, encoding]
