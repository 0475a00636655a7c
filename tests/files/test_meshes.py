import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

import phongfit as pf
from phongfit.files.mesh_parts import LoadedMesh
from phongfit.files.polygons import MOST_CORNERS, triangulate
from phongfit.rendering.film import decode
from tests.helpers import known, near

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


def _bytes(content: Any) -> bytes:
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


SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
PLY_HEAD = """ply
format ascii 1.0
element vertex 5
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
element face 2
property list uchar int vertex_indices
property uchar red
property uchar green
property uchar blue
end_header
"""

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
        ("a.obj", "v 0 0 0\nv 0 1 nan\n", "line 2: v: expected 3 finite.*1 nan"),
        ("a.obj", "v 0 0 0 1 1\n", "line 1: v: expected x y z or x y z r g b"),
        ("a.obj", "vn 0 0\n", "line 1: vn: expected 3 finite numbers, got '0 0'"),
        ("a.obj", "vt x\n", "line 1: vt: expected finite numbers, got 'x'"),
        ("a.obj", SQUARE + "f 1 2 9\n", "line 5: f: .* from 1 to 4, got 9"),
        ("a.obj", SQUARE + "f 1/1 2/1 3/1\n", "line 5: f: .* from 1 to 0, got 1"),
        ("a.obj", SQUARE + "f 0 1 2\n", "line 5: f: expected indices from 1.*got '0'"),
        ("a.obj", SQUARE + "f -5 1 2\n", "line 5: f: .*got '-5'"),
        ("a.obj", SQUARE + "f 1 2 3/1/1/1\n", "line 5: f: .*got '3/1/1/1'"),
        ("a.obj", SQUARE + "f 1 2 c\n", "line 5: f: .*got 'c'"),
        ("a.obj", SQUARE + f"f 1 2 {10**20}\n", "line 5: f: .*got '10000"),
        ("a.off", f"OFF\n0 1 0\n3 0 1 {10**20}\n", "line 3: expected the number"),
        ("a.off", "COFF\n3 1\n0 0 0 1\n", "line 3: expected 6 numbers, got"),
        ("a.off", "OFF\n3 1\n0 0 0\n0 1 0\n", "line 5: expected 3 numbers, got"),
        ("a.off", "OFF BINARY\n", "line 1: expected OFF, and text"),
        ("a.off", "OFF\n0 1 0\n3 0 1 2\n", "its faces: expected whole numbers"),
        ("a.off", "OFF\n0 1 0\n3 0 1\n", "line 3: expected the number of corners"),
        ("a.ply", PLY_HEAD + "0 x 0 0\n", "words in place of numbers"),
        ("a.ply", PLY_HEAD + "0 0 0 0\n", "element vertex: it is truncated"),
        ("a.ply", PLY_HEAD.replace("float x", "real x"), "line 4: expected 'property"),
        ("a.ply", PLY_HEAD.replace("float x", "float w"), ""),
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


def area(mesh: pf.Mesh) -> float:
    a, b, c = np.moveaxis(np.asarray(mesh.vertices)[np.asarray(mesh.faces)], 1, 0)
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def load(folder: Path, name: str, content: str | bytes, **options) -> LoadedMesh:
    (folder / name).write_bytes(_bytes(content))
    return pf.load_mesh(folder / name, **options)


@pytest.mark.parametrize(
    "content",
    [
        "mtllib two.mtl\n" + SQUARE + "usemtl blue\nf 1 2 3 4\n",
        "\ufeffmtllib\ttwo.mtl\r\n" + SQUARE + "usemtl\tblue\r\nf\t1\t2 3 4",
        "mtllib two.mtl\r" + SQUARE.replace("\n", "\r") + "usemtl blue\rf 1 2 3 4",
        "  mtllib two.mtl\n" + SQUARE + "\tusemtl blue\n f 1 2 3 # one\n f 1 3 4\n",
        "mtllib two.mtl\n" + SQUARE + "usemtl blue\nf 1 2 \\\n3 \\\n4\n",
        "mtllib none.mtl two.mtl\n" + SQUARE + "usemtl blue\nf -4 -3 -2 -1\n",
        'mtllib "TWO.mtl"\n' + SQUARE + "usemtl blue\nfo 1// 2// 3// 4//\n",
        "# Gr\u00fcn\nmtllib C:\\x\\two.mtl\n" + SQUARE + "usemtl blue\nf 1 2 3 4\n",
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
@pytest.mark.filterwarnings("ignore:.*none.mtl is missing")
def test_an_obj_as_other_programs_write_it(tmp_path, content, encoding):
    (tmp_path / "two.mtl").write_text(LIBRARY)
    data = content.encode(encoding, "ignore")
    mesh, material, names = load(tmp_path, "a.obj", data)
    assert area(mesh) == 1 and names == ("blue",)
    near(material.diffuse, (0, 0, 0.5))


def test_negative_indices_count_back_from_their_line(tmp_path):
    one = "v 0 0 {0}\nv {1} 0 {0}\nv 0 {1} {0}\nvt 0 0\nvt .{1} 0\nvt 0 .{1}\n"
    face = "f -3/-3 -2/-2 -1/-1\n"
    text = one.format(0, 1) + face + one.format(5, 2) + face
    mesh = load(tmp_path, "a.obj", text).mesh
    assert area(mesh) == 0.5 + 2
    near(np.asarray(mesh.uv).max(axis=(1, 2)), [1, 1])
    near(np.asarray(mesh.uv)[:, 1, 0], [0.1, 0.2])


CONCAVE = [(0, 0), (4, 0), (4, 4), (2, 1), (0, 4)]
"""A polygon of area 10."""


@pytest.mark.parametrize("suffix", ["obj", "off", "ply"])
@pytest.mark.parametrize("turn", range(5))
def test_concave_polygons(tmp_path, suffix, turn):
    corners = CONCAVE[turn:] + CONCAVE[:turn]
    # In a plane that is none of the axes', seen from either side.
    places = [f"{x} {y} {x - y}" for x, y in corners]
    faces = ["0 1 2 3 4", "4 3 2 1 0"]
    if suffix == "obj":
        text = "".join(f"v {k}\n" for k in places) + "f 1 2 3 4 5\nf 5 4 3 2 1\n"
    else:
        rows = [*places, *(f"5 {k}" for k in faces), ""]
        head = re.sub("property uchar.*\n", "", PLY_HEAD)
        head = "OFF\n5 2 0\n" if suffix == "off" else head
        text = head + "\n".join(rows)
    mesh = load(tmp_path, f"a.{suffix}", text).mesh
    near(area(mesh), 2 * 10 * np.sqrt(3), 1e-5)
    up = np.asarray(mesh.face_normals())[:, 2]
    near(up, np.where(np.arange(6) < 3, 1, -1) / np.sqrt(3), 1e-5)


def test_polygons_that_cross_themselves_or_are_none(tmp_path):
    text = SQUARE + "f 1 3 2 4\nf 1 2\nf 1 2 3\n"
    with pytest.warns(UserWarning) as said:
        mesh = load(tmp_path, "a.obj", text).mesh
    assert area(mesh) == 0.5
    words = [str(one.message).partition(".obj: ")[2] for one in said]
    assert [one.partition(". ")[0] for one in words] == [
        "1 of its faces have fewer than 3 corners, and are not used",
        "1 of its faces cross themselves or have no area: how they are cut is a guess",
    ]


def test_a_polygon_of_too_many_corners_is_refused():
    angle = np.linspace(0, 2 * np.pi, MOST_CORNERS + 1, endpoint=False)
    radius = 1 + np.arange(len(angle)) % 2
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], 1)
    corners = np.arange(len(ring))
    with pytest.raises(ValueError, match="its faces: expected at most 20000 corners"):
        triangulate(ring, corners, np.array([len(ring)]), print)
    # As many as two of half the corners each; a third one is too many.
    third = len(ring) // 2
    counts = np.full(5, third)
    corners = np.tile(corners[:third], 5)
    with pytest.raises(ValueError, match="got 5 faces of 10000"):
        triangulate(ring, corners, counts, print)


def test_a_binary_ply_of_large_polygons(tmp_path):
    """A prism: the number of corners, of 8 bits, times 4 bytes is more than 255."""
    n = 100
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    ends = [np.column_stack([ring, np.full(n, z)]) for z in (0, 1)]
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {2 * n}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {n + 2}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    k = np.arange(n)
    sides = np.stack([k, (k + 1) % n, n + (k + 1) % n, n + k], axis=1)
    faces = [k[::-1], n + k, *sides]
    body = np.concatenate(ends).astype("<f4").tobytes()
    body += b"".join(bytes([len(f)]) + f.astype("<i4").tobytes() for f in faces)
    mesh = load(tmp_path, "a.ply", head.encode() + body).mesh
    assert len(mesh.faces) == 2 * (n - 2) + 2 * n
    side = 2 * n * np.sin(np.pi / n)
    assert area(mesh) == pytest.approx(n * np.sin(2 * np.pi / n) + side, rel=1e-5)


SIDES = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5)]
CUBE = [f"v {x} {y} {z}" for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]


def cube(*lines: str) -> str:
    """A cube of which one side is missing, with lines before each of its sides."""
    faces = ["f {} {} {} {}".format(*side) for side in SIDES]
    each = zip(lines or [""] * 5, faces, strict=True)
    return "\n".join([*CUBE, *("\n".join(pair) for pair in each), ""])


@pytest.mark.parametrize(
    "lines, vertices",
    [
        # Without s, or in one group, it is smooth.
        ((), 8),
        (("s 1", "", "", "", ""), 8),
        (("s off", "", "", "", ""), 20),
        (("", "", "", "", "s 0"), 20),
        (("s 1", "s 2", "s 3", "s 4", "s 5"), 20),
        # The first two do not touch.
        (("s roof", "", "s 2", "s off", ""), 20),
    ],
)
def test_smoothing_groups(tmp_path, lines, vertices):
    mesh = load(tmp_path, "a.obj", cube(*lines)).mesh
    assert mesh.vertices.shape == (vertices, 3) and mesh.normals is None
    flat = abs(np.asarray(mesh.vertex_normals())).max(axis=1) > 0.999
    assert flat.all() == (vertices == 20)
    # With crease_angle groups do not count.
    assert load(
        tmp_path, "a.obj", cube(*lines), crease_angle=120
    ).mesh.vertices.shape == (8, 3)


def test_normals_of_some_corners(tmp_path):
    text = SQUARE + "v 2 0 1\nvn 0 0.6 0.8\nvn 0 0 0\n"
    text += "f 1//1 2//1 3//1\nf 1 3 4\nf 2//2 5//2 3//2\n"
    mesh = load(tmp_path, "a.obj", text).mesh
    normals = np.asarray(mesh.normals)[np.asarray(mesh.faces)]
    near(normals[0], np.tile([0, 0.6, 0.8], (3, 1)), 1e-6)
    # The fourth vertex belongs to one face, as the fifth does.
    near(normals[1, 2], (0, 0, 1))
    near(normals[2, 1], np.asarray(mesh.face_normals())[2], 1e-6)


def test_faces_without_a_material(tmp_path):
    (tmp_path / "two.mtl").write_text(LIBRARY)
    (tmp_path / "one.mtl").write_text("newmtl clay\nKd 0.5 0.25 0.125\n")
    faces = SQUARE + "f 1 2 3\n{}f 1 3 4\n"
    mesh, material, names = load(
        tmp_path, "a.obj", "mtllib one.mtl\n" + faces.format("")
    )
    assert names == ("clay",)
    near(material.diffuse, (0.5, 0.25, 0.125))
    for line, words, wanted in (
        ("", "its faces name no material", ("default",)),
        ("usemtl blue\n", "its faces before the first usemtl", ("default", "blue")),
    ):
        with pytest.warns(UserWarning, match=words):
            text = "mtllib two.mtl\n" + faces.format(line)
            assert load(tmp_path, "a.obj", text).names == wanted


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("mixed", [True, False])
def test_a_ply_of_each_kind(tmp_path, kind, mixed):
    """Squares, and triangles beside them; colours of its faces."""
    places = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0)]
    faces = [(0, 1, 2, 3), (1, 4, 2)] if mixed else [(0, 1, 2), (0, 2, 3)]
    colours = [(255, 0, 51), (0, 102, 255)]
    head = re.sub("(?s)property uchar.*?element", "element", PLY_HEAD, count=1)
    head = head.replace("ascii", kind).replace(
        "element face", "comment x\nelement face"
    )
    body, order = b"", "<" if "little" in kind else ">"
    if kind == "ascii":
        rows = [
            *places,
            *((len(f), *f, *c) for f, c in zip(faces, colours, strict=True)),
        ]
        body = "\n".join(" ".join(map(str, row)) for row in rows).encode()
    else:
        body = np.array(places, f"{order}f4").tobytes()
        for face, colour in zip(faces, colours, strict=True):
            body += bytes([len(face)]) + np.array(face, f"{order}i4").tobytes()
            body += bytes(colour)
    mesh, material, _ = load(tmp_path, "a.ply", head.encode() + body)
    assert area(mesh) == (1.5 if mixed else 1)
    near(material.diffuse, 1)
    assert mesh.textures is not None and mesh.textures[0].diffuse is not None
    rows = np.asarray(mesh.textures[0].diffuse.values)[np.asarray(mesh.faces)]
    of = [0, 0, 1] if mixed else [0, 1]
    light = decode(np.array(colours)[of] / 255.0, "srgb")
    near(rows, np.repeat(light[:, None], 3, axis=1), 1e-6)
    # The edge between two colours is no edge of the surface.
    near(mesh.vertex_normals(), np.tile([0, 0, 1], (len(mesh.vertices), 1)))


def test_uv_of_a_plys_corners(tmp_path):
    head = re.sub("property uchar.*\n", "", PLY_HEAD)
    head = head.replace("end_", "property list uchar float texcoord\nend_")
    body = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n2 0 0\n"
    body += "4 0 1 2 3 8 0 0 1 0 1 1 0 1\n3 1 4 2 6 .5 0 1 0 .5 1\n"
    mesh = load(tmp_path, "a.ply", head + body).mesh
    near(known(mesh.uv)[2], [[0.5, 1], [1, 1], [0.5, 0]])
    with pytest.warns(UserWarning, match="texcoord are not used: not all corners"):
        text = (head + body).replace(" 6 .5 0 1 0 .5 1", " 0")
        assert load(tmp_path, "a.ply", text).mesh.uv is None


@pytest.mark.parametrize("scale", [1, 255])
def test_colours_of_an_off(tmp_path, scale):
    colours = np.array([[1, 0, 0.2], [0, 1, 0.4], [0.2, 0.2, 1], [1, 1, 1]])
    light = decode(colours, "srgb")
    shown = [" ".join(f"{k:g}" for k in row * scale) for row in colours]
    places = ["0 0 0", "1 0 0", "1 1 0", "0 1 0"]
    vertices = "\n".join(" ".join(pair) for pair in zip(places, shown, strict=True))
    text = f"# made by hand\nCOFF4 1 0\n\n{vertices} # last\n4 0 1 2 3\n"
    mesh = load(tmp_path, "a.off", text).mesh
    assert mesh.textures is not None and mesh.textures[0].diffuse is not None
    near(mesh.textures[0].diffuse.values, light, 1e-6)
    faces = f"3 0 1 2 {shown[0]}\n3 0 2 3\n"
    mesh = load(
        tmp_path, "a.off", "OFF\n4 2 0\n" + "\n".join(places) + f"\n{faces}"
    ).mesh
    assert mesh.textures is not None and mesh.textures[0].diffuse is not None
    rows = np.asarray(mesh.textures[0].diffuse.values)[np.asarray(mesh.faces)]
    near(rows[:, 0], light[[0, 3]], 1e-6)


def test_normals_and_uv_of_an_off(tmp_path):
    rows = ["0 0 0 0 0.6 0.8 0 0", "1 0 0 0 0 1 1 0", "1 1 0 0 0 1 1 1"]
    text = "STNOFF\n3 1 0\n" + "\n".join([*rows, "3 0 1 2\n"])
    mesh = load(tmp_path, "a.off", text).mesh
    near(known(mesh.normals)[0], (0, 0.6, 0.8), 1e-6)
    near(known(mesh.uv)[0], [[0, 1], [1, 1], [1, 0]])
    with pytest.warns(UserWarning, match="columns 4 to 8 of its vertices are not used"):
        assert load(tmp_path, "a.off", text.removeprefix("STN")).mesh.normals is None


def test_stl_as_text(tmp_path):
    content = _bytes(BOX.export(file_type="stl_ascii"))
    mesh = load(tmp_path, "a.stl", content.replace(b"vertex", b"VERTEX ")).mesh
    assert mesh.vertices.shape == (8, 3) and mesh.faces.shape == (12, 3)
    with pytest.raises(ValueError, match="a.stl: is broken or truncated"):
        load(tmp_path, "a.stl", content[: len(content) // 2])
    named = content.replace(b"solid", "solid Körper".encode(), 1)
    assert len(load(tmp_path, "a.stl", named).mesh.faces) == 12
    data = bytearray(_bytes(BOX.export(file_type="stl")))
    data[84 + 48] = 7
    with pytest.warns(UserWarning, match="attributes of its triangles"):
        load(tmp_path, "a.stl", bytes(data))
