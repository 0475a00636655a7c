r"""Materials of glTF files, as Phong's: the inverse of [`phongfit.files.gltf`][].

Base colour is $\rho_d$ and $\rho_a$, and emission is emission. Roughness $r$, where a
file gives it, is $f = 2 / r^4 - 2$, and KHR_materials_specular's colour $c$ is
$\rho_s = 0.04\, c\, (f + 2) / 8$; without the extension the highlight is left to a
fit. Textures of them multiply these numbers; colours are sRGB-encoded in them. What we
wrote ourselves, in `extras`, is taken as it stands.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from phongfit.files.gltf import exponents, specular_of
from phongfit.files.gltf_records import File, GltfMaterial, Specular, TextureInfo
from phongfit.files.images import read_texels
from phongfit.files.inputs import naming_field
from phongfit.files.mtl_textures import Note, Shaded
from phongfit.files.records import validated
from phongfit.files.schema import MaterialRecord
from phongfit.material import Material
from phongfit.rendering.film import NamedEncoding
from phongfit.textures import Texture, Textures

NEAREST, REPEAT, CLAMP = 9728, 10497, 33071

OpenImage = Callable[[int], tuple[bytes, Path]]
"""The bytes of the image of a number, none if it is missing, and its name."""


class GltfShade(NamedTuple):
    """A material's name, itself, which set of uv its textures use, and is it ours?"""

    name: str | None
    shaded: Shaded
    uv_set: int | None
    own: bool


def read_shade(
    material: GltfMaterial, file: File, image: OpenImage, note: Note
) -> GltfShade:
    """A material of a glTF file.

    **Raises:** `ValueError` that says what is wrong with it.
    """
    reader = _Shading(file, image, note, _called(material))
    pbr, given = material.pbrMetallicRoughness, _own(material)
    leaves: dict[str, Any] = {}
    if given is not None:
        leaves = dict(vars(given))
    base = pbr.baseColorFactor
    if base is not None and base[3] < 1:
        note(f"{reader.name}: its transparency is not used")
    if pbr.metallicFactor:
        note(f"{reader.name}: that it is metallic is not used")
    textures: dict[str, Texture | None] = {}
    textures["diffuse"] = reader.open("baseColorTexture", pbr.baseColorTexture, "srgb")
    if given is None or textures["diffuse"] is not None:
        white = [1.0] * 3 if textures["diffuse"] is not None else None
        colour = white if base is None else base[:3]
        leaves |= {} if colour is None else {"diffuse": colour}
        if given is None and colour is not None:
            leaves["ambient"] = colour
            textures["ambient"] = textures["diffuse"]
    textures["emission"] = reader.open(
        "emissiveTexture", material.emissiveTexture, "srgb"
    )
    if material.emissiveFactor is not None and (
        given is None or textures["emission"] is not None
    ):
        leaves["emission"] = material.emissiveFactor
    reader.highlight(material, leaves, textures, own=given is not None)
    textures["normal"] = reader.normal(material.normalTexture)
    return GltfShade(
        material.name,
        Shaded(Material(**leaves), Textures(**textures)),
        reader.uv_set,
        given is not None,
    )


def _called(material: GltfMaterial) -> str:
    return "a material" if material.name is None else f"material {material.name[:60]!r}"


def _own(material: GltfMaterial) -> Material | None:
    """The material that phongfit wrote into `extras`, if it did."""
    if not isinstance(material.extras, dict) or "phong" not in material.extras:
        return None
    with naming_field("extras.phong"):
        return validated(material.extras["phong"], MaterialRecord).build()


class _Shading:
    """Textures of one material, over one set of uv."""

    def __init__(self, file: File, image: OpenImage, note: Note, name: str):
        self._file = file
        self._image = image
        self._note = note
        self.name = name
        self.uv_set: int | None = None

    def open(
        self, what: str, info: TextureInfo | None, encoding: NamedEncoding
    ) -> Texture | None:
        """One of the material's textures; `None` without, and with a note if lost."""
        if info is None:
            return None
        told = f"{self.name}: its {what}"
        if info.extensions:
            names = ", ".join(map(repr, info.extensions))
            self._note(f"{told} is placed by {names}, which is not used")
        if self.uv_set not in (None, info.texCoord):
            self._note(f"{told} has another set of uv, and is not used")
            return None
        file = self._file
        if info.index >= len(file.textures):
            raise ValueError(
                f"{what}.index: expected a number below {len(file.textures)}, got "
                f"{info.index}"
            )
        texture = file.textures[info.index]
        if texture.source is None:
            self._note(f"{told} is of an unknown format, and not used")
            return None
        data, path = self._image(texture.source)
        if not data:
            self._note(f"{told} is missing: {path}")
            return None
        values, transparent = read_texels(data, path, encoding)
        if transparent:
            self._note(f"{told} is partly transparent, which is not used")
        self.uv_set = info.texCoord
        return self._sampled(texture.sampler, values, told)

    def _sampled(self, number: int | None, values: np.ndarray, told: str) -> Texture:
        if number is None:
            return Texture(values)
        if number >= len(self._file.samplers):
            raise ValueError(f"sampler: expected a known one, got {number}")
        sampler = self._file.samplers[number]
        wraps = {sampler.wrapS, sampler.wrapT}
        if wraps not in ({REPEAT}, {CLAMP}):
            self._note(f"{told} is mirrored or wrapped by axis: it repeats instead")
        return Texture(
            values,
            "nearest" if sampler.magFilter == NEAREST else "bilinear",
            "clamp" if wraps == {CLAMP} else "repeat",
        )

    def normal(self, info: TextureInfo | None) -> Texture | None:
        """The normal map, from −1 to 1."""
        texture = self.open("normalTexture", info, "linear")
        if texture is None or info is None:
            return None
        values = (2 * np.asarray(texture.values) - 1) * [info.scale, info.scale, 1]
        return Texture(values, texture.filter, texture.wrap)

    def highlight(
        self,
        material: GltfMaterial,
        leaves: dict[str, Any],
        textures: dict[str, Texture | None],
        *,
        own: bool,
    ) -> None:
        """Exponent and specular reflectance; what is our `own` stays as it was."""
        pbr = material.pbrMetallicRoughness
        info = pbr.metallicRoughnessTexture
        rough = self.open("metallicRoughnessTexture", info, "linear")
        factor = 1.0 if pbr.roughnessFactor is None else pbr.roughnessFactor
        f: Any = exponents(factor)
        if rough is not None:
            green = np.asarray(rough.values, float)[..., 1:2]
            f = exponents(factor * green)
            highest = max(float(f.max()), 1e-6)
            leaves["shininess"] = highest
            textures["shininess"] = Texture(f / highest, rough.filter, rough.wrap)
        elif own:
            f = np.asarray(leaves["shininess"], float)
        elif pbr.roughnessFactor is not None:
            leaves["shininess"] = float(f)
        specular = material.extensions.KHR_materials_specular
        if specular is not None:
            self._specular(specular, f, rough, leaves, textures, own=own)

    def _specular(
        self,
        specular: Specular,
        f: Any,
        rough: Texture | None,
        leaves: dict[str, Any],
        textures: dict[str, Texture | None],
        *,
        own: bool,
    ) -> None:
        tint = self.open("specularColorTexture", specular.specularColorTexture, "srgb")
        if specular.specularTexture is not None:
            self._note(f"{self.name}: its specularTexture is not used")
        colour = np.array(specular.specularColorFactor) * specular.specularFactor
        if tint is None and rough is None:
            if not own:
                leaves["specular"] = specular_of(colour, f)
            return
        of = tint if tint is not None else rough
        values = np.asarray(tint.values, float) if tint is not None else 1.0
        if tint is not None and rough is not None:
            if tint.values.shape[:2] != rough.values.shape[:2]:
                self._note(
                    f"{self.name}: its specularColorTexture is not as large as its "
                    "metallicRoughnessTexture: the exponent's mean is taken for it"
                )
                f = np.exp(np.log(np.maximum(f, 1e-6)).mean())
        assert of is not None
        whole = specular_of(colour * values, f)
        highest = max(float(whole.max()), 1e-6)
        leaves["specular"] = highest
        textures["specular"] = Texture(whole / highest, of.filter, of.wrap)
