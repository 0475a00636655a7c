"""`phongfit maps` of a zarr array: what lies beside it, and where the maps go."""

import json
import shutil

import numpy as np
import pytest
import zarr
from PIL import Image

import phongfit as pf
from phongfit.cli import main
from phongfit.files.lp import write_lp
from phongfit.maps.folder import load_folder
from tests.commands.conftest import FEW, SIDE, files_in
from tests.maps.synthetic import same


@pytest.mark.extended
def test_photographs_to_a_store(copy, tmp_path, capsys, refused):
    """The same maps as in a folder; samples that are masked are left out."""
    hidden = np.full((SIDE, SIDE), 255, np.uint8)
    hidden[6:10] = 0
    Image.fromarray(hidden).save(copy / "mask.png")
    # Two by two pixels are left out of all of them: they are outside.
    hidden[:], hidden[7:9, 7:9] = 255, 0
    Image.fromarray(hidden).save(copy / "hole.png")
    scene = json.loads((copy / "scene.json").read_text())
    for image, mask in zip(scene["images"], ("hole", "mask", "hole"), strict=True):
        image["mask"] = f"{mask}.png"
    (copy / "scene.json").write_text(json.dumps(scene))
    folder, store = tmp_path / "maps", tmp_path / "maps.zarr"
    assert main(["maps", str(copy), "-o", str(folder), *FEW, "--no-pictures"]) == 0
    expected = load_folder(folder)[0]
    assert {6, 9} <= {*expected.samples.flat}
    assert (expected.flags[7:9, 7:9] == pf.Flag.OUTSIDE).all()
    assert main(["maps", str(copy), "-o", str(store), *FEW]) == 0
    assert str(store) in capsys.readouterr().out
    same(pf.StoredMaps(store).load(), expected)
    # Other photographs are another job.
    first, second, _ = (copy / image["file"] for image in scene["images"])
    shutil.copy(first, second)
    assert "another job (its images differs)" in refused(
        "maps", copy, "-o", store, *FEW
    )


@pytest.mark.extended
def test_a_ball_and_a_list_of_lights(stored, tmp_path):
    """As of a folder of the same images, but for the edges that it leaves out."""
    encoded = str(pf.read_dataset(stored.parent).film.encoding)  # pyright: ignore
    (stored.parent / "scene.json").unlink()
    names = sorted(path.name for path in stored.parent.glob("0*.png"))
    vectors = [(0.5, 0.2, 1), (-0.5, 0.3, 1), (0, -0.6, 1)]
    write_lp(stored.parent / "dome.lp", names, vectors)
    words = "--sphere 8 8 6.5 --unknowns diffuse --min-cosine 0.1".split()
    found = []
    for source in (stored.parent, stored):
        encoding = [] if source == stored else ["--encoding", encoded]
        folder = tmp_path / "out" / source.stem
        args = ["maps", str(source), "-o", str(folder), *words, *encoding]
        assert main([*args, "--no-pictures"]) == 0
        found.append(load_folder(folder)[0])
    a, b = found
    np.testing.assert_array_equal(a.flags & 1, b.flags & 1)
    np.testing.assert_array_equal(a.samples, b.samples)
    np.testing.assert_allclose(a.diffuse, b.diffuse, rtol=1e-5)


@pytest.mark.extended
def test_a_pinhole_and_a_list_of_lights(capture, tmp_path):
    """A plane that is not known pixel by pixel is seen along the same rays."""
    folder, _ = capture
    images = [pf.read_image(path, "linear") for path in sorted(folder.glob("*.png"))]
    chunks = (24, 16, 24, 3)
    zarr.create_array(tmp_path / "stack.zarr", data=np.stack(images), chunks=chunks)
    shutil.copy(folder / "dome.lp", tmp_path)
    words = ["--normals", "fit", "--passes", "1", "--no-pictures"]

    def shown(name, *more):
        args = ["maps", *more, "-o", str(tmp_path / name), *words]
        assert main(args) == 0
        return load_folder(tmp_path / name)[0]

    given = [str(folder), "--encoding", "linear"]
    a, straight = shown("a", *given, "--fov", "60"), shown("b", *given)
    b = shown("c", str(tmp_path / "stack.zarr"), "--fov", "60")
    for name in ("normals", "specular"):
        off, other = (
            np.abs(getattr(a, name) - getattr(x, name)) for x in (b, straight)
        )
        assert np.median(off) < 1e-4 < 1e-3 < np.median(other), name
    assert isinstance(b.camera, pf.PerspectiveCamera) and b.camera.width == 24


@pytest.mark.parametrize(
    "words, told",
    [
        (["--highlight", "shared"], "highlight: expected own with a zarr array"),
        ([*FEW, "--tile-pixels", "0"], "tile_pixels: expected a whole number"),
        (["--lights", "some.lp"], "scene.json is a scene, which says this itself"),
        (["--fov", "40"], "scene.json is a scene, which says this itself"),
        (["--normals", "fit"], "lights: expected an .lp or lights.json in"),
        (
            ["--dask", "local:1", "--tile-pixels", "64"],
            "dask: expected it without --tile-pixels, which one process fits",
        ),
        (["--dask", "tcp"], "dask: expected local:N or the address of a scheduler"),
    ],
)
def test_what_is_wrong_is_named(stored, tmp_path, refused, words, told):
    out = str(tmp_path / "maps.zarr")
    assert told in refused("maps", stored, "-o", out, *words)


def test_further_passes_over_a_plane(capture, tmp_path, asked_of):
    """It is known as one normal, which they need for every pixel."""
    folder, _ = capture
    images = [pf.read_image(path, "linear") for path in sorted(folder.glob("*.png"))]
    zarr.create_array(tmp_path / "stack.zarr", data=np.stack(images))
    shutil.copy(folder / "dome.lp", tmp_path)
    words = ["maps", tmp_path / "stack.zarr", "--normals", "fit"]
    words += ["--unknowns", "diffuse", "-o", tmp_path / "maps.zarr"]
    for more, load, size in (
        ([], False, (1, 1)),
        (["--passes", 2], True, (16, 24)),
        (["--strengths", "fit"], True, (16, 24)),
        (["--tile-pixels", 64], True, (16, 24)),
    ):
        place = "phongfit.commands.maps.fit_maps"
        (scenes, _), options = asked_of(place, *words, *more)
        assert options["load"] == load
        assert scenes[0].surface.mask.shape == size


def test_maps_stay_until_others_can_be_made(stored, tmp_path, refused):
    out = tmp_path / "maps.zarr"
    args = ["maps", str(stored), "-o", str(out), *FEW]
    assert main(args) == 0
    before = files_in(out)
    for words, told in (
        (["--tile-pixels", "0"], "tile_pixels: expected a whole number"),
        (["--passes", "2", "--dask", "local:1"], "dask: expected it without --passes"),
        (["--bounds", "diffuse=2:1"], "bounds"),
    ):
        assert told in refused(*args, "--overwrite", *words)
        assert files_in(out) == before
    assert main([*args[:-1], "0.1", "--overwrite"]) == 0
    assert files_in(out) != before


def test_stores_and_folders_are_not_mixed_up(brass, stored, tmp_path, refused):
    out = str(tmp_path / "maps.zarr")
    assert "wants a zarr array as DATASET" in refused(
        "maps", brass, "-o", out, "--dask", "local:1"
    )
    assert "no.zarr: there is no such zarr array" in refused(
        "maps", tmp_path / "no.zarr", "-o", out
    )
    (stored.parent / "scene.json").unlink()
    assert "no scene.json is beside it" in refused("maps", stored, "-o", out)
    # What holds no maps is not replaced.
    shutil.copytree(stored, out)
    assert main(["maps", str(stored), "-o", out, "--overwrite", "--scene", "x"]) == 2


@pytest.mark.parametrize("place", ["", "maps.zarr", "c/maps.zarr", "../linked.zarr"])
def test_images_are_no_place_for_maps(stored, refused, place):
    (stored.parent / "linked.zarr").symlink_to(stored)
    before, out = files_in(stored), str(stored / place)
    for more in [], ["--overwrite"]:
        assert "the images are there" in refused("maps", stored, "-o", out, *FEW, *more)
        assert files_in(stored) == before
