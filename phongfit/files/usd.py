r"""USD: meshes with UsdPreviewSurface, written by Pixar's library (`phongfit[usd]`).

Contents are those of a glTF file ([`phongfit.files.gltf`][] has the formulas), in the
specular workflow, where a surface has $F_0$ as a colour: $8 \rho_s / (f + 2)$. The lobe
is GGX's of the same roughness. Textures are PNG files beside the file, or inside a
`.usdz`; v points up. Colours of vertices are shown as $\rho_d$. Other parameters at
vertices are primvars with the names of phongfit's glTF attributes, which other programs
do not show. The exact material is in the custom data of its prim, as JSON text.

??? cite "Source"
    Pixar, *UsdPreviewSurface Specification*, version 2.6, 2024.
"""
# Pixar's modules have no type information.
# pyright: reportAttributeAccessIssue=false

import importlib.util
import json
import os
import re
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from phongfit.files.gltf import F0_OF_WHITE, Part, Picture
from phongfit.files.limits import lost
from phongfit.files.outputs import replacing
from phongfit.plain import plain

COLOUR = "COLOR_0"
"""Name of the glTF attribute for colours of vertices, which multiply ρ_d."""

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")


def write_usd(
    path: str | os.PathLike[str],
    parts: Sequence[tuple[Part, dict[str, Any]]],
    *,
    nearest: bool = False,
) -> None:
    """Write triangles and their materials as USD.

    **Arguments:**

    - `path`: `.usda` is text, `.usd` and `.usdc` binary, `.usdz` one file that includes
        its textures.
    - `parts`: triangles, each with a material of [`pbr_material`][], in which a
        `Picture` replaces each texture.
    - `nearest`: write textures with the filter "nearest", which USD lacks, with a
        warning instead of an error.

    **Raises:** `ValueError` for another suffix, for a texture that USD cannot hold, or
    if USD is not installed; `OSError` that names the file.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        wanted = ", ".join(SUFFIXES)
        raise ValueError(f"{path}: expected {wanted}, got {path.suffix!r}")
    if importlib.util.find_spec("pxr") is None:
        raise ValueError(
            f"{path}: USD needs usd-core, which is not installed: "
            "pip install 'phongfit[usd]'"
        )
    if path.suffix.lower() != ".usdz":
        with replacing(path) as temporary:
            _write(temporary, parts, nearest)
        return
    from pxr import UsdUtils

    with replacing(path) as temporary, tempfile.TemporaryDirectory() as folder:
        layer = Path(folder) / f"{path.stem}.usdc"
        _write(layer, parts, nearest)
        # USD's messages would name the temporary folder.
        if not UsdUtils.CreateNewUsdzPackage(str(layer), str(temporary)):
            raise OSError(f"{path}: USD could not make a package of it")


def _write(
    path: Path, parts: Sequence[tuple[Part, dict[str, Any]]], nearest: bool
) -> None:
    """Write one layer, and its textures beside it."""
    from pxr import Sdf, Usd, UsdGeom

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    # The unit of glTF.
    UsdGeom.SetStageMetersPerUnit(stage, UsdGeom.LinearUnits.meters)
    root = UsdGeom.Xform.Define(stage, "/phongfit")
    stage.SetDefaultPrim(root.GetPrim())
    file = _Stage(stage, path, nearest)
    for number, (part, material) in enumerate(parts):
        file.add(number, part, material)
    layer = Sdf.Layer.CreateNew(str(path))
    layer.TransferContent(stage.GetRootLayer())
    layer.Save()


class _Stage:
    """A stage under construction."""

    def __init__(self, stage: Any, path: Path, nearest: bool):
        self._stage = stage
        self._path = path
        self._nearest = nearest
        self._pictures = 0

    def add(self, number: int, part: Part, material: dict[str, Any]) -> None:
        """Add a mesh and its material."""
        from pxr import UsdShade

        if COLOUR in part.colours:
            # Shaders that read vertex colours apply no factor.
            factor = material["pbrMetallicRoughness"]["baseColorFactor"][:3]
            multiplied = part.colours[COLOUR] * np.asarray(factor, float)
            part = part._replace(colours=part.colours | {COLOUR: multiplied})
        mesh = self._mesh(f"/phongfit/mesh{number}", part)
        name = re.sub(r"\W", "_", material["name"], flags=re.ASCII)
        shade = self._material(f"/phongfit/material{number}_{name}", part, material)
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(shade)

    def _mesh(self, place: str, part: Part) -> Any:
        from pxr import Sdf, UsdGeom

        mesh = UsdGeom.Mesh.Define(self._stage, place)
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreatePointsAttr(_vectors(part.positions))
        mesh.CreateFaceVertexCountsAttr([3] * len(part.faces))
        mesh.CreateFaceVertexIndicesAttr(part.faces.ravel().tolist())
        ends = part.positions.min(axis=0), part.positions.max(axis=0)
        mesh.CreateExtentAttr(_vectors(np.stack(ends)))
        if part.normals is not None:
            mesh.CreateNormalsAttr(_vectors(part.normals))
            mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        arrays = dict(part.colours)
        if part.uv is not None:
            arrays["st"] = part.uv * [1, -1] + [0, 1]
        kinds, api = Sdf.ValueTypeNames, UsdGeom.PrimvarsAPI(mesh)
        for name, array in arrays.items():
            kind = kinds.TexCoord2fArray if name == "st" else kinds.Color3fArray
            primvar = api.CreatePrimvar(name, kind, UsdGeom.Tokens.vertex)
            primvar.Set(_vectors(array))
        return mesh

    def _material(self, place: str, part: Part, material: dict[str, Any]) -> Any:
        from pxr import Sdf, UsdShade

        kinds = Sdf.ValueTypeNames
        made = UsdShade.Material.Define(self._stage, place)
        made.GetPrim().SetCustomDataByKey(
            "phongfit", json.dumps(plain(material["extras"]), allow_nan=False)
        )
        surface = UsdShade.Shader.Define(self._stage, f"{place}/surface")
        surface.CreateIdAttr("UsdPreviewSurface")
        made.CreateSurfaceOutput().ConnectToSource(
            surface.ConnectableAPI(), UsdShade.Tokens.surface
        )
        surface.CreateInput("useSpecularWorkflow", kinds.Int).Set(1)
        pbr = material["pbrMetallicRoughness"]
        tint = material["extensions"]["KHR_materials_specular"]
        colours = {
            "diffuseColor": (pbr["baseColorFactor"][:3], pbr.get("baseColorTexture")),
            "specularColor": (
                F0_OF_WHITE * np.asarray(tint["specularColorFactor"]),
                tint.get("specularColorTexture"),
            ),
            "emissiveColor": (
                material["emissiveFactor"],
                material.get("emissiveTexture"),
            ),
        }
        for name, (factor, picture) in colours.items():
            source = surface.CreateInput(name, kinds.Color3f)
            if picture is not None:
                rgb = self._texture(f"{place}/{name}", picture, "sRGB", factor)
                source.ConnectToSource(rgb.CreateOutput("rgb", kinds.Float3))
            elif name == "diffuseColor" and COLOUR in part.colours:
                reader = self._reader(f"{place}/colours", COLOUR, "float3")
                source.ConnectToSource(reader.CreateOutput("result", kinds.Float3))
            else:
                source.Set(_vectors(np.asarray([factor], float))[0])
        rough = surface.CreateInput("roughness", kinds.Float)
        picture, factor = pbr.get("metallicRoughnessTexture"), pbr["roughnessFactor"]
        if picture is None:
            rough.Set(float(factor))
        else:
            green = self._texture(f"{place}/roughness", picture, "raw", [factor] * 3)
            rough.ConnectToSource(green.CreateOutput("g", kinds.Float))
        if (picture := material.get("normalTexture")) is not None:
            normal = surface.CreateInput("normal", kinds.Normal3f)
            bent = self._texture(f"{place}/normal", picture, "raw", [2] * 3, -1)
            normal.ConnectToSource(bent.CreateOutput("rgb", kinds.Float3))
        return made

    def _reader(self, place: str, primvar: str, kind: str) -> Any:
        from pxr import Sdf, UsdShade

        reader = UsdShade.Shader.Define(self._stage, place)
        reader.CreateIdAttr(f"UsdPrimvarReader_{kind}")
        reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set(primvar)
        return reader

    def _texture(
        self, place: str, picture: Picture, space: str, factor: Any, bias: float = 0.0
    ) -> Any:
        """A shader of a texture at uv `st`, multiplied by a factor, plus a bias."""
        from pxr import Gf, Sdf, UsdShade

        if picture.nearest:
            lost("filter: USD knows no nearest texel", self._nearest)
        kinds = Sdf.ValueTypeNames
        file = f"{self._path.stem}_{self._pictures}.png"
        self._pictures += 1
        (self._path.parent / file).write_bytes(picture.png)
        texture = UsdShade.Shader.Define(self._stage, place)
        texture.CreateIdAttr("UsdUVTexture")
        texture.CreateInput("file", kinds.Asset).Set(f"./{file}")
        texture.CreateInput("sourceColorSpace", kinds.Token).Set(space)
        for side in ("wrapS", "wrapT"):
            wrap = "repeat" if picture.repeat else "clamp"
            texture.CreateInput(side, kinds.Token).Set(wrap)
        scale = Gf.Vec4f(*map(float, factor), 1.0)
        texture.CreateInput("scale", kinds.Float4).Set(scale)
        if bias:
            texture.CreateInput("bias", kinds.Float4).Set(Gf.Vec4f(bias))
        st = self._reader(f"{place}_st", "st", "float2")
        texture.CreateInput("st", kinds.Float2).ConnectToSource(
            st.CreateOutput("result", kinds.Float2)
        )
        return texture


def _vectors(array: np.ndarray) -> Any:
    """Rows of two or three numbers as a USD array."""
    from pxr import Vt

    rows = np.ascontiguousarray(array, np.float32)
    kind = Vt.Vec2fArray if rows.shape[1] == 2 else Vt.Vec3fArray
    return kind.FromNumpy(rows)
