r"""Materials of `.mtl` files with their textures, for the faces of a mesh.

`map_Ka`, `map_Kd`, `map_Ks` and `map_Ke` are sRGB-encoded colours, `map_Ns` numbers
from 0 to 1; each multiplies the number of its name. `norm` is a normal map, and so is a
coloured `map_Bump`; a grey one holds heights, which are not read. `map_Pr` is roughness
$r$, with the exponent $f = 2 / r^4 - 2$: see [`phongfit.files.gltf`][].

??? cite "Source"
    Alias|Wavefront, 1992, as in [`phongfit.files.mtl`][]; Exocortex, *Physically based
    rendering extension of .mtl*, 2014, for `norm` and `map_Pr`.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from phongfit.files.budget import afford
from phongfit.files.gltf import exponents
from phongfit.files.images import Texels, read_texels
from phongfit.files.inputs import Note, beside, naming, read_bytes
from phongfit.files.mtl import COLOURS, MAPS, TextureLine, as_material, parse_mtl
from phongfit.material import Material
from phongfit.rendering.film import NamedEncoding
from phongfit.textures import Texture, Textures

BLUE = 0.1
"""Smallest excess of mean blue over mean grey in a normal map."""


@dataclasses.dataclass(frozen=True, eq=False)
class Shaded:
    """A material from a file: parameters, and textures that multiply them."""

    # Made on demand: its arrays start JAX, which an import must not.
    material: Material = dataclasses.field(default_factory=Material)
    textures: Textures = dataclasses.field(default_factory=Textures)


def read_textured(path: Path, note: Note) -> dict[str, Shaded]:
    """The materials of a `.mtl` file with their textures, by name.

    **Raises:** `ValueError` that names the file and the line.
    """
    found, lines, notes = parse_mtl(path)
    for words in notes:
        note(f"{path}: {words}")
    opened: dict[tuple[str, str], Texels | str] = {}
    held = 0
    textures: dict[str, dict[str, Texture]] = {name: {} for name in found}
    for line in lines:
        if line.material is None:
            note(f"{path}: line {line.number}: {line.key} is of no material")
            continue
        with naming(f"{path}: line {line.number}"):
            fields, own = found[line.material], textures[line.material]
            known = set(own)
            _add(path, line, fields, own, opened, note)
            held += sum(own[leaf].values.nbytes for leaf in own.keys() - known)
            afford(held, "textures")
    shaded = {}
    for name, fields in found.items():
        own = textures[name]
        if fields.get("illum") == 0 and "diffuse" in own:
            # Kd and its texture are shown as they are.
            own["emission"] = own.pop("diffuse")
            own.pop("ambient", None)
        with naming(f"{path}: material {name!r}"):
            shaded[name] = Shaded(as_material(fields), Textures(**textures[name]))
    return shaded


def _add(
    path: Path,
    line: TextureLine,
    fields: dict[str, Any],
    own: dict[str, Texture],
    opened: dict[tuple[str, str], Texels | str],
    note: Note,
) -> None:
    """Add the texture of one line to the textures `own` and the numbers `fields`."""
    key, leaf = MAPS[line.key.lower()]
    name, where = (line.material or "")[:60], f"{path}: line {line.number}"
    told = f"{where}: texture {line.file[:60]!r} of material {name!r}"
    if line.unused:
        note(f"{told}: its options {' '.join(line.unused)} are not used")
    if leaf in own:
        note(f"{told}: is a second one of its {leaf}, and not used")
        return
    read = _open(path, line.file, leaf, opened)
    if isinstance(read, str):
        note(f"{told} {read}")
        return
    values = read.values
    if read.transparent and key in COLOURS:
        note(f"{told}: is partly transparent, which is not used")
    wrap = "clamp" if line.options.get("-clamp") in (["on"], ["ON"]) else "repeat"
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
    elif not np.any(fields.get(key, 1)):
        note(f"{told}: is multiplied by {key} 0, which is taken as 1")
        fields[key] = 1.0
    fields.setdefault(key, 1.0)
    own[leaf] = Texture(values, wrap=wrap)


def _open(
    path: Path, file: str, leaf: str, opened: dict[tuple[str, str], Texels | str]
) -> Texels | str:
    """The numbers of a texture's file, or the end of a sentence on the error."""
    data_like = leaf in ("shininess", "normal")
    encoding: NamedEncoding = "linear" if data_like else "srgb"
    if (file, encoding) not in opened:
        place = beside(path.parent, file)
        try:
            opened[file, encoding] = (
                "is missing"
                if place is None
                else read_texels(read_bytes(place), place, encoding)
            )
        except ValueError as error:
            opened[file, encoding] = f"cannot be read, and is not used: {error}"
    return opened[file, encoding]
