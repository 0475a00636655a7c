"""`phongfit export` of maps as a mesh: OBJ, PLY, STL, and glTF on the surface."""

import warnings

import numpy as np
import pytest
import trimesh

import phongfit as pf
from phongfit.cli import main
from phongfit.maps.folder import load_folder
from tests.maps.hills import SIZE, bumps, write_hills


@pytest.fixture(scope="module")
def hills(tmp_path_factory):
    folder = tmp_path_factory.mktemp("surface") / "maps"
    folder.mkdir()
    write_hills(folder)
    return folder


@pytest.mark.parametrize("name", ["a.obj", "a.ply", "a.glb"])
def test_a_mesh(hills, tmp_path, capsys, name):
    path = tmp_path / name
    options = ["--surface"] if name == "a.glb" else []
    assert main(["export", str(hills), "-o", str(path), *options]) == 0
    assert "2,418 triangles" in capsys.readouterr().out
    (mesh,) = trimesh.load_scene(path, process=False).geometry.values()
    assert len(mesh.vertices) == 32 * 40 and len(mesh.faces) == 2 * 31 * 39
    maps, _, _ = load_folder(hills)
    top = mesh.vertices[np.argmax(mesh.vertices[:, 2])]
    y, x = np.unravel_index(np.argmax(bumps()), SIZE)
    np.testing.assert_allclose(
        top[:2], [(x + 0.5) / 10 - 2, 1.6 - (y + 0.5) / 10], 1e-5
    )
    assert np.ptp(mesh.vertices[:, 2]) == pytest.approx(np.ptp(bumps()), rel=0.1)
    facing = np.asarray(mesh.face_normals)[:, 2]
    assert np.all(facing > 0)
    near = np.argmin(np.linalg.norm(mesh.vertices - [1.05, -0.45, 0.4], axis=1))
    place = mesh.vertices[near]
    at = round((1.6 - place[1]) * 10 - 0.5), round((place[0] + 2) * 10 - 0.5)
    np.testing.assert_allclose(mesh.vertex_normals[near], maps.normals[at], atol=1e-4)
    if name == "a.ply":
        colour = np.asarray(mesh.visual.vertex_colors)[near, :3] / 255  # pyright: ignore
        shown = pf.Film(encoding="srgb").expose(maps.diffuse[at])
        np.testing.assert_allclose(colour, shown, atol=0.003)
    if name == "a.glb":
        # Row 0 of the textures is at the top.
        uv = mesh.visual.uv[near]  # pyright: ignore
        np.testing.assert_allclose(
            uv, [(at[1] + 0.5) / 40, 1 - (at[0] + 0.5) / 32], atol=1e-4
        )
    if name == "a.obj":
        beside = sorted(p.name for p in tmp_path.iterdir())
        assert beside == [
            *("a.mtl", "a.obj", "a_Ka.png", "a_Kd.png", "a_Ks.png", "a_Ns.png")
        ]
        assert "map_Kd -clamp on a_Kd.png" in (tmp_path / "a.mtl").read_text()


def test_triangles_alone(hills, tmp_path, capsys, refused):
    """Of maps, and of a mesh where its material may be lost."""
    one, two = tmp_path / "a.stl", tmp_path / "b.stl"
    assert main(["export", str(hills), "-o", str(one)]) == 0
    assert "the shape alone; 2,418 triangles" in capsys.readouterr().out
    mesh = pf.load_mesh(one).mesh
    assert len(mesh.faces) == 2418
    assert np.ptp(mesh.vertices[:, 2]) == pytest.approx(np.ptp(bumps()), rel=0.1)
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "box.ply")
    call = ["export", str(tmp_path / "box.ply"), "-o", str(two)]
    assert "STL has triangles alone (--nearest" in refused(*call)
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert main([*call, "--nearest"]) == 0
    assert "STL has triangles alone; the nearest is taken" in capsys.readouterr().err
    box = pf.load_mesh(two).mesh
    assert len(box.faces) == 12
    assert np.ptp(box.vertices, axis=0).tolist() == [1, 2, 3]


def test_a_material_has_no_surface(tmp_path, refused):
    for name in ("a.obj", "a.ply", "a.stl"):
        assert "a material has none" in refused(
            "export", "preset:gold", "-o", f"{tmp_path}/{name}"
        )
