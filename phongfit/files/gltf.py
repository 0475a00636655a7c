r"""glTF 2.0: a mesh with Phong's material, approximated for metallic-roughness viewers.

The two models differ. The conversion keeps the width and the brightness of a highlight
that is seen head-on:

- roughness: Beckmann's and GGX's $\alpha$ of about the same lobe as Blinn's $\cos^f$
  is $\alpha = \sqrt{2 / (f + 2)}$, and glTF's roughness is $\sqrt\alpha$: peak and sum
  of the facets are equal, in between they differ by up to 0.16 of the peak. A
  [`GGX`][] keeps its roughness, and $F_0$ is that of the model times $\rho_s$;
- `KHR_materials_specular`: the peak of GGX's lobe over a matte surface's light is
  $F_0 (f + 2) / 8$, so that $F_0 = 8 \rho_s / (f + 2)$; 4 % of it is glTF's colour 1.
  A viewer shows at most $F_0 = 1$;
- base colour is $\rho_d$, metallic is 0, emission is emission. Ambient has no place:
  viewers light by an environment. The exact material is in the file's `extras`.

??? cite "Source"
    Karis, *Specular BRDF reference*, 2013 (α and f); Khronos, *glTF 2.0*, 2021, section
    3.9, and *KHR_materials_specular*.
"""

import base64
import json
import os
import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from phongfit.files.limits import colour, exponent, limited
from phongfit.files.outputs import replacing
from phongfit.files.schema import describe_material
from phongfit.material import Material
from phongfit.plain import plain

FORMAT = "glTF"
COLOURS = {
    "COLOR_0": "diffuse",
    "_AMBIENT": "ambient",
    "_SPECULAR": "specular",
    "_EMISSION": "emission",
    "_SHININESS": "shininess",
}
"""Attributes of vertices that multiply a material's parameters, in files that phongfit
wrote. All except `COLOR_0` are custom attributes, which the format allows."""
COLOUR_0 = {"COLOR_0": ("diffuse", "ambient")}
"""The attribute in files of other programs, where it multiplies base colour."""
F0_OF_WHITE = 0.04
MAX_EXPONENT = 1e4
"""Largest exponent that is read: a mirror, with roughness 0, gets this one."""
FLOAT, UNSIGNED = 5126, 5125
VERTICES, INDICES = 34962, 34963
CONVERSION = (
    "roughness = (2 / (shininess + 2))^(1/4); "
    "specularColorFactor = 8 specular / (shininess + 2) / 0.04; base colour = diffuse"
)


class Part(NamedTuple):
    """Triangles of one material, as arrays for glTF.

    `uv` has its origin at the top left. Without `normals` faces are flat. `colours` are
    linear colours of the vertices, by the name of the attribute.
    """

    positions: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    normals: Float[np.ndarray, "vertices 3"] | None = None
    uv: Float[np.ndarray, "vertices 2"] | None = None
    colours: dict[str, np.ndarray] = {}  # noqa: RUF012


class Picture(NamedTuple):
    """A texture's PNG file as bytes, in place of the number of a texture."""

    png: bytes
    nearest: bool
    repeat: bool


def roughness(shininess: Any) -> Float[np.ndarray, "..."]:
    r"""[`roughness_from_shininess`][] in NumPy: $(2 / (f + 2))^{1/4}$."""
    return np.asarray((2 / (np.asarray(shininess, float) + 2)) ** 0.25)


def exponents(roughness: Any) -> Float[np.ndarray, "..."]:
    r"""Blinn's exponent for glTF's roughness: $2 / r^4 - 2$, at most 1e4."""
    fourth = np.maximum(np.asarray(roughness, float) ** 4, 2 / (MAX_EXPONENT + 2))
    return np.asarray(np.maximum(2 / fourth - 2, 0))


def specular_of(colour: Any, shininess: Any) -> Float[np.ndarray, "..."]:
    r"""$\rho_s$ from glTF's specular colour, the inverse of [`specular_colour`][]."""
    f = np.asarray(shininess, float)
    return np.asarray(F0_OF_WHITE * np.asarray(colour, float) * (f + 2) / 8)


def specular_colour(specular: Any, shininess: Any) -> Float[np.ndarray, "..."]:
    r"""glTF's specular colour from $\rho_s$: $8 \rho_s / (f + 2) / 0.04$."""
    f = np.asarray(shininess, float)
    return np.asarray(8 * np.asarray(specular, float) / (f + 2) / F0_OF_WHITE)


def pbr_material(name: str, material: Material, nearest: bool) -> dict[str, Any]:
    """One material of the un-normalised Blinn-Phong model, as a glTF material.

    **Arguments:** `nearest`: replace values that glTF cannot hold by the nearest, with
    a warning: colours above 1, an exponent for each channel.

    **Raises:** `ValueError` that names the parameter, unless `nearest`.
    """
    f = exponent(material, np.inf, FORMAT, nearest)
    diffuse, emission = (
        limited(leaf, colour(leaf, getattr(material, leaf)), 1.0, FORMAT, nearest)
        for leaf in ("diffuse", "emission")
    )
    tint = specular_colour(colour("specular", material.specular), f)
    return {
        "name": name,
        "pbrMetallicRoughness": {
            "baseColorFactor": [*diffuse, 1.0],
            "metallicFactor": 0.0,
            "roughnessFactor": float(roughness(f)),
        },
        "emissiveFactor": emission,
        "extensions": {"KHR_materials_specular": {"specularColorFactor": tint}},
        "extras": {"phong": describe_material(material), "conversion": CONVERSION},
    }


def write_gltf(
    path: str | os.PathLike[str], parts: list[tuple[Part, dict[str, Any]]]
) -> None:
    """Write triangles and their materials into a single file, whole or not at all.

    **Arguments:**

    - `path`: `.glb`, or `.gltf` with the binary part as text.
    - `parts`: triangles, each with a material of [`pbr_material`][], in which a
        [`Picture`][] replaces each texture.

    **Raises:** `ValueError` for another suffix, `OSError` that names the file.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".glb", ".gltf"):
        raise ValueError(f"{path}: expected suffix .glb or .gltf, got {suffix!r}")
    file = _File()
    for part, material in parts:
        file.add(part, material)
    content = file.glb() if suffix == ".glb" else file.gltf()
    with replacing(path) as temporary:
        temporary.write_bytes(content)


class _File:
    """A glTF file under construction: JSON, and the bytes that it refers to."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.json: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "phongfit"},
            "extensionsUsed": ["KHR_materials_specular"],
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": []}],
        }

    def add(self, part: Part, material: dict[str, Any]) -> None:
        arrays = {
            "POSITION": part.positions,
            "NORMAL": part.normals,
            "TEXCOORD_0": part.uv,
            **part.colours,
        }
        attributes = {
            name: self._array(array, f"VEC{array.shape[1]}")
            for name, array in arrays.items()
            if array is not None
        }
        primitive = {
            "attributes": attributes,
            "indices": self._array(part.faces.reshape(-1), "SCALAR"),
            "material": self._add("materials", self._pictured(material)),
        }
        self.json["meshes"][0]["primitives"].append(primitive)

    def _pictured(self, value: Any) -> Any:
        """A material with its pictures replaced by numbers of textures in this file."""
        if isinstance(value, Picture):
            return {"index": self._picture(value)}
        if isinstance(value, dict):
            return {key: self._pictured(part) for key, part in value.items()}
        return value

    def _picture(self, picture: Picture) -> int:
        view = self._view(picture.png)
        filter = 9728 if picture.nearest else 9729
        wrap = 10497 if picture.repeat else 33071
        sampler = {"magFilter": filter, "minFilter": filter}
        source = self._add("images", {"bufferView": view, "mimeType": "image/png"})
        number = self._add("samplers", sampler | {"wrapS": wrap, "wrapT": wrap})
        return self._add("textures", {"source": source, "sampler": number})

    def _add(self, key: str, item: dict[str, Any]) -> int:
        """The number of a new item in one of the file's lists."""
        items = self.json.setdefault(key, [])
        items.append(item)
        return len(items) - 1

    def _array(self, array: np.ndarray, kind: str) -> int:
        whole = kind == "SCALAR"
        numbers = np.ascontiguousarray(array, np.uint32 if whole else np.float32)
        view = self._view(numbers.tobytes(), INDICES if whole else VERTICES)
        accessor: dict[str, Any] = {
            "bufferView": view,
            "componentType": UNSIGNED if whole else FLOAT,
            "count": len(numbers),
            "type": kind,
        }
        if kind == "VEC3":
            # Viewers compute the object's size from these.
            ends = numbers.min(axis=0), numbers.max(axis=0)
            accessor |= {"min": ends[0].astype(float), "max": ends[1].astype(float)}
        return self._add("accessors", accessor)

    def _view(self, content: bytes, target: int | None = None) -> int:
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)}
        self.data += content + bytes(-len(content) % 4)
        given = {} if target is None else {"target": target}
        return self._add("bufferViews", view | given)

    def _text(self, uri: str | None) -> bytes:
        buffer: dict[str, Any] = {"byteLength": len(self.data)}
        buffer |= {} if uri is None else {"uri": uri}
        content = self.json | {"buffers": [buffer]}
        return json.dumps(plain(content), allow_nan=False).encode()

    def gltf(self) -> bytes:
        coded = base64.b64encode(bytes(self.data)).decode()
        return self._text(f"data:application/octet-stream;base64,{coded}")

    def glb(self) -> bytes:
        text = self._text(None)
        text += b" " * (-len(text) % 4)
        chunks = [(text, b"JSON"), (bytes(self.data), b"BIN\0")]
        body = b"".join(struct.pack("<I4s", len(c), kind) + c for c, kind in chunks)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body
