"""Exported USD, as Pixar's own library reads it."""
# Its modules do not say what is in them.
# pyright: reportAttributeAccessIssue=false

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import phongfit as pf
from phongfit.__main__ import main
from phongfit.files.gltf import exponents
from phongfit.files.images import read_texels
from tests.helpers import near

pytest.importorskip("pxr.Usd", reason="usd-core is not installed")
from pxr import Usd, UsdGeom, UsdShade, UsdValidation  # noqa: E402

pytestmark = pytest.mark.extended

RNG = np.random.default_rng(0)
CORNERS = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.5]], float)
FACES = np.array([[0, 1, 2], [0, 2, 3]])
UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], float)[FACES]
DIFFUSE, SPECULAR = RNG.uniform(0.1, 0.9, (4, 6, 3)), RNG.uniform(0, 0.5, (4, 6, 3))
SHININESS = RNG.uniform(0.1, 1, (4, 6, 1))
NORMAL = np.broadcast_to([0.6, 0.0, 0.8], (2, 2, 3))
PAINT = RNG.uniform(0, 1, (4, 3))


def square(**textures: Any) -> pf.Mesh:
    """Two triangles of a material each; the first has the textures."""
    of_first = pf.Textures(**textures)
    return pf.Mesh(
        CORNERS,
        FACES,
        material_index=np.array([0, 1]),
        uv=UV,
        textures=(of_first, pf.Textures()),
    )


def material(**leaves: Any) -> pf.Material:
    given = {"diffuse": 0.5, "specular": 0.3, "shininess": 60.0, "ambient": 0.2}
    return pf.Material(**(given | leaves))


def inputs(stage: Any, number: int = 0) -> dict[str, Any]:
    """A material's numbers; where a texture or vertices have them, its shader."""
    bound = UsdShade.MaterialBindingAPI(
        stage.GetPrimAtPath(f"/phongfit/mesh{number}")
    ).ComputeBoundMaterial()[0]
    surface, *_ = bound.ComputeSurfaceSource()
    assert surface.GetIdAttr().Get() == "UsdPreviewSurface"
    found = {}
    for one in surface.GetInputs():
        if one.HasConnectedSource():
            found[one.GetBaseName()] = UsdShade.Shader(
                one.GetConnectedSources()[0][0].source.GetPrim()
            )
        else:
            found[one.GetBaseName()] = one.Get()
    return found


def texels(shader: Any) -> np.ndarray:
    """What a texture says, as the specification has it: value · scale + bias."""
    assert shader.GetIdAttr().Get() == "UsdUVTexture"
    path = Path(shader.GetInput("file").Get().resolvedPath)
    space = shader.GetInput("sourceColorSpace").Get()
    encoding = "srgb" if space == "sRGB" else "linear"
    values = read_texels(path.read_bytes(), path, encoding).values
    scale = np.array(shader.GetInput("scale").Get())[:3]
    bias = shader.GetInput("bias")
    moved = np.array(bias.Get())[:3] if bias else 0.0
    return np.asarray(values, float) * scale + moved


def is_valid(stage: Any) -> None:
    """Pixar's own rules have nothing to say."""
    rules = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    said = UsdValidation.ValidationContext(rules).Validate(stage)
    assert len(rules) > 10 and [one.GetMessage() for one in said] == []


@pytest.mark.parametrize("suffix", [".usda", ".usd", ".usdc"])
def test_numbers_of_materials_and_the_mesh(tmp_path, suffix):
    path = tmp_path / f"square{suffix}"
    two = material(
        diffuse=[[0.5, 0.4, 0.3], [0.1, 0.2, 0.3]], shininess=[[60.0], [9.0]]
    )
    pf.save_mesh(path, square(), two, ("white paint", "2nd"))
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and stage.GetDefaultPrim()
    for number, (colour, f) in enumerate(
        [([0.5, 0.4, 0.3], 60.0), ([0.1, 0.2, 0.3], 9.0)]
    ):
        found = inputs(stage, number)
        assert found["useSpecularWorkflow"] == 1
        near(found["diffuseColor"], colour, 1e-6)
        near(exponents(found["roughness"]), f, 1e-4)
        # The peak of a lobe of F₀ is F₀ (f + 2) / 8.
        near(np.array(found["specularColor"]) * (f + 2) / 8, [0.3] * 3, 1e-5)
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/phongfit/mesh{number}"))
        points = np.array(mesh.GetPointsAttr().Get())
        corners = points[np.array(mesh.GetFaceVertexIndicesAttr().Get())]
        near(corners, CORNERS[FACES[number]], 1e-6)
        assert mesh.GetSubdivisionSchemeAttr().Get() == "none"
        st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
        places = np.array(st.Get())[np.array(mesh.GetFaceVertexIndicesAttr().Get())]
        # Its v runs up.
        near(places * [1, -1] + [0, 1], UV[number], 1e-6)
    prims = {one.GetName(): one for one in stage.Traverse()}
    record = json.loads(prims["material0_white_paint"].GetCustomDataByKey("phongfit"))
    near(record["phong"]["ambient"], 0.2)
    assert "material1_2nd" in prims


def test_textures_come_back(tmp_path):
    bent = pf.Texture(NORMAL)
    mesh = square(
        diffuse=pf.Texture(DIFFUSE, wrap="clamp"),
        specular=pf.Texture(SPECULAR),
        shininess=pf.Texture(SHININESS),
        normal=bent,
    )
    pf.save_mesh(tmp_path / "a.usda", mesh, material(), nearest=False)
    names = sorted(one.name for one in tmp_path.iterdir())
    assert names == ["a.usda", *(f"a_{k}.png" for k in range(4))]
    stage = Usd.Stage.Open(f"{tmp_path}/a.usda")
    is_valid(stage)
    found = inputs(stage)
    near(texels(found["diffuseColor"]), 0.5 * DIFFUSE, 2e-4)
    assert found["diffuseColor"].GetInput("wrapS").Get() == "clamp"
    assert found["specularColor"].GetInput("wrapT").Get() == "repeat"
    rough = texels(found["roughness"])[..., 1:2]
    f = 60 * SHININESS
    near(exponents(rough) / f, np.ones_like(f), 2e-3)
    near(texels(found["specularColor"]) * (f + 2) / 8, 0.3 * SPECULAR, 2e-3)
    near(texels(found["normal"]), NORMAL, 1e-4)
    # Of the other material there are numbers alone.
    near(inputs(stage, 1)["diffuseColor"], [0.5] * 3)


def test_colours_of_vertices(tmp_path):
    mesh = square(diffuse=pf.VertexColours(PAINT))
    pf.save_mesh(tmp_path / "a.usda", mesh, material(diffuse=[0.9, 0.5, 0.2]))
    stage = Usd.Stage.Open(f"{tmp_path}/a.usda")
    reader = inputs(stage)["diffuseColor"]
    assert reader.GetIdAttr().Get() == "UsdPrimvarReader_float3"
    name = reader.GetInput("varname").Get()
    own = UsdGeom.Mesh(stage.GetPrimAtPath("/phongfit/mesh0"))
    index = np.array(own.GetFaceVertexIndicesAttr().Get())
    colours = np.array(UsdGeom.PrimvarsAPI(own).GetPrimvar(name).Get())[index]
    near(colours, PAINT[FACES[0]] * [0.9, 0.5, 0.2], 1e-5)


def test_one_file_with_its_pictures(tmp_path):
    mesh = square(diffuse=pf.Texture(DIFFUSE))
    pf.save_mesh(tmp_path / "a.usdz", mesh, material())
    assert [one.name for one in tmp_path.iterdir()] == ["a.usdz"]
    stage = Usd.Stage.Open(f"{tmp_path}/a.usdz")
    file = inputs(stage)["diffuseColor"].GetInput("file").Get().resolvedPath
    assert file.endswith("a.usdz[a_0.png]")
    is_valid(stage)


def test_what_usd_does_not_hold_is_named(tmp_path):
    mesh = square(diffuse=pf.Texture(DIFFUSE, "nearest"))
    with pytest.raises(ValueError, match="filter: USD knows no nearest texel"):
        pf.save_mesh(tmp_path / "a.usda", mesh, material())
    assert not any(tmp_path.iterdir())
    with pytest.warns(UserWarning, match="filter: USD knows no nearest texel"):
        pf.save_mesh(tmp_path / "a.usda", mesh, material(), nearest=True)


def test_by_the_command(tmp_path, capsys):
    assert main(["export", "preset:gold", "-o", f"{tmp_path}/gold.usda"]) == 0
    gold = pf.preset("gold")
    found = inputs(Usd.Stage.Open(f"{tmp_path}/gold.usda"))
    near(found["diffuseColor"], np.ravel(gold.diffuse), 1e-5)
    near(exponents(found["roughness"]), float(np.ravel(gold.shininess)[0]), 1e-3)
    # A mesh, too.
    pf.save_mesh(tmp_path / "a.glb", square(), material())
    assert main(["export", f"{tmp_path}/a.glb", "-o", f"{tmp_path}/a.usdc"]) == 0
    assert capsys.readouterr().out.endswith("a.glb, 2 materials\n")
    near(inputs(Usd.Stage.Open(f"{tmp_path}/a.usdc"), 1)["diffuseColor"], [0.5] * 3)


def test_without_the_library(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install 'phongfit\[usd\]'"):
        pf.save_mesh(tmp_path / "a.usda", square(), material())
    assert not any(tmp_path.iterdir())
