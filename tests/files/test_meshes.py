from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

import phongfit as pf
from tests.helpers import near

BOX = trimesh.creation.box()


@pytest.mark.parametrize("suffix", ["ply", "stl", "glb", "off", "obj", "OBJ"])
def test_every_format(tmp_path, suffix):
    path = tmp_path / f"box.{suffix}"
    path.write_bytes(_bytes(BOX.export(file_type=suffix.lower())))
    mesh, material, names = pf.load_mesh(path)
    assert names == ("default",) and mesh.materials == 1
    # glTF's faces are flat where it has no normals.
    corners = 36 if suffix == "glb" else 8
    assert mesh.vertices.shape == (corners, 3) and mesh.faces.shape == (12, 3)
    # The same sides, facing outwards, whatever the order of the corners.
    near(np.sort(np.abs(mesh.face_normals()), axis=1), np.tile([0.0, 0, 1], (12, 1)))
    centres = np.asarray(mesh.vertices)[np.asarray(mesh.faces)].mean(axis=1)
    assert np.all(np.sum(np.asarray(mesh.face_normals()) * centres, axis=1) > 0.4)
    near(material.diffuse, pf.Material().diffuse)


def _bytes(content):
    return content.encode() if isinstance(content, str) else content


def write_gltf(scene: trimesh.Scene, folder: Path) -> None:
    files: Any = scene.export(file_type="gltf")
    for name, content in files.items():
        (folder / name).write_bytes(content)


def test_gltf_of_several_files_and_objects(tmp_path):
    scene = trimesh.Scene()
    red = PBRMaterial(
        name="red",
        baseColorFactor=[255, 0, 51, 255],
        emissiveFactor=[0.5, 0, 0],
        metallicFactor=0.0,
    )
    one = BOX.copy()
    one.visual = TextureVisuals(material=red)
    scene.add_geometry(one)
    # Mirrored and moved: its faces must still look outwards.
    mirror = np.diag([-2.0, 1, 1, 1])
    mirror[:3, 3] = 5, 0, 0
    scene.add_geometry(BOX.copy(), transform=mirror)
    write_gltf(scene, tmp_path)
    mesh, material, names = pf.load_mesh(tmp_path / "model.gltf")
    assert set(names) == {"red", "default"} and mesh.materials == 2
    row = names.index("red")
    near(material.diffuse[row], (1, 0, 0.2))
    near(material.emission[row], (0.5, 0, 0))
    index = np.asarray(mesh.material_index)
    centres = np.asarray(mesh.vertices)[np.asarray(mesh.faces)].mean(axis=1)
    np.testing.assert_array_equal(index == row, centres[:, 0] < 2)
    middle = np.where((index == row)[:, None], [0, 0, 0], [5, 0, 0])
    outwards = np.sum(np.asarray(mesh.face_normals()) * (centres - middle), axis=1)
    assert np.all(outwards > 0.4)


def test_gltf_reads_nothing_outside_its_folder(tmp_path):
    inner = tmp_path / "inner"
    inner.mkdir()
    write_gltf(trimesh.Scene(BOX), inner)
    model = inner / "model.gltf"
    buffer = next(inner.glob("*.bin"))
    buffer.rename(tmp_path / buffer.name)
    model.write_text(model.read_text().replace(buffer.name, f"../{buffer.name}"))
    with pytest.raises(ValueError, match="model.gltf: .*name of a file in this folder"):
        pf.load_mesh(model)


# Two objects that share an edge; no normals. The texture coordinates cut it open.
OBJECTS = """mtllib two.mtl
o left
v 0 0 0
v 1 0 0
v 1 1 1
v 0 1 1
vt 0 0
vt 1 1
usemtl red clay
f 1/1 2/1 3/2
o right
usemtl blue
f 1/1 3/1 4/2
"""
LIBRARY = """newmtl blue
Kd 0 0 0.5
Ns 40
newmtl unused
newmtl red clay
Kd 0.7 0.1 0.1
Ks 0.5 0.5 0.5
Ns 200
"""


def write_objects(folder, objects=OBJECTS, library=LIBRARY):
    (folder / "two.obj").write_text(objects)
    (folder / "two.mtl").write_text(library)
    return folder / "two.obj"


def test_materials_of_an_obj_file(tmp_path):
    mesh, material, names = pf.load_mesh(write_objects(tmp_path))
    assert names == ("red clay", "blue")
    near(material.diffuse, [[0.7, 0.1, 0.1], [0, 0, 0.5]])
    near(material.shininess, [[200], [40]])
    near(material.specular, [[0.5] * 3, [0] * 3])
    centres = np.asarray(mesh.vertices)[np.asarray(mesh.faces)].mean(axis=1)
    right = centres[:, 0] > 0.5
    np.testing.assert_array_equal(mesh.material_index, np.where(right, 0, 1))
    # The shared edge is smooth: four vertices, with one normal each.
    assert mesh.vertices.shape == (4, 3)
    image = pf.render(
        pf.Scene(mesh, pf.OrthographicCamera(8, 8), ambient=1, background=1),
        material,
    )
    assert image.shape == (8, 8, 3)


def test_normals_of_the_file_unless_creases_are_wanted(tmp_path):
    path = tmp_path / "tent.obj"
    path.write_text(
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\n"
        "vn 0 0.6 0.8\nvn 0 0 1\nf 1//1 2//1 3//1\nf 1//2 3//2 4//2\nf 1//2 5//2 2//2\n"
    )
    mesh = pf.load_mesh(path).mesh
    assert {tuple(np.round(n, 6)) for n in np.asarray(mesh.normals, float)} == {
        (0, 0.6, 0.8),
        (0, 0, 1),
    }
    sharp = pf.load_mesh(path, crease_angle=30).mesh
    assert sharp.normals is None
    near(np.abs(sharp.vertex_normals()).max(axis=1), 1)
    assert pf.load_mesh(path, two_sided=True).mesh.two_sided


def test_a_missing_library_leaves_materials_apart(tmp_path):
    path = write_objects(tmp_path)
    (tmp_path / "two.mtl").unlink()
    with pytest.warns(UserWarning) as said:
        mesh, material, names = pf.load_mesh(path)
    words = [str(warning.message) for warning in said]
    assert any("line 1: two.mtl is missing" in word for word in words)
    assert any("no .mtl has its material 'blue'" in word for word in words)
    assert names == ("red clay", "blue") and mesh.materials == 2
    near(material.diffuse, np.full((2, 1), 0.8))


def test_a_texture_that_is_missing_is_named(tmp_path):
    library = LIBRARY.replace("Ns 40\n", "Ns 40\nmap_Kd none.png\n")
    with pytest.warns(
        UserWarning, match="two.mtl: line 4: texture 'none.png' .* missing"
    ):
        pf.load_mesh(write_objects(tmp_path, library=library))


@pytest.mark.parametrize(
    "name, content, said",
    [
        ("a.obj", "", "holds no triangles"),
        ("a.obj", "v 0 0 0\nv 1 0 0\n", "holds no triangles"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 nan\nf 1 2 3\n", "vertices: .*nan"),
        ("a.obj", "mtllib ../a.mtl\nv 0 0 0\n", "line 1: expected.*got '../a.mtl'"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nf 1 2 9\n", ""),
        ("a.ply", "ply", "cannot be read: its header has no end"),
        ("a.glb", "glTF", "does not start as a GLB file of version 2 does"),
        ("a.stl", "", ""),
        ("a.3ds", "", "suffix is none of .obj"),
        ("a", "", "suffix is none of .obj"),
    ],
)
def test_broken_files(tmp_path, name, content, said):
    (tmp_path / name).write_text(content)
    with pytest.raises(ValueError, match=f"(?s){name}: .*{said}"):
        pf.load_mesh(tmp_path / name)


def test_a_missing_file(tmp_path):
    with pytest.raises(ValueError, match="none.ply: cannot be read"):
        pf.load_mesh(tmp_path / "none.ply")


def test_pictures_that_a_mesh_names_stay_closed(tmp_path, monkeypatch):
    opened = []
    monkeypatch.setattr("PIL.Image.open", lambda *given, **_: opened.append(given))
    text = BOX.export(file_type="ply", encoding="ascii")
    assert isinstance(text, bytes)
    (tmp_path / "a.png").write_bytes(b"%!PS")
    path = tmp_path / "a.ply"
    path.write_bytes(
        text.replace(b"\nelement", b"\ncomment TextureFile a.png\nelement", 1)
    )
    with pytest.warns(UserWarning, match="TextureFile is not used, for it has no uv"):
        assert pf.load_mesh(path).mesh.faces.shape == (12, 3)
    assert not opened


@pytest.mark.parametrize("suffix", ["stl", "ply", "off", "glb"])
def test_a_mesh_that_is_cut_off(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    whole = _bytes(BOX.export(file_type=suffix))
    path.write_bytes(whole[: len(whole) // 2] + b"\xff\xfe")
    with pytest.raises(ValueError, match=rf"a\.{suffix}: (?!.*module)"):
        pf.load_mesh(path)


def test_many_materials_that_are_missing_are_few_warnings(tmp_path):
    lines = ["v 0 0 0", "v 1 0 0", "v 0 1 0"]
    lines += [f"usemtl m{k % 90}\nf 1 2 3" for k in range(200)]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    with pytest.warns(UserWarning) as said:
        mesh, _, names = pf.load_mesh(tmp_path / "a.obj")
    assert len(said) == 6 and "nor 85 others" in str(said[-1].message)
    assert names[:2] == ("m0", "m1") and mesh.materials == 90


def test_a_mesh_that_takes_too_much_memory(tmp_path, monkeypatch):
    for suffix in ("stl", "ply", "off", "obj", "glb"):
        path = tmp_path / f"a.{suffix}"
        path.write_bytes(_bytes(BOX.export(file_type=suffix)))
        monkeypatch.setenv("PHONGFIT_MAX_MEMORY", "3K")
        with pytest.raises(ValueError, match=rf"a\.{suffix}: .*at most 3 KB of memory"):
            pf.load_mesh(path)
        monkeypatch.delenv("PHONGFIT_MAX_MEMORY")
        assert pf.load_mesh(path).mesh.materials == 1
