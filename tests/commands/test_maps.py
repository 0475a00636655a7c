"""`phongfit maps`: what it writes, and how it goes on after an interrupt."""

import json
import os
import types

import imagecodecs
import numpy as np
import pytest
import trimesh

import phongfit as pf
from phongfit.cli import main
from phongfit.commands import maps as command
from phongfit.files.dataset import Photographs
from phongfit.files.outputs import WORK
from phongfit.maps.folder import load_folder
from phongfit.rendering.film import decode
from tests.commands.conftest import (
    ENDS,
    FEW,
    SIDE,
    files_in,
    full_disk,
    interrupt,
)
from tests.maps.synthetic import same

TILES = [*FEW, "--tile-pixels", "64"]
HALF = SIDE // 2


@pytest.fixture(scope="module")
def mapped(brass, tmp_path_factory):
    folder = tmp_path_factory.mktemp("maps") / "maps"
    assert main(["maps", str(brass), "-o", str(folder), *TILES]) == 0
    return folder


def test_maps_their_errors_and_pictures(brass, mapped):
    maps, record, normals = load_folder(mapped)
    inside = ~maps.flagged(pf.Flag.OUTSIDE)
    truth = pf.read_dataset(brass).truth
    assert truth is not None
    for name in ("ambient", "diffuse"):
        off = getattr(maps, name) - np.asarray(getattr(truth, name))
        pull = (off / getattr(maps.stderr, name))[inside & maps.identified]
        assert pull.size > 150 and np.mean(np.abs(pull) < 3) > 0.95, name
        tiff = imagecodecs.tiff_decode((mapped / f"{name}.tif").read_bytes())
        np.testing.assert_allclose(tiff, getattr(maps, name), rtol=1e-6)
        tiff = imagecodecs.tiff_decode((mapped / f"stderr_{name}.tif").read_bytes())
        np.testing.assert_allclose(tiff, getattr(maps.stderr, name), rtol=1e-6)
        assert pf.read_image(mapped / f"{name}.png", "srgb").std() > 0.05
    np.testing.assert_allclose(maps.shininess[inside], 27.897436, rtol=1e-6)
    assert record.settings.unknowns == ["ambient", "diffuse"]
    assert record.settings.known is not None and record.settings.noise == 0.01
    assert len(record.data.inputs) == 4 and not (mapped / "tiles").exists()
    np.testing.assert_allclose(np.linalg.norm(normals[inside], axis=-1), 1, rtol=1e-5)
    # The ball's middle looks at the viewer, its left side to the left.
    assert (
        normals[HALF, HALF, 2] > 0.98
        and normals[HALF, 2, 0] < -0.6
        and normals[2, HALF, 1] > 0.6
    )


def test_a_stopped_run_goes_on_where_it_was(
    brass, tmp_path, monkeypatch, capsys, refused
):
    out = tmp_path / "maps"
    args = ["maps", str(brass), "-o", str(out), *TILES]
    with monkeypatch.context() as patch:
        patch.setattr(command, "save_folder", interrupt)
        assert main(args) == 130
    err = capsys.readouterr().err
    assert err.startswith("error: interrupted; finished tiles stay in")
    assert err.count("\n") == 1
    (tiles,) = out.iterdir()
    # Photographs are looked at one after the other: nobody wants all of them.
    monkeypatch.setattr(Photographs, "load", interrupt)
    # Another job must not mix with these tiles.
    assert "holds results of another job" in refused(*args, "--noise", "0.02")
    ledger = tiles / "ledger" / "c"
    times = {path: path.stat().st_mtime_ns for path in ledger.rglob("*")}
    assert len(times) > 1

    def look(folder, found, **kept):
        assert times == {p: p.stat().st_mtime_ns for p in ledger.rglob("*")}
        interrupt()

    with monkeypatch.context() as patch:
        patch.setattr(command, "save_folder", look)
        assert main(args) == 130
    assert main([*args, "--no-pictures"]) == 0
    names = {path.name for path in out.iterdir()}
    assert {"maps.npz", "maps.json", "normals.npy", "diffuse.tif"} <= names
    normals, shown = np.load(out / "normals.npy"), out / "normals.png"
    inside = normals.any(axis=-1, keepdims=True)
    expected = np.where(inside, (normals + 1) / 2, 0)
    np.testing.assert_allclose(pf.read_image(shown, "linear"), expected, atol=1e-5)
    assert "tiles" not in names and "diffuse.png" not in names
    # Finished maps stay, unless told otherwise.
    capsys.readouterr()
    assert "there are maps in it; expected a new one, or overwrite" in refused(*args)
    assert main([*args, "--overwrite", "--no-pictures"]) == 0


@pytest.mark.parametrize("failing, status", ENDS)
def test_a_result_outlives_its_pictures(
    brass, tmp_path, monkeypatch, capfd, failing, status
):
    monkeypatch.setattr(command, "draw", failing)
    # The test's own output stays where it is.
    monkeypatch.setattr(os, "dup2", lambda *args: None)
    out = tmp_path / "out"
    assert main(["maps", str(brass), "-o", str(out), *TILES]) == status
    names = os.listdir(out)
    assert "maps.npz" in names and not {command.TILES, WORK} & {*names}
    assert f"\n{out}: " in capfd.readouterr().out


def test_a_full_disk(brass, tmp_path, refused):
    """What was finished before stays, for the next run."""
    args = ["maps", str(brass), "-o", str(tmp_path / "out"), *TILES, "--no-pictures"]
    with full_disk(2000):
        err = refused(*args)
    assert "cannot be written: File too large; photographs stand there" in err
    assert "TMPDIR" in err and not (tmp_path / "out").exists()
    with full_disk(4000):
        assert "maps.npz: cannot be written" in refused(*args)
    assert [path.name for path in (tmp_path / "out").iterdir()] == [command.TILES]
    assert main(args) == 0


def test_a_highlight_for_all_pixels(brass, tmp_path, monkeypatch, asked_of):
    """Found by a fit of one material, of which each pixel is given the highlight."""
    words = ["maps", brass, "-o", tmp_path / "maps", "--highlight", "shared"]
    words += ["--noise", "0.01", "--bounds", "shininess=1:5000"]
    (scenes, images), options = asked_of("phongfit.commands.maps.fit", *words)
    assert len(scenes) == len(images) == len(options["mask"]) == 3
    assert options["unknowns"] == ("ambient", "diffuse", "specular", "shininess")
    assert options["bounds"] == {"shininess": (1, 5000)}
    one = types.SimpleNamespace(material=pf.preset("gold"))
    monkeypatch.setattr(command, "fit", lambda *_, **__: one)
    _, options = asked_of("phongfit.commands.maps.fit_maps", *words)
    assert options["unknowns"] == ("ambient", "diffuse")
    assert options["known"] is one.material and options["noise"] == 0.01


def test_textures_of_a_gltf_file(mapped, tmp_path, capsys):
    path = tmp_path / "a.gltf"
    assert main(["export", str(mapped), "--to", "gltf", "-o", str(path)]) == 0
    text = path.read_text()
    (mesh,) = trimesh.load_scene(path).geometry.values()
    material = mesh.visual.material  # pyright: ignore
    maps, _, normals = load_folder(mapped)
    inside = ~maps.flagged(pf.Flag.OUTSIDE)
    base = np.asarray(material.baseColorTexture)  # pyright: ignore
    assert np.array_equal(base[..., 3] > 0, inside)
    (saved,) = json.loads(text)["materials"]
    factor = saved["pbrMetallicRoughness"]["baseColorFactor"][:3]
    linear = decode(base[..., :3] / 255, "srgb") * factor
    identified = inside[..., None] & np.isfinite(maps.stderr.diffuse)
    np.testing.assert_allclose(linear[identified], maps.diffuse[identified], atol=0.005)
    # Its lights leave some of it dark.
    unidentified = inside & ~maps.identified
    assert 0 < unidentified.sum() < 0.5 * inside.sum()
    for k in range(3):
        middle = np.median(maps.diffuse[identified[..., k], k])
        filled = linear[inside & ~identified[..., k], k]
        np.testing.assert_allclose(filled, middle, atol=0.005)
    words = f"{unidentified.sum()} of {inside.sum()} pixels do not identify all"
    assert words in capsys.readouterr().out
    rough = np.asarray(material.metallicRoughnessTexture)  # pyright: ignore
    expected = (2 / (maps.shininess[..., 0] + 2)) ** 0.25
    np.testing.assert_allclose(
        rough[..., 1][inside] / 255, expected[inside], atol=0.003
    )
    assert not rough[..., 2].any()
    shown = np.asarray(material.normalTexture)[..., :3] / 255 * 2 - 1  # pyright: ignore
    np.testing.assert_allclose(shown[inside], normals[inside], atol=0.01)
    # Row 0 of the image is at the top of the plane.
    top = mesh.vertices[:, 1] > 0
    np.testing.assert_allclose(mesh.visual.uv[top][:, 1], 1)  # pyright: ignore


def test_textures_of_an_mtl(mapped, tmp_path, capsys, refused):
    path = tmp_path / "a.mtl"
    assert main(["export", str(mapped), "--to", "mtl", "-o", str(path)]) == 0
    lines = dict(line.split(" ", 1) for line in path.read_text().splitlines()[1:])
    maps, _, _ = load_folder(mapped)
    inside = ~maps.flagged(pf.Flag.OUTSIDE)
    maps_of = {key: words.removeprefix("-clamp on ") for key, words in lines.items()}
    diffuse = pf.read_image(tmp_path / maps_of["map_Kd"], "srgb")
    diffuse *= [float(word) for word in lines["Kd"].split()]
    identified = maps.identified
    np.testing.assert_allclose(
        diffuse[identified], maps.diffuse[identified], atol=0.005
    )
    exponent = pf.read_image(tmp_path / maps_of["map_Ns"], "linear")
    exponent *= float(lines["Ns"])
    np.testing.assert_allclose(
        exponent[inside][:, 0], maps.shininess[inside][:, 0], rtol=0.01
    )
    capsys.readouterr()
    for to in ("json", "opengl"):
        args = ["export", str(mapped), "--to", to, "-o", f"{tmp_path}/x"]
        assert f"{to} holds one material" in refused(*args)
    assert "expected mtl, gltf, obj, ply or stl for maps" in refused(
        "export", mapped, "-o", tmp_path / "x.usda"
    )


@pytest.mark.parametrize(
    "name, content, words",
    [
        ("maps.npz", b"PK\x03\x04", "maps.npz: cannot be read"),
        ("maps.json", b"{}", "maps.json: format: is missing"),
        ("normals.npy", None, "normals.npy: cannot be read"),
    ],
)
def test_broken_folders(mapped, tmp_path, refused, name, content, words):
    folder = tmp_path / "maps"
    folder.mkdir()
    for path in mapped.glob("*.np*"):
        (folder / path.name).write_bytes(path.read_bytes())
    (folder / "maps.json").write_bytes((mapped / "maps.json").read_bytes())
    (folder / name).unlink()
    if content is not None:
        (folder / name).write_bytes(content)
    assert words in refused("export", folder, "--to", "gltf", "-o", tmp_path / "a.glb")
    assert not (tmp_path / "a.glb").exists()


def test_record_is_whole(mapped):
    record = json.loads((mapped / "maps.json").read_text())
    assert record["model"]["kind"] == "blinn-phong"
    assert record["made_with"]["jax"]


def test_a_zarr_array_and_a_store(stored, tmp_path, capsys, refused):
    """To a store, to a folder, and the same as from Python."""
    data = pf.read_dataset(stored.parent)
    known = pf.preset("brass")
    images, unknowns = np.stack(data.images), ("ambient", "diffuse")
    # As many pixels at a time as a chunk has, so that the program is the same.
    expected = pf.fit_maps(
        data.scenes, images, unknowns=unknowns, known=known, noise=0.01, tile_pixels=64
    )
    out = tmp_path / "maps.zarr"
    assert main(["maps", str(stored), "-o", str(out), *FEW]) == 0
    told = capsys.readouterr().out
    assert told.startswith("phongfit: maps of 16 × 16 pixels") and str(out) in told
    same(pf.StoredMaps(out).load(), expected)
    # Again: nothing is done. Others in its place want to be asked for.
    assert main(["maps", str(stored), "-o", str(out), *FEW]) == 0
    assert "another job (its lights differs)" in refused(
        "maps", stored, "-o", out, *FEW[:-1], "0.1"
    )
    words = ["maps", str(stored), "-o", str(out), *FEW[:-1], "0.1", "--overwrite"]
    assert main(words) == 0
    folder = tmp_path / "maps"
    assert main(["maps", str(stored), "-o", str(folder), *FEW, "--no-pictures"]) == 0
    maps, record, _ = load_folder(folder)
    same(maps, expected)
    assert set(record.data.inputs) >= {"scene.json", "stack.zarr"}
    assert not (folder / "tiles").exists()


def test_what_is_not_of_maps_stays(stored, tmp_path, refused):
    """Before anything is put among it, or into the images."""
    out = tmp_path / "maps.zarr"
    out.mkdir()
    (out / "letter.txt").write_text("mine")
    for more in [], ["--overwrite"]:
        assert "is not replaced, since it holds letter.txt" in refused(
            "maps", stored, "-o", out, *FEW, *more
        )
        assert files_in(out).keys() == {(out / "letter.txt").relative_to(out)}
    (out / "letter.txt").unlink()
    assert main(["maps", str(stored), "-o", str(out), *FEW, "--overwrite"]) == 0
    # What came among older maps.
    (out / "letter.txt").write_text("mine")
    before = files_in(out)
    assert main(["maps", str(stored), "-o", str(out), *FEW, "--overwrite"]) == 2
    assert files_in(out) == before


@pytest.mark.extended
def test_normals_are_sought(capture, tmp_path):
    folder, hidden = capture
    out = tmp_path / "maps"
    args = ["maps", str(folder), "--normals", "fit", "--encoding", "linear"]
    assert main([*args, "-o", str(out), "--no-pictures"]) == 0
    maps, record, normals = load_folder(out)
    assert record.settings.normals == "fit" and record.settings.loss == "cauchy"
    assert maps.unknowns == ("diffuse", "specular", "shininess")
    np.testing.assert_array_equal(normals, np.load(out / "normals.npy"))
    np.testing.assert_allclose(normals, maps.normals, atol=1e-6)
    assert np.median(hidden.angles(maps)) < 1
    assert maps.identified.mean() > 0.9 and np.isfinite(maps.normals_stderr).any()


def test_normals_are_asked_for(capture, tmp_path, asked_of, capsys, refused):
    """What becomes of them, and of materials, stands in `tests/maps`."""
    folder, _ = capture
    args = ["maps", str(folder), "--normals", "fit", "--encoding", "linear"]
    args += ["-o", str(tmp_path / "maps")]
    fit_maps = "phongfit.commands.maps.fit_maps"
    (scenes, stack), options = asked_of(fit_maps, *args)
    assert len(scenes) == 24 and stack.shape == (24, 16, 24)
    assert (options["normals"], options["loss"], options["passes"]) == (
        *("fit", "cauchy", 2),
    )
    assert options["unknowns"] == ("diffuse", "specular", "shininess")
    assert options["materials"] is None
    for words, wanted in (("3", 3), ("auto", "auto")):
        _, options = asked_of(fit_maps, *args, "--materials", words)
        assert options["materials"] == wanted
    capsys.readouterr()
    for more, words in (
        (["--materials", "several"], "materials: expected a whole number"),
        (["--highlight", "shared"], "highlight: expected own"),
        (["--passes", "0"], "passes: expected 1, or more"),
        (["--sphere", "8", "8", "4"], "got both"),
    ):
        assert words in refused(*args, *more)
    assert "only `phongfit maps` seeks normals" in refused("fit", *args[1:])
    (folder / "dome.lp").rename(folder / "dome.txt")
    assert "lights: expected them where normals are sought" in refused(*args)
    (folder / "dome.txt").rename(folder / "dome.lp")
