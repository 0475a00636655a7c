r"""Phong materials from glTF files: the inverse of [`phongfit.files.gltf`][].

With base colour $b$, metallic $m$, roughness $r$ and the reflectance of a dielectric
$F = 0.04\, c$ (KHR_materials_specular's colour $c$; 0.04 is that of KHR_materials_ior):

- $\rho_d = (1 - m)\, b$ and $\rho_a = b$, since metals also reflect the surroundings;
- $f = 2 / r^4 - 2$ and $\rho_s = ((1 - m)\, F + m\, b)\, (f + 2) / 8$.

KHR_materials_pbrSpecularGlossiness has $\rho_d$ and $F$ itself, and $r = 1 - g$ for its
glossiness $g$. Each of these numbers may have a texture; colours are sRGB-encoded in
them. If `extras` hold a material that phongfit wrote, that material is used unchanged.

??? cite "Source"
    Khronos, *glTF 2.0*, 2021, appendix B, and the extensions above;
    *KHR_texture_transform*: a rotation is counter-clockwise, where v runs down.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.ndimage import zoom

from phongfit.files.budget import afford
from phongfit.files.gltf import (
    COLOUR_0,
    COLOURS,
    F0_OF_WHITE,
    exponents,
    specular_of,
)
from phongfit.files.images import read_texels
from phongfit.files.inputs import naming_field, shortened
from phongfit.files.mtl_textures import Shaded
from phongfit.files.records import validated
from phongfit.files.schema import MaterialRecord
from phongfit.files.strict_json import unexpected
from phongfit.material import Material
from phongfit.rendering.film import NamedEncoding
from phongfit.textures import Texture, Textures

NEAREST, REPEAT, CLAMP = 9728, 10497, 33071
WHITE = (1, 1, 1, 1)
LARGEST = 1e30
Record = dict[str, Any]
"""An object of the file's JSON."""


def at(file: Record, items: str, number: Any, what: str) -> Record:
    """An item of one of the file's lists, by its number.

    **Raises:** `ValueError` that names `what`, the key of the number.
    """
    found = file.get(items, [])
    if not isinstance(found, list):
        raise unexpected(items, "a list", found)
    if not isinstance(number, int) or not 0 <= number < len(found):
        raise unexpected(what, f"a number below {len(found)}", number)
    if not isinstance(item := found[number], dict):
        raise unexpected(f"{items}[{number}]", "an object {…}", item)
    return item


def whole(record: Record, name: str, default: int | None = None) -> int:
    """A count or an offset; `default` if it is not stated, else it is required."""
    value = record.get(name, default)
    if not isinstance(value, int) or value < 0:
        raise unexpected(name, "a whole number ≥ 0", value)
    return value


def vector(record: Record, name: str, default: Sequence[float]) -> np.ndarray:
    """A list of numbers, as many as `default` has, which it is if it is not stated."""
    value = record.get(name, list(default))
    if not isinstance(value, list) or len(value) != len(default):
        raise unexpected(name, f"{len(default)} numbers", value)
    if not all(isinstance(x, int | float) and math.isfinite(x) for x in value):
        raise unexpected(name, "finite numbers", value)
    return np.array(value, float)


def _number(
    record: Record, name: str, default: float = 1, least: float = 0, most: float = 1
) -> float:
    """A number in a range, usually a factor from 0 to 1."""
    value = record.get(name, default)
    if not isinstance(value, int | float) or not least <= value <= most:
        raise unexpected(name, f"{least:g} to {most:g}", value)
    return float(value)


OpenImage = Callable[[int], tuple[bytes, Path]]
"""Function from an image's number to its bytes and its name.

**Raises:** `ValueError` if the image is missing.
"""


class Placing(NamedTuple):
    """The set of uv that the textures of a material use, and its transformation."""

    uv_set: int
    offset: tuple[float, ...]
    rotation: float
    scale: tuple[float, ...]

    def of(
        self, uv: Float[np.ndarray, "vertices 2"]
    ) -> Float[np.ndarray, "vertices 2"]:
        """The uv at which the textures are looked up."""
        c, s = np.cos(self.rotation), np.sin(self.rotation)
        return (uv * self.scale) @ np.array([[c, -s], [s, c]]) + self.offset


class GltfShade(NamedTuple):
    """A material of a file, with its textures.

    - `placing`: of its textures; `None` if it has none.
    - `multiplied`: the parameters that each attribute of vertices multiplies.
    """

    shaded: Shaded
    placing: Placing | None
    multiplied: Mapping[str, tuple[str, ...]]


class _Map(NamedTuple):
    """Numbers of a surface: (channels,), or (H, W, channels) of textures."""

    values: np.ndarray
    sampled: dict[str, Any] | None = None

    def part(self, channels: slice, factor: Any = 1) -> "_Map":
        factor = np.asarray(factor, self.values.dtype)
        return self._replace(values=self.values[..., channels] * factor)


RGB, GREEN, BLUE, ALPHA = slice(0, 3), slice(1, 2), slice(2, 3), slice(3, 4)


class Shading:
    """Reader of a file's materials, one at a time.

    **Arguments:** `unused`: filled with the unused parts of materials, as keys.
    """

    def __init__(self, file: Record, image: OpenImage, unused: dict[str, None]):
        self._file = file
        self._image = image
        self._unused = unused
        self._opened: dict[tuple[int, NamedEncoding], np.ndarray] = {}
        self._held = 0
        # State of the material that is being read.
        self._name = ""
        self._placing: Placing | None = None
        self._leaves: dict[str, Any] = {}
        self._textures: dict[str, Texture] = {}

    def read(self, material: Record) -> GltfShade:
        """Read one material.

        **Raises:** `ValueError` that describes the error.
        """
        name, extensions = material.get("name"), material.get("extensions", {})
        if not isinstance(name, str | None):
            raise unexpected("name", "a text", name)
        self._name = "a material" if name is None else f"material {name[:60]!r}"
        self._placing, self._leaves, self._textures = None, {}, {}
        own, multiplied = _own(material), COLOUR_0
        gloss = extensions.get("KHR_materials_pbrSpecularGlossiness")
        if own is not None:
            multiplied = {key: (leaf,) for key, leaf in COLOURS.items()}
        if gloss is not None:
            self._glossy(gloss)
        elif self._metallic(material, own) and own is None:
            multiplied = {"COLOR_0": ("diffuse", "ambient", "specular")}
            self._unused[
                f"the mirror image in {self._name}, a metal (its base colour is its "
                "specular reflectance)"
            ] = None
        strength = extensions.get("KHR_materials_emissive_strength", {})
        factor = vector(material, "emissiveFactor", (0, 0, 0))
        factor *= _number(strength, "emissiveStrength", most=LARGEST)
        info = material.get("emissiveTexture") if factor.any() else None
        glow = self._open("emissiveTexture", info, "srgb")
        self._put("emission", glow.part(RGB), factor)
        if (info := material.get("normalTexture")) is not None:
            bumps = self._open("normalTexture", info, "linear")
            if bumps.sampled is not None:
                scale = _number(info, "scale", 1, -LARGEST, LARGEST)
                values = (2 * bumps.values[..., RGB] - 1) * [scale, scale, 1]
                self._hold(values)
                self._textures["normal"] = Texture(values, **bumps.sampled)
        if own is not None:
            self._textures.pop("ambient", None)
            exact = vars(own).items()
            self._leaves |= {k: v for k, v in exact if k not in self._textures}
        shaded = Shaded(Material(**self._leaves), Textures(**self._textures))
        return GltfShade(shaded, self._placing, multiplied)

    def _metallic(self, material: Record, own: Material | None) -> bool:
        """Read metallic and roughness; true for metals."""
        pbr = material.get("pbrMetallicRoughness", {})
        extensions = material.get("extensions", {})
        base = self._texture(pbr, "baseColorTexture", "srgb")
        rough = self._texture(pbr, "metallicRoughnessTexture", "linear")
        metallic = _number(pbr, "metallicFactor")
        if "metallicRoughnessTexture" in pbr and rough.sampled is None:
            # Without its texture the factor's default, 1, would make it a metal.
            metallic = 0.0
            self._unused[f"metallicFactor of {self._name}, which needs it"] = None
        metal = rough.part(BLUE, metallic)
        is_metal = bool(metal.values.any())
        metal = metal if is_metal else _Map(np.zeros(1))
        factor = vector(pbr, "baseColorFactor", WHITE)
        self._coloured(base, factor, metal)
        given = extensions.get("KHR_materials_specular", {})
        tint = self._texture(given, "specularColorTexture", "srgb")
        weight = self._texture(given, "specularTexture", "linear")
        specular = _number(given, "specularFactor")
        ior = _number(extensions.get("KHR_materials_ior", {}), "ior", 1.5, most=1000)
        f0 = self._mapped(
            lambda tint, weight: tint * weight,
            tint.part(RGB, vector(given, "specularColorFactor", WHITE[:3])),
            weight.part(ALPHA, specular * ((ior - 1) / (ior + 1)) ** 2),
        )
        if is_metal:
            f0 = self._mapped(
                lambda f0, base, metal: (1 - metal) * f0 + metal * base,
                *(f0, base.part(RGB, factor[:3]), metal),
            )
        f = self._mapped(exponents, rough.part(GREEN, _number(pbr, "roughnessFactor")))
        if own is not None and rough.sampled is None:
            f = _Map(np.atleast_1d(np.asarray(own.shininess, float)))
        self._highlight(f0, f)
        return is_metal

    def _glossy(self, gloss: Record) -> None:
        base = self._texture(gloss, "diffuseTexture", "srgb")
        self._coloured(base, vector(gloss, "diffuseFactor", WHITE), _Map(np.zeros(1)))
        both = self._texture(gloss, "specularGlossinessTexture", "srgb")
        glossiness = both.part(ALPHA, _number(gloss, "glossinessFactor"))
        f = self._mapped(lambda glossiness: exponents(1 - glossiness), glossiness)
        factor = vector(gloss, "specularFactor", WHITE[:3])
        self._highlight(both.part(RGB, factor), f)

    def _coloured(self, base: _Map, factor: np.ndarray, metal: _Map) -> None:
        colour = base.part(RGB)
        self._put("ambient", colour, factor[:3])
        if metal.values.any():
            matte = self._mapped(lambda b, metal: b * (1 - metal), colour, metal)
            self._put("diffuse", matte, factor[:3])
        else:
            # One texture object for both, as with other formats.
            self._leaves["diffuse"] = self._leaves["ambient"]
            if "ambient" in self._textures:
                self._textures["diffuse"] = self._textures["ambient"]

    def _highlight(self, f0: _Map, f: _Map) -> None:
        self._put("shininess", f)
        specular = self._mapped(lambda f0, f: specular_of(f0 / F0_OF_WHITE, f), f0, f)
        self._put("specular", specular)

    def _mapped(self, function: Callable[..., Any], *maps: _Map) -> _Map:
        """A function of several maps, on the grid of the largest."""
        images = [one for one in maps if one.sampled is not None]
        if not images:
            return _Map(np.asarray(function(*(one.values for one in maps))))
        size = np.max([one.values.shape[:2] for one in images], axis=0)
        afford(len(maps) * 24 * int(np.prod(size, dtype=object)), "textures")

        def resized(one: _Map) -> np.ndarray:
            if one.sampled is None or tuple(size) == one.values.shape[:2]:
                return one.values
            factors = (*(size / one.values.shape[:2]), 1)
            order = int(one.sampled["filter"] == "bilinear")
            mode = "grid-wrap" if one.sampled["wrap"] == "repeat" else "nearest"
            values = one.values
            return np.array(zoom(values, factors, None, order, mode, grid_mode=True))

        values = function(*map(resized, maps))
        return _Map(np.asarray(values), images[0].sampled)

    def _put(self, leaf: str, numbers: _Map, factor: Any = None) -> None:
        """Set a parameter, and the texture that multiplies it if it varies."""
        values = numbers.values
        if numbers.sampled is None or not values.any():
            number = values.reshape(-1, values.shape[-1])[0]
            self._leaves[leaf] = number * (1 if factor is None else np.asarray(factor))
            return
        if factor is None:
            factor = float(values.max())
            values = values / factor
        self._hold(values)
        self._leaves[leaf] = factor
        self._textures[leaf] = Texture(values, **numbers.sampled)

    def _hold(self, values: np.ndarray) -> None:
        self._held += values.nbytes
        afford(self._held, "textures")

    def _texture(self, record: Record, name: str, encoding: NamedEncoding) -> _Map:
        return self._open(name, record.get(name), encoding)

    def _open(self, what: str, info: Record | None, encoding: NamedEncoding) -> _Map:
        """One of the material's textures, RGBA; ones if it is missing or unusable."""
        ones = _Map(np.ones(4))
        if info is None:
            return ones
        told = f"{what} of {self._name}"
        texture = at(self._file, "textures", info["index"], f"{what}.index")
        transform = info.get("extensions", {}).get("KHR_texture_transform", {})
        placing = Placing(
            whole(transform, "texCoord", whole(info, "texCoord", 0)),
            tuple(vector(transform, "offset", (0, 0)).tolist()),
            _number(transform, "rotation", 0, -LARGEST, LARGEST),
            tuple(vector(transform, "scale", (1, 1)).tolist()),
        )
        if self._placing not in (None, placing):
            self._unused[f"{told} (its uv differ from those of another)"] = None
            return ones
        if "source" not in texture:
            self._unused[f"{told} (of an unknown format)"] = None
            return ones
        try:
            values = self._rgba(texture["source"], encoding)
        except ValueError as error:
            self._unused[f"{told} ({shortened(str(error))})"] = None
            return ones
        self._placing = placing
        sampler = {}
        if "sampler" in texture:
            sampler = at(self._file, "samplers", texture["sampler"], "sampler")
        wraps = {sampler.get("wrapS", REPEAT), sampler.get("wrapT", REPEAT)}
        if wraps not in ({REPEAT}, {CLAMP}):
            self._unused[f"the wrapping of {told} (it repeats)"] = None
        filter = "nearest" if sampler.get("magFilter") == NEAREST else "bilinear"
        wrap = "clamp" if wraps == {CLAMP} else "repeat"
        return _Map(values, {"filter": filter, "wrap": wrap})

    def _rgba(self, source: int, encoding: NamedEncoding) -> np.ndarray:
        if (source, encoding) not in self._opened:
            colours, alpha = read_texels(*self._image(source), encoding)
            size = colours.shape[:2]
            alpha = np.ones((*size, 1), colours.dtype) if alpha is None else alpha
            rgba = np.concatenate([np.broadcast_to(colours, (*size, 3)), alpha], -1)
            self._hold(rgba)
            self._opened[source, encoding] = rgba
        return self._opened[source, encoding]


def _own(material: Record) -> Material | None:
    """The material that phongfit wrote into `extras`, or `None`."""
    extras = material.get("extras")
    if not isinstance(extras, dict) or "phong" not in extras:
        return None
    with naming_field("extras.phong"):
        return validated(extras["phong"], MaterialRecord).build()
