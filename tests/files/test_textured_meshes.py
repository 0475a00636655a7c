"""Meshes with uv and textures: what files say is what is rendered, or is named."""

import json
import warnings
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

import phongfit as pf
from phongfit.codes import REMEDIES
from phongfit.files.formats import encode_png
from phongfit.files.gltf import exponents, roughness, specular_colour, specular_of
from phongfit.rendering.film import decode
from tests.files.test_gltf_reading import binary, triangle
from tests.helpers import known, near

# A square whose uv has the image upright, as OBJ counts v.
OBJ = """mtllib square.mtl
v -1 -1 0
v 1 -1 0
v 1 1 0
v -1 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl paper
f 1/1 2/2 3/3
f 1/1 3/3 4/4
"""
BOX = trimesh.creation.box()
LEVELS = np.random.default_rng(0).integers(0, 256, (4, 4, 3), np.uint8)
CAMERA = pf.OrthographicCamera(8, 8, view_height=2)
SMALL = pf.OrthographicCamera(4, 4, view_height=2)
WHITE = pf.DirectionalLight((0, 0, 1))
# A .gltf is what a .glb holds, in a file of text.
SAVED = ["obj", "glb", pytest.param("gltf", marks=pytest.mark.extended)]


def write(folder, library, **images):
    (folder / "square.obj").write_text(OBJ)
    (folder / "square.mtl").write_text(f"newmtl paper\n{library}\n")
    for name, levels in images.items():
        (folder / f"{name}.png").write_bytes(encode_png(levels))
    return folder / "square.obj"


def at_texels(texture, levels):
    """Is the texture upright, as it is rendered?"""
    near(np.asarray(known(texture).values), levels, 1e-4)


def test_an_obj_with_all_its_maps(tmp_path):
    grey = np.full((2, 2), 128, np.uint8)
    bent = np.broadcast_to(np.array([204, 128, 230], np.uint8), (2, 2, 3))
    path = write(
        tmp_path,
        "Ka 1 1 1\nKd 0.5 0.5 0.5\nNs 200\nmap_Ka a b.png\nmap_Kd -s 1 1 2 c.png\n"
        "map_Ks c.png\nmap_Ns grey.png\nmap_Bump -bm 0.5 bent.png\nmap_d grey.png",
        **{"a b": LEVELS, "c": LEVELS, "grey": grey, "bent": bent},
    )
    with pytest.warns(UserWarning) as said:
        mesh, material, names = pf.load_mesh(path)
    words = [str(one.message) for one in said]
    # Each thing that is not used is named, once.
    assert len(words) == 3
    assert "square.mtl: not used: map_d (line 10)" in words[0]
    assert "square.mtl: line 6: texture 'c.png' of material 'paper'" in words[1]
    assert "options -s are not used" in words[1] and "options -bm" in words[2]
    assert names == ("paper",) and mesh.vertices.shape == (4, 3)
    (textures,) = known(mesh.textures)
    light = decode(LEVELS / 255.0, "srgb")
    for texture in (textures.ambient, textures.diffuse, textures.specular):
        at_texels(texture, light)
    near(known(textures.shininess).values, np.full((2, 2, 1), 128 / 255), 1e-4)
    normal = np.asarray(known(textures.normal).values)[0, 0]
    near(normal, 2 * np.array([204, 128, 230]) / 255 - 1, 1e-4)
    # A number that the library leaves out is 1, which the texture multiplies.
    near(material.specular, 1)
    near(material.diffuse, 0.5)
    flat = mesh.with_textures(pf.Textures(diffuse=textures.diffuse))
    image = pf.render(pf.Scene(flat, SMALL, WHITE), pf.Material(0.5, ambient=0.0))
    near(np.asarray(image), 0.5 * light, 1e-4)


@pytest.mark.parametrize(
    "line, words",
    [
        ("map_Kd none.png", "texture 'none.png' of material 'paper' is missing"),
        ("map_Kd ../d.png", "texture '../d.png' .* is missing"),
        ("map_Kd broken.png", "'broken.png' .* cannot be read, and is not used: .*"),
        ("map_Kd c.dds", "'c.dds' .* cannot be read, and is not used: .*suffix '.dds'"),
        ("map_Bump grey.png", "holds heights, which are not used"),
        ("map_Ns c.png", "there is no Ns that it multiplies"),
        ("refl c.png", r"not used: refl \(line 2\)"),
    ],
)
def test_maps_that_are_not_used(tmp_path, line, words):
    path = write(tmp_path, line, c=LEVELS, grey=np.full((2, 2), 99, np.uint8))
    (tmp_path / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\nbroken")
    (tmp_path / "c.dds").write_bytes(b"DDS ")
    with pytest.warns(UserWarning, match=words):
        assert pf.load_mesh(path).mesh.textures is None


@pytest.mark.parametrize(
    "line",
    [
        'map_Kd "two words.png"',
        "map_Kd\ttwo words.png",
        "map_Kd folder\\c#1.png",
        "map_Kd C:\\work\\Two Words.PNG",
        "map_Kd ../elsewhere/two words.png",
        "map_Kd two words.png -clamp on -s 1 1.0",
        "map_Kd -o 0 0 -mm 0 1 -clamp on two words.png",
        "map_Kd " + "a/" * 3000 + "two words.png",
    ],
)
def test_names_of_textures(tmp_path, line):
    path = write(tmp_path, line, **{"two words": LEVELS})
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "c#1.png").write_bytes(encode_png(LEVELS))
    (texture,) = known(pf.load_mesh(path).mesh.textures)
    at_texels(texture.diffuse, decode(LEVELS / 255.0, "srgb"))
    assert isinstance(texture.diffuse, pf.Texture)
    assert texture.diffuse.wrap == ("clamp" if "on" in line else "repeat")


@pytest.mark.parametrize("suffix", ["tga", "bmp", "gif", "webp", "jpg"])
def test_formats_of_textures(tmp_path, suffix):
    path = write(tmp_path, f"map_Kd c.{suffix}")
    colour = (200, 60, 20)
    picture = Image.new("RGB", (4, 4), colour)
    if suffix == "jpg":
        picture = picture.convert("CMYK")
    picture.save(tmp_path / f"c.{suffix}")
    (textures,) = known(pf.load_mesh(path).mesh.textures)
    light = decode(np.array(colour) / 255.0, "srgb")
    values = np.asarray(known(textures.diffuse).values)
    near(values, np.broadcast_to(light, (4, 4, 3)), 0.03)


def test_a_texture_that_is_multiplied_by_0(tmp_path):
    path = write(tmp_path, "Kd 0 0 0\nmap_Kd c.png", c=LEVELS)
    with pytest.warns(UserWarning, match="multiplied by Kd 0, which is taken as 1"):
        near(pf.load_mesh(path).material.diffuse, 1)


def test_a_texture_that_is_shown_as_it_is(tmp_path):
    """With `illum 0` Kd and its texture are emission."""
    path = write(tmp_path, "Kd 0.5 0.5 0.5\nillum 0\nmap_Kd c.png", c=LEVELS)
    loaded = pf.load_mesh(path)
    near(loaded.material.emission, 0.5)
    near(loaded.material.diffuse, 0)
    textures = known(loaded.mesh.textures)[0]
    assert textures.diffuse is None and textures.emission is not None


def test_a_specular_map_that_holds_roughness(tmp_path):
    """As nvdiffrec writes it: green is roughness there, and no highlight."""
    lines = "map_Ks c.png\nbsdf   pbr\nKs 0 0.5 0\nmap_Kd c.png"
    path = write(tmp_path, lines, c=LEVELS)
    with pytest.warns(UserWarning, match="map_Ks is roughness and metalness, by"):
        mesh, material, _ = pf.load_mesh(path)
    near(material.specular, 0)
    (textures,) = known(mesh.textures)
    assert textures.specular is None and textures.diffuse is not None


def test_lines_of_an_obj_that_are_not_used(tmp_path):
    path = write(tmp_path, "Kd 1 1 1")
    path.write_text(OBJ + "l 1 2\np 1\nl 2 3\n")
    with pytest.warns(UserWarning, match="its lines of 'l', 'p' are not used"):
        mesh = pf.load_mesh(path).mesh
    assert mesh.uv is not None and mesh.textures is None


def test_a_ply_with_uv_and_a_picture(tmp_path):
    (tmp_path / "c.png").write_bytes(encode_png(LEVELS))
    corners = ["-1 -1 0 0 0 9", "1 -1 0 1 0 9", "1 1 0 1 1 9", "-1 1 0 0 1 9"]
    head = ["ply", "format ascii 1.0", "comment TextureFile c.png", "element vertex 4"]
    head += [f"property float {name}" for name in ("x", "y", "z", "s", "t", "quality")]
    head += ["element face 2", "property list uchar int vertex_indices", "end_header"]
    faces = ["3 0 1 2", "3 0 2 3"]
    (tmp_path / "a.ply").write_text("\n".join([*head, *corners, *faces, ""]))
    with pytest.warns(UserWarning, match="not used: quality of vertex"):
        mesh, material, _ = pf.load_mesh(tmp_path / "a.ply")
    scene = pf.Scene(mesh, SMALL, WHITE)
    light = decode(LEVELS / 255.0, "srgb")
    near(np.asarray(pf.render(scene, material)), light, 1e-4)


def gltf(folder, material: dict[str, Any], images: dict[str, np.ndarray], **changes):
    """A triangle with uv and one material, whose textures are files beside it."""
    uv = np.array([[0, 0], [1, 0], [0, 1]], "f4")
    content = binary(triangle(), TEXCOORD_0=uv)
    content["meshes"][0]["primitives"][0]["material"] = 0
    content |= {
        "materials": [material],
        "images": [{"uri": f"{name}.png"} for name in images],
        "textures": [{"source": k, "sampler": 0} for k in range(len(images))],
        "samplers": [{"magFilter": 9728, "wrapS": 33071, "wrapT": 33071}],
    }
    for name, levels in images.items():
        (folder / f"{name}.png").write_bytes(encode_png(levels))
    (folder / "a.gltf").write_text(json.dumps(content | changes))
    return folder / "a.gltf"


def test_gltf_textures(tmp_path):
    rough = np.zeros((2, 2, 3), np.uint8)
    rough[..., 1] = 128
    up = np.broadcast_to(np.array([128, 204, 230], np.uint8), (2, 2, 3))
    material = {
        "pbrMetallicRoughness": {
            "baseColorFactor": [0.5, 0.5, 0.5, 1],
            "baseColorTexture": {"index": 0},
            "roughnessFactor": 0.8,
            "metallicFactor": 0,
            "metallicRoughnessTexture": {"index": 1},
        },
        "normalTexture": {"index": 2},
        "emissiveFactor": [0.1, 0.1, 0.1],
        "emissiveTexture": {"index": 0},
        "extensions": {"KHR_materials_specular": {"specularColorFactor": [1, 1, 0.5]}},
    }
    path = gltf(
        tmp_path,
        material,
        {"base": LEVELS, "rough": rough, "up": up},
        extensionsUsed=["KHR_materials_specular"],
    )
    mesh, material, _ = pf.load_mesh(path)
    (textures,) = known(mesh.textures)
    light = decode(LEVELS / 255.0, "srgb")
    for name in ("diffuse", "ambient", "emission"):
        at_texels(getattr(textures, name), light)
        assert getattr(textures, name).filter == "nearest"
        assert getattr(textures, name).wrap == "clamp"
    near(material.diffuse, 0.5)
    near(material.emission, 0.1)
    f = 2 / (0.8 * 128 / 255) ** 4 - 2
    near(
        material.shininess * known(textures.shininess).values,
        np.full((2, 2, 1), f),
        1e-4,
    )
    wanted = 0.04 * np.array([1, 1, 0.5]) * (f + 2) / 8
    near(material.specular * known(textures.specular).values[0, 0], wanted, 1e-4)
    near(
        known(textures.normal).values[0, 0],
        2 * np.array([128, 204, 230]) / 255 - 1,
        1e-4,
    )
    near(mesh.uv, [[[0, 0], [1, 0], [0, 1]]])


def test_parts_of_a_gltf_that_are_not_used_are_listed(tmp_path):
    moved = {"KHR_texture_transform": {"offset": [0.5, 0]}}
    material = {
        "name": "glass",
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}},
        "emissiveFactor": [1, 1, 1],
        "emissiveTexture": {"index": 0, "texCoord": 1},
        "normalTexture": {"index": 0, "extensions": moved},
        "occlusionTexture": {"index": 0},
        "alphaMode": "BLEND",
        "doubleSided": False,
        "extensions": {"KHR_materials_sheen": {}},
    }
    path = gltf(
        tmp_path,
        material,
        {"clear": np.full((2, 2, 4), 100, np.uint8)},
        skins=[{"joints": [0]}],
        samplers=[{"wrapS": 33648}],
    )
    content = json.loads(path.read_text())
    primitive = content["meshes"][0]["primitives"][0]
    primitive["attributes"] |= {"COLOR_0": 0, "TEXCOORD_2": 1, "JOINTS_0": 0}
    primitive["targets"] = [{"POSITION": 0}]
    path.write_text(json.dumps(content))
    with pytest.warns(UserWarning) as said:
        pf.load_mesh(path)
    (warning,) = said
    remedy = f". {REMEDIES['part-unused']} [part-unused]"
    listed = str(warning.message).removeprefix(f"{path}: not used: ")
    assert listed.removesuffix(remedy).split(", ") == [
        "the wrapping of baseColorTexture of material 'glass' (it repeats)",
        "the mirror image in material 'glass'",
        "a metal (its base colour is its specular reflectance)",
        "emissiveTexture of material 'glass' (its uv differ from those of another)",
        "normalTexture of material 'glass' (its uv differ from those of another)",
        "attributes.COLOR_0 where there is a texture",
        "attributes.TEXCOORD_2",
        "attributes.JOINTS_0",
        "skins",
        "morph targets",
        "occlusionTexture",
        "alphaMode",
        "KHR_materials_sheen",
    ]


MATTE = {"metallicFactor": 0}


def test_no_metal_without_the_texture_that_tells_where(tmp_path):
    rough = {"pbrMetallicRoughness": {"metallicRoughnessTexture": {"index": 0}}}
    path = gltf(tmp_path, rough, {"rough": LEVELS})
    (tmp_path / "rough.png").unlink()
    with pytest.warns(UserWarning, match="metallicFactor of a material, which needs"):
        near(pf.load_mesh(path).material.diffuse, 1)


def test_gltf_textures_that_cannot_be_read(tmp_path):
    base = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}} | MATTE}
    path = gltf(tmp_path, base, {"base": LEVELS})
    for content, words in (
        (b"RIFF\x1a\0\0\0WEBPVP8L", "base.webp: is broken or no .webp"),
        (b"\x89PNG\r\n\x1a\nbroken", "base.webp: is broken"),
        (None, "base.webp: cannot be read: No such file"),
    ):
        (tmp_path / "base.webp").unlink(missing_ok=True)
        if content is not None:
            (tmp_path / "base.webp").write_bytes(content)
        path.write_text(path.read_text().replace("base.png", "base.webp"))
        match = rf"a.gltf: not used: baseColorTexture of a material \(.*{words}"
        with pytest.warns(UserWarning, match=match):
            assert pf.load_mesh(path).mesh.textures is None
    path = gltf(tmp_path, base, {"base": LEVELS}, textures=[{}])
    with pytest.warns(UserWarning, match="of an unknown format"):
        pf.load_mesh(path)
    path = gltf(tmp_path, base, {"base": LEVELS}, textures=[])
    with pytest.raises(ValueError, match="baseColorTexture.index: expected"):
        pf.load_mesh(path)


def no_texture(folder, material: dict[str, Any], **changes) -> pf.Material:
    """A material of a glTF file, with the warning that a metal is given."""
    metal = material.get("pbrMetallicRoughness", {}).get("metallicFactor", 1) > 0
    plain = "KHR_materials_pbrSpecularGlossiness" in material.get("extensions", {})
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        loaded = pf.load_mesh(gltf(folder, material, {}, **changes))
    words = "the mirror image in a material, a metal"
    assert [words in str(one.message) for one in said] == [True] * (metal and not plain)
    return loaded.material


BRASS = {"baseColorFactor": [0.8, 0.6, 0.2, 1], "roughnessFactor": 0.5}
COLOUR = np.array([0.8, 0.6, 0.2])
# A roughness of 1/2 is an exponent of 2 ⋅ 16 - 2 = 30: (f + 2) / 8 = 4.
GLTF_MATERIALS = [
    ({"pbrMetallicRoughness": BRASS}, 0, 4 * COLOUR, 30, COLOUR),
    (
        {"pbrMetallicRoughness": BRASS | {"metallicFactor": 0.5}},
        COLOUR / 2,
        4 * (0.02 + COLOUR / 2),
        30,
        COLOUR,
    ),
    ({"pbrMetallicRoughness": BRASS | MATTE}, COLOUR, 0.16, 30, COLOUR),
    # A material without any key: white, metallic, of roughness 1.
    ({}, 0, 0.25, 0, 1),
    (
        {
            "pbrMetallicRoughness": BRASS | MATTE,
            "extensions": {
                "KHR_materials_ior": {"ior": 2},
                "KHR_materials_specular": {
                    "specularFactor": 0.5,
                    "specularColorFactor": [1, 0.5, 0],
                },
            },
        },
        COLOUR,
        4 * np.array([1, 0.5, 0]) / 18,
        30,
        COLOUR,
    ),
    (
        {
            "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]},
            "extensions": {
                "KHR_materials_pbrSpecularGlossiness": {
                    "diffuseFactor": [0.8, 0.1, 0.1, 1],
                    "specularFactor": [0.2, 0.1, 0.3],
                    "glossinessFactor": 0.5,
                }
            },
        },
        np.array([0.8, 0.1, 0.1]),
        4 * np.array([0.2, 0.1, 0.3]),
        30,
        np.array([0.8, 0.1, 0.1]),
    ),
]
"""Materials, and their ρ_d, ρ_s, f and ρ_a."""


@pytest.mark.parametrize("case", range(len(GLTF_MATERIALS)))
def test_materials_of_gltf(tmp_path, case):
    given, diffuse, specular, shininess, ambient = GLTF_MATERIALS[case]
    for required in ([], list(given.get("extensions", {}))):
        material = no_texture(tmp_path, given, extensionsRequired=required)
        near(material.diffuse, diffuse * np.ones(3))
        near(material.specular, specular * np.ones(3), 1e-5)
        near(material.shininess, [shininess], 1e-4)
        near(material.ambient, ambient * np.ones(3))


def test_emission_of_gltf_has_a_strength(tmp_path):
    strong = {"KHR_materials_emissive_strength": {"emissiveStrength": 5}}
    given = {"emissiveFactor": [0.1, 0.2, 0], "extensions": strong}
    given["pbrMetallicRoughness"] = MATTE
    near(no_texture(tmp_path, given).emission, [0.5, 1, 0])


def levels(*channels: Any) -> np.ndarray:
    """Whole numbers of 8 bits, (H, W, channels)."""
    each = np.broadcast_arrays(*channels)
    return np.stack(each, axis=-1).astype(np.uint8)


def test_occlusion_roughness_and_metallic_in_one_texture(tmp_path):
    """The left half is brass, the right half paint; base colour is a smaller image."""
    metal = np.repeat([[255, 255, 0, 0]], 4, axis=0)
    pbr = {
        "baseColorTexture": {"index": 0},
        "metallicRoughnessTexture": {"index": 1},
        "roughnessFactor": 0.5,
    }
    path = gltf(
        tmp_path,
        {"pbrMetallicRoughness": pbr},
        {
            "base": levels([[255, 0], [255, 0]], [[0, 255], [0, 255]], 0),
            "orm": levels(9, 255, metal),
        },
    )
    with pytest.warns(UserWarning, match="the mirror image in a material, a metal"):
        mesh, material, _ = pf.load_mesh(path)
    (textures,) = known(mesh.textures)
    red, green, paint = [1.0, 0, 0], [0, 1.0, 0], [0.04] * 3

    def first_row(leaf: str) -> np.ndarray:
        rows = np.asarray(known(getattr(textures, leaf)).values)[0]
        return np.asarray(getattr(material, leaf)) * rows

    near(first_row("diffuse"), [[0] * 3] * 2 + [green] * 2)
    near(first_row("specular"), 4 * np.array([red, red, paint, paint]), 1e-5)
    near(first_row("shininess"), np.full((4, 1), 30), 1e-4)
    near(first_row("ambient"), [red, green])


def test_specular_and_glossiness_in_one_texture(tmp_path):
    gloss = {
        "diffuseTexture": {"index": 0},
        "specularGlossinessTexture": {"index": 1},
        "specularFactor": [0.5, 0.5, 0.5],
    }
    both = levels([[255, 255]], 0, 0, [[0, 127.5 + 0.5]])
    path = gltf(
        tmp_path,
        {"extensions": {"KHR_materials_pbrSpecularGlossiness": gloss}},
        {"base": LEVELS, "both": both},
    )
    mesh, material, _ = pf.load_mesh(path)
    (textures,) = known(mesh.textures)
    at_texels(textures.diffuse, decode(LEVELS / 255.0, "srgb"))
    near(material.diffuse, np.ones(3))
    f = 2 / np.array([1, 127 / 255]) ** 4 - 2
    near(material.shininess * known(textures.shininess).values[0, :, 0], f, 1e-3)
    wanted = 0.5 * (f + 2) / 8
    near(material.specular * known(textures.specular).values[0, :, 0], wanted, 1e-3)


@pytest.mark.parametrize(
    "transform, uv",
    [
        ({"offset": [0.5, 0.25]}, [[0.5, 0.25], [1.5, 0.25], [0.5, 1.25]]),
        ({"scale": [2, 3]}, [[0, 0], [2, 0], [0, 3]]),
        # Counter-clockwise, where v runs down: u turns to -v.
        ({"rotation": np.pi / 2}, [[0, 0], [0, -1], [1, 0]]),
        (
            {"offset": [0.5, 0], "rotation": np.pi / 2, "scale": [2, 3]},
            [[0.5, 0], [0.5, -2], [3.5, 0]],
        ),
        ({"texCoord": 1}, [[1, 1], [0, 1], [1, 0]]),
    ],
)
def test_transforms_of_gltf_textures(tmp_path, transform, uv):
    info = {"index": 0, "extensions": {"KHR_texture_transform": transform}}
    pbr = {"baseColorTexture": info} | MATTE
    path = gltf(
        tmp_path,
        {"pbrMetallicRoughness": pbr},
        {"base": LEVELS},
        extensionsRequired=["KHR_texture_transform"],
    )
    content = json.loads(path.read_text())
    if "texCoord" in transform:
        other = np.array([[1, 1], [0, 1], [1, 0]], "f4")
        path.write_text(json.dumps(binary(content, TEXCOORD_1=other)))
        with pytest.warns(UserWarning, match="not used: attributes.TEXCOORD_0"):
            mesh = pf.load_mesh(path).mesh
    else:
        mesh = pf.load_mesh(path).mesh
    near(mesh.uv, [uv], 1e-6)


def test_colours_of_vertices_of_a_metal(tmp_path):
    path = gltf(tmp_path, {"pbrMetallicRoughness": BRASS}, {})
    rows = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255]], "u1")
    path.write_text(json.dumps(binary(json.loads(path.read_text()), COLOR_0=rows)))
    with pytest.warns(UserWarning, match="the mirror image in a material, a metal"):
        mesh = pf.load_mesh(path).mesh
    (textures,) = known(mesh.textures)
    near(known(textures.specular).values, np.eye(3))


def test_gltf_textures_of_many_materials_are_bounded(tmp_path, monkeypatch):
    pbr = {"metallicRoughnessTexture": {"index": 0}} | MATTE
    image = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    path = gltf(tmp_path, {}, {"rough": image})
    content = json.loads(path.read_text())
    content["materials"] = [{"pbrMetallicRoughness": pbr}] * 500
    (primitive,) = content["meshes"][0]["primitives"]
    each = [primitive | {"material": k} for k in range(500)]
    content["meshes"][0]["primitives"] = each
    path.write_text(json.dumps(content))
    monkeypatch.setenv("PHONGFIT_MAX_MEMORY", "4M")
    with pytest.raises(ValueError, match="a.gltf: .*at most 4 MB .* textures"):
        pf.load_mesh(path)


def test_a_glb_with_its_texture_inside(tmp_path):
    box = trimesh.creation.box()
    uv = np.random.default_rng(0).uniform(size=(8, 2))
    look = PBRMaterial(baseColorTexture=Image.fromarray(LEVELS), metallicFactor=0.0)
    box.visual = TextureVisuals(uv, material=look)
    content = box.export(file_type="glb")
    assert isinstance(content, bytes)
    (tmp_path / "a.glb").write_bytes(content)
    mesh = pf.load_mesh(tmp_path / "a.glb").mesh
    (textures,) = known(mesh.textures)
    at_texels(textures.diffuse, decode(LEVELS / 255.0, "srgb"))
    # trimesh counts v upwards.
    near(known(mesh.uv), (uv * [1, -1] + [0, 1])[np.asarray(box.faces)], 1e-5)


def test_roughness_and_exponent_are_inverse():
    f = np.array([1.0, 8.0, 60.0, 900.0])
    near(exponents(roughness(f)), f, 1e-6)
    near(specular_of(specular_colour(0.3, f), f), 0.3)
    assert exponents(0.0) == 1e4 and exponents(1.0) == 0


def test_a_scene_file_keeps_uv_and_textures(tmp_path):
    mesh = pf.load_mesh(write(tmp_path, "map_Kd c.png", c=LEVELS)).mesh
    scene = pf.Scene(mesh, CAMERA, WHITE)
    pf.save_scene(tmp_path / "scene.json", scene)
    again = pf.load_scene(tmp_path / "scene.json")
    material = pf.Material(1.0)
    near(pf.render(again, material), np.asarray(pf.render(scene, material)))
    assert np.std(np.asarray(pf.render(again, material))) > 0.1


def test_a_scene_file_keeps_colours_of_vertices(tmp_path):
    colours = np.random.default_rng(0).uniform(size=(len(BOX.vertices), 3))
    textures = pf.Textures(diffuse=pf.VertexColours(colours))
    mesh = pf.Mesh(BOX.vertices, BOX.faces, textures=textures)
    pf.save_scene(tmp_path / "scene.json", pf.Scene(mesh, CAMERA, WHITE))
    again = pf.load_scene(tmp_path / "scene.json").surface
    assert isinstance(again, pf.Mesh)
    read = known(known(again.textures)[0].diffuse)
    assert isinstance(read, pf.VertexColours)
    near(read.values, colours)


def test_scene_files_from_before_kinds_of_textures(tmp_path):
    mesh = pf.load_mesh(write(tmp_path, "map_Kd c.png", c=LEVELS)).mesh
    pf.save_scene(tmp_path / "scene.json", pf.Scene(mesh, CAMERA, WHITE))
    text = (tmp_path / "scene.json").read_text()
    content = json.loads(text)
    assert content["surface"]["textures"][0]["diffuse"].pop("kind") == "image"
    (tmp_path / "scene.json").write_text(json.dumps(content))
    again = pf.load_scene(tmp_path / "scene.json").surface
    assert isinstance(again, pf.Mesh)
    near(
        known(known(again.textures)[0].diffuse).values,
        np.asarray(known(known(mesh.textures)[0].diffuse).values),
    )


ICO = trimesh.creation.icosphere(1)
PAINT = np.random.default_rng(0).integers(0, 256, (len(ICO.vertices), 3), np.uint8)


def colours_of(mesh: pf.Mesh, name: str = "diffuse") -> np.ndarray:
    """Of the vertices of ICO, in their order there."""
    found = getattr(known(mesh.textures)[0], name)
    assert isinstance(found, pf.VertexColours)
    far = np.linalg.norm(ICO.vertices[:, None] - np.asarray(mesh.vertices), axis=-1)
    assert far.min(axis=1).max() < 1e-5
    return np.asarray(found.values)[far.argmin(axis=1)]


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb"])
def test_colours_of_vertices_as_others_write_them(tmp_path, suffix):
    coloured = ICO.copy()
    coloured.visual.vertex_colors = PAINT  # pyright: ignore
    coloured.export(tmp_path / f"a.{suffix}")
    mesh, material, _ = pf.load_mesh(tmp_path / f"a.{suffix}")
    # glTF's are linear, those of the others sRGB.
    shares = PAINT / 255.0
    light = shares if suffix == "glb" else decode(shares, "srgb")
    for name in ("diffuse", "ambient"):
        near(colours_of(mesh, name), light, 1e-6)
        near(getattr(material, name), 1)
    # glTF's faces are flat where it has no normals.
    assert len(mesh.vertices) == (ICO.faces.size if suffix == "glb" else 42)


OBJ_V = "v 0 0 0 {}\nv 1 0 0 {}\nv 0 1 0 {}\nv 0 1 0 {}\n"
"""Two triangles; the last vertex stands where the third does."""


def test_colours_of_an_obj_are_not_rounded(tmp_path):
    colours = np.array([[0.1234567, 0.5, 1], [0, 0.25, 1], [1, 0, 0], [0, 1, 0]])
    text = OBJ_V.format(*(" ".join(map(str, one)) for one in colours))
    text += "v -1 0 0\nf 1 2 3\nf 1 4 5\n"
    (tmp_path / "a.obj").write_text(text)
    mesh, material, _ = pf.load_mesh(tmp_path / "a.obj")
    near(material.diffuse, 1)
    read = np.asarray(known(known(mesh.textures)[0].diffuse).values)
    wanted = np.concatenate([decode(colours, "srgb"), np.ones((1, 3))])
    faces, places = np.asarray(mesh.faces), np.array([[0, 1, 2], [0, 3, 4]])
    near(read[faces], wanted[places], 1e-6)
    # One place in two colours is not an edge of the surface.
    assert len(mesh.vertices) == 5
    flat = np.asarray(mesh.vertices)
    (at,) = np.where((flat == [0, 1, 0]).all(axis=1))
    assert len(at) == 2
    near(mesh.vertex_normals()[at], np.tile([0, 0, 1], (2, 1)))


@pytest.mark.parametrize(
    "colour, words",
    [
        ("200 0 0", "its colours are not used: expected 0 to 1, got 0 to 2"),
        ("nan 0 0", "its colours are not used"),
    ],
)
def test_colours_of_vertices_that_are_not_used(tmp_path, colour, words):
    text = OBJ_V.format(*[colour] * 4) + "f 1 2 3\n"
    (tmp_path / "a.obj").write_text(text)
    with pytest.warns(UserWarning, match=words):
        assert pf.load_mesh(tmp_path / "a.obj").mesh.textures is None


def test_colours_of_vertices_where_there_is_a_texture(tmp_path):
    path = write(tmp_path, "map_Kd c.png", c=LEVELS)
    coloured = "\n".join(
        f"{line} 1 0 0" if line.startswith("v ") else line for line in OBJ.split("\n")
    )
    path.write_text(coloured)
    with pytest.warns(UserWarning, match="colours are not used where map_Kd is"):
        (textures,) = known(pf.load_mesh(path).mesh.textures)
    at_texels(textures.diffuse, decode(LEVELS / 255.0, "srgb"))


def test_broken_colours_of_vertices(tmp_path):
    (tmp_path / "a.obj").write_text(OBJ_V.format(*["1 x 0"] * 4) + "f 1 2 3\n")
    with pytest.raises(ValueError, match="a.obj: line 1: v: expected 3 finite numbers"):
        pf.load_mesh(tmp_path / "a.obj")
    content = triangle()
    content["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = 0
    content["accessors"][0]["count"] = 2
    content["accessors"].append({**content["accessors"][0], "count": 3})
    content["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = 1
    (tmp_path / "a.gltf").write_text(json.dumps(content))
    with pytest.raises(ValueError, match="attributes.COLOR_0: expected 3, got 2"):
        pf.load_mesh(tmp_path / "a.gltf")


@pytest.mark.parametrize("kind, levels", [("u1", 255), ("u2", 65535), ("f4", 1)])
def test_colours_of_gltf_of_each_kind(tmp_path, kind, levels):
    colours = np.array([[1, 0.5, 0, 1], [0, 1, 0.2, 1], [0.3, 0, 1, 0.5]])
    content = binary(triangle(), COLOR_0=(colours * levels).astype(kind))
    content["accessors"][1]["normalized"] = True
    (tmp_path / "a.gltf").write_text(json.dumps(content))
    mesh, material, _ = pf.load_mesh(tmp_path / "a.gltf")
    near(material.diffuse, 1)
    read = known(known(mesh.textures)[0].diffuse).values
    near(read, colours[:, :3], 1.1 / levels if levels > 1 else 1e-6)


def seen_twice(*shaded):
    """Renders of meshes with their materials, from either side."""
    for view in ((3, 2, 4), (-2, -3, 1)):
        camera = pf.PerspectiveCamera.look_at(view, width=24, height=24)
        light = pf.DirectionalLight(view, 0.7)
        yield [
            np.asarray(pf.render(pf.Scene(mesh, camera, light, 0.3), material))
            for mesh, material in shaded
        ]


@pytest.mark.parametrize("suffix", SAVED)
def test_saved_colours_of_vertices_are_read_again(tmp_path, suffix):
    rng, count = np.random.default_rng(0), len(ICO.vertices)
    rows: dict[str, Any] = {
        name: pf.VertexColours(rng.uniform(0.1, 2, (count, channels)))
        for name, channels in dict(
            diffuse=3, specular=3, ambient=1, emission=3, shininess=1
        ).items()
    }
    if suffix == "obj":
        rows = {"diffuse": rows["diffuse"], "ambient": rows["diffuse"]}
    other = pf.VertexColours(rng.uniform(0.1, 2, (count, 1)))
    textures = [pf.Textures(**rows), pf.Textures(diffuse=other)]
    index = (np.asarray(ICO.triangles_center)[:, 0] > 0).astype(int)
    mesh = pf.Mesh(ICO.vertices, ICO.faces, None, index, textures=textures)
    material = pf.Material(
        np.array([[0.3, 0.2, 0.4], [0.2, 0.3, 0.4]]),
        np.array([[0.3], [0.05]]),
        np.array([[50.0], [12.0]]),
        np.array([[0.3], [0.0]]),
        np.array([[0.2], [0.0]]),
    )
    pf.save_mesh(tmp_path / f"a.{suffix}", mesh, material, ("one", "two"))
    again, read, names = pf.load_mesh(tmp_path / f"a.{suffix}")
    assert names == ("one", "two")
    for images in seen_twice((mesh, material), (again, read)):
        assert images[0].std() > 0.05
        # An outline may fall on either side of a pixel's centre.
        assert np.mean(abs(images[0] - images[1]) > 1e-4) < 0.01


def test_colours_of_vertices_that_an_obj_does_not_hold(tmp_path):
    rows: Any = pf.VertexColours(np.linspace(0, 1, len(ICO.vertices))[:, None])
    for name, numbers in (("specular", {}), ("diffuse", {"ambient": 0.2})):
        textures = pf.Textures(**{name: rows})
        mesh = pf.Mesh(ICO.vertices, ICO.faces, textures=textures)
        material = pf.Material(**({"ambient": 0.0} | numbers))
        with pytest.raises(ValueError, match="colours of vertices .*nearest=True"):
            pf.save_mesh(tmp_path / "a.obj", mesh, material)
        with pytest.warns(UserWarning, match="the nearest is taken"):
            pf.save_mesh(tmp_path / "a.obj", mesh, material, nearest=True)
        again = pf.load_mesh(tmp_path / "a.obj")
        wanted = 0.5 if name == "specular" else 1.0
        near(getattr(again.material, name), wanted * getattr(material, name), 1e-6)


def test_a_ply_has_diffuse_colours_alone(tmp_path):
    """Of several materials each with its own, where they meet in a vertex, too."""
    rng, path = np.random.default_rng(0), tmp_path / "a.ply"
    rows: Any = pf.VertexColours(rng.uniform(0.1, 2, (len(ICO.vertices), 3)))
    textures = [pf.Textures(diffuse=rows, ambient=rows), pf.Textures()]
    index = (np.asarray(ICO.triangles_center)[:, 0] > 0).astype(int)
    mesh = pf.Mesh(ICO.vertices, ICO.faces, None, index, textures=textures)
    colours = np.array([[0.3, 0.2, 0.4], [0.2, 0.3, 0.4]])
    material = pf.Material(colours, 0.0, 32.0, colours)
    pf.save_mesh(path, mesh, material)
    again, read, _ = pf.load_mesh(path)
    for images in seen_twice((mesh, material), (again, read)):
        assert images[0].std() > 0.05
        # Of 8 bits, sRGB-encoded; an outline may fall on either side.
        assert np.mean(abs(images[0] - images[1]) > 0.01) < 0.01
    plain = pf.Mesh(ICO.vertices, ICO.faces)
    for lost, words in (
        (pf.Material(0.5, 0.2, 32.0, 0.5), "specular: PLY"),
        (pf.Material(0.5, 0.0, 32.0, 0.5, 0.1), "emission: PLY"),
        (pf.Material(0.5, 0.0, 32.0, 0.1), "ambient: colours of a PLY's vertices"),
        (pf.Material(1.5, 0.0, 32.0, 1.5), "diffuse: PLY holds at most 1"),
    ):
        with pytest.raises(ValueError, match=words):
            pf.save_mesh(tmp_path / "b.ply", plain, lost)
        with pytest.warns(UserWarning, match=words):
            pf.save_mesh(tmp_path / "b.ply", plain, lost, nearest=True)
        shown = colours_of(pf.load_mesh(tmp_path / "b.ply").mesh)
        near(shown, min(float(lost.diffuse), 1) * np.ones_like(shown), 0.005)
    image = pf.Textures(diffuse=pf.Texture(np.ones((2, 2, 3))))
    mapped = pf.Mesh(BOX.vertices, BOX.faces, uv=np.zeros((12, 3, 2)), textures=image)
    with pytest.raises(ValueError, match="diffuse: PLY has no place for a texture"):
        pf.save_mesh(path, mapped, pf.Material(0.5, 0.0, 32.0, 0.5))


def painted(rng, **sizes):
    """A texture of each kind, of numbers that 16 bits round."""
    return {name: pf.Texture(rng.uniform(0.1, 1, size)) for name, size in sizes.items()}


@pytest.mark.parametrize("suffix", SAVED)
def test_a_saved_mesh_is_read_again(tmp_path, suffix):
    rng = np.random.default_rng(0)
    small = (5, 4)
    first = painted(rng, diffuse=(6, 4, 3), emission=(3, 3, 1), specular=(*small, 3))
    normal = rng.uniform(-0.3, 0.3, (4, 4, 3)) + [0, 0, 0.6]
    first["normal"] = pf.Texture(normal, wrap="clamp")
    if suffix == "obj":
        first |= painted(rng, ambient=(2, 2, 3), shininess=(3, 2, 1))
    # In glTF the specular colour depends on the exponent, texel by texel.
    second = painted(
        rng, diffuse=(2, 2, 3), specular=(*small, 3), shininess=(*small, 1)
    )
    textures = [pf.Textures(**first), pf.Textures(**second)]
    uv = rng.uniform(size=(12, 3, 2))
    mesh = pf.Mesh(
        BOX.vertices, BOX.faces, None, np.arange(12) % 2, uv=uv, textures=textures
    )
    material = pf.Material(
        np.array([[0.9, 0.5, 0.4], [0.2, 0.3, 0.4]]),
        np.array([[0.3], [0.05]]),
        np.array([[50.0], [12.0]]),
        np.array([[0.3], [0.1]]),
        np.array([[0.2], [0.0]]),
    )
    pf.save_mesh(tmp_path / f"a.{suffix}", mesh, material, ("one", "two"))
    again, read, names = pf.load_mesh(tmp_path / f"a.{suffix}")
    assert names == ("one", "two")
    for images in seen_twice((mesh, material), (again, read)):
        assert images[0].std() > 0.05
        assert abs(images[0] - images[1]).max() < 2e-3
        assert np.median(abs(images[0] - images[1])) < 1e-4


def test_tangents_of_a_gltf_are_listed_where_there_is_a_normal_map(tmp_path):
    """phongfit finds tangents from the uv."""
    flat = levels(np.full((2, 2), 128), 128, 255)
    tangents = np.tile([0, 1, 0, 1], (3, 1)).astype("f4")
    bent = {"normalTexture": {"index": 0}, "pbrMetallicRoughness": MATTE}
    path = gltf(tmp_path, bent, {"flat": flat})
    content = binary(json.loads(path.read_text()), TANGENT=tangents)
    path.write_text(json.dumps(content))
    with pytest.warns(UserWarning, match="not used: attributes.TANGENT. "):
        pf.load_mesh(path)
    del content["materials"][0]["normalTexture"]
    path.write_text(json.dumps(content))
    assert pf.load_mesh(path).mesh.textures is None


def test_what_is_not_saved(tmp_path):
    mesh = pf.Mesh(BOX.vertices, BOX.faces, uv=np.zeros((12, 3, 2)))
    for path, words in (
        ("a.off", "expected .obj, .glb, .gltf, .ply, .stl or .usda"),
        ("a.stl", "material: STL has triangles alone"),
        ("a b.obj", "blanks"),
    ):
        with pytest.raises(ValueError, match=words):
            pf.save_mesh(tmp_path / path, mesh, pf.Material())
    with pytest.raises(ValueError, match="names: expected 1"):
        pf.save_mesh(tmp_path / "a.obj", mesh, pf.Material(), ("one", "two"))
    ambient = mesh.with_textures(pf.Textures(ambient=pf.Texture(np.ones((2, 2, 3)))))
    with pytest.raises(ValueError, match="ambient: glTF has no texture of it"):
        pf.save_mesh(tmp_path / "a.glb", ambient, pf.Material())
    with pytest.raises(ValueError, match="shininess: .mtl holds at most 1000"):
        pf.save_mesh(tmp_path / "a.obj", mesh, pf.Material(shininess=2000.0))
    assert not list(tmp_path.iterdir())
