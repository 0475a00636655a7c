"""Tiles: the same bits however they are cut, read, interrupted or spread."""

import dataclasses
import functools
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from time import sleep
from typing import Any

import equinox as eqx
import numpy as np
import pytest
import zarr
from PIL import Image

import phongfit as pf
from phongfit.files.images import to_levels, write_image
from phongfit.maps.job import make_job
from phongfit.maps.stacks import AbstractStack, ArrayStack
from tests.files.test_photographs import exif
from tests.maps.synthetic import Stack, make_stack, same

# The plumbing is the same for every fit: the fewest unknowns compile fastest.
SIZE = 512
QUICK = {
    "unknowns": ("diffuse",),
    "film": pf.Film(clamp=False),
    "tile_pixels": SIZE,
}


@functools.cache
def stack() -> Stack:
    """Six tiles."""
    return make_stack(48, 64, 4, ambient=0.0)


def fitted(images: Any = None, **options: Any) -> pf.Maps:
    """Maps of the stack, or of other images of its scenes."""
    images = stack().images if images is None else images
    return pf.fit_maps(stack().scenes, images, **(QUICK | options))


def finished(out: Path) -> dict[str, int]:
    """Finished tiles of a store, with the time when each was written."""
    ledger = (out / "ledger" / "c").glob("*/0/0")
    return {path.parent.parent.name: path.stat().st_mtime_ns for path in ledger}


@pytest.fixture(scope="module")
def maps() -> pf.Maps:
    return fitted()


def test_tiles_of_any_size(maps):
    same(fitted(tile_pixels=2 * SIZE), maps)


def test_sources(maps, tmp_path):
    """Memory-mapped, a list, another memory order."""
    np.save(tmp_path / "stack.npy", stack().images)
    mapped = np.load(tmp_path / "stack.npy", mmap_mode="r")
    turned = [np.asfortranarray(image) for image in stack().images]
    for images in (mapped, list(stack().images), turned):
        same(fitted(images), maps)


@pytest.mark.extended
def test_photographs_one_at_a_time(tmp_path):
    paths = [tmp_path / f"{k}.png" for k in range(4)]
    for path, image in zip(paths, stack().images, strict=True):
        write_image(path, image, "linear", 16)
    photographs = pf.PhotographStack(paths, "linear")
    read = [pf.read_image(path, "linear") for path in paths]
    found, expected = (fitted(images) for images in (photographs, read))
    same(found, expected)
    assert photographs.itemsize == 2
    with pytest.raises(ValueError, match="gone.png"):
        pf.PhotographStack([tmp_path / "gone.png"], "linear")


def test_exposures_that_differ_come_to_the_light_of_the_shortest(tmp_path):
    light = np.full((4, 6, 3), 0.4)
    light[0, 0] = 0.9
    for name, time in (("1.png", 0.5), ("2.png", 1.0)):
        levels = np.round(255 * np.clip(2 * time * light, 0, 1)).astype(np.uint8)
        Image.fromarray(levels).save(tmp_path / name, exif=exif(time=time))
    paths = [tmp_path / "1.png", tmp_path / "2.png"]
    photographs = pf.PhotographStack(paths, "linear")
    assert photographs.notes == (
        "1.png 0.5 s, 2.png 1 s: brought to common light, to some 5 %, as cameras "
        "state rounded numbers",
    )
    taken = photographs.take(np.arange(24), [0, 1])
    hidden = np.ma.getmaskarray(taken)
    # The lamp of the longer one is cut off at white.
    assert hidden[1, 0].all() and hidden.sum() == 3
    assert np.ma.getdata(taken)[:, 1:] == pytest.approx(0.4, abs=0.003)
    paths.append(tmp_path / "3.png")
    Image.fromarray(levels).save(paths[-1])
    with pytest.raises(ValueError, match="3.png: expected an exposure time"):
        pf.PhotographStack(paths, "linear")


@pytest.mark.extended
def test_each_exposure_has_a_table_of_its_own(tmp_path):
    """Samples of 8 bits are fitted as their light is, to the last bit."""
    paths = [tmp_path / f"{k}.png" for k in range(4)]
    for k, (path, image) in enumerate(zip(paths, stack().images, strict=True)):
        levels = to_levels(image / 2 * (1 + k % 2), "srgb", 8)
        Image.fromarray(levels).save(path, exif=exif(time=0.5 * (1 + k % 2)))
    photographs = pf.PhotographStack(paths, "srgb")
    light = photographs.take(np.arange(48 * 64), range(4)).reshape(4, 48, 64, 3)
    coded = photographs.take_coded(np.arange(5), [3, 0])
    assert coded.table is not None
    assert coded.numbers.dtype == np.uint8 and coded.table.shape == (2, 256)
    found, expected = (fitted(images) for images in (photographs, light))
    same(found, expected)
    assert found.identified.any()


def test_a_stack_is_read_by_one_thread_at_a_time(maps):
    class Seeking(AbstractStack):
        """Breaks if two threads read it at once."""

        inner, reading = ArrayStack(stack().images), False

        @property
        def shape(self):
            return self.inner.shape

        def take(self, pixels, order):
            assert not self.reading
            self.reading = True
            sleep(0.02)
            self.reading = False
            return self.inner.take(pixels, order)

        def identify(self, update):
            self.inner.identify(update)

    same(fitted(Seeking()), maps)


def test_a_stack_that_breaks_and_finished_tiles_stay(tmp_path):
    class Breaking(ArrayStack):
        """Is asked for two tiles, and then no more."""

        taken = 0

        def take_coded(self, pixels, order):
            Breaking.taken += 1
            if Breaking.taken >= 3:
                raise ValueError("2.png: cannot be read")
            return super().take_coded(pixels, order)

    out = tmp_path / "out"
    with pytest.raises(ValueError, match=r"2\.png: cannot be read"):
        fitted(Breaking(stack().images), out=out)
    done = finished(out)
    assert len(done) == 2
    found = fitted(out=out)
    assert done.items() < finished(out).items()
    expected = fitted()
    same(found, expected)


def test_a_broken_tile_is_done_again(maps, tmp_path):
    out = tmp_path / "out"
    fitted(out=out)
    path = out / "diffuse" / "c" / "1" / "0" / "0"
    path.write_bytes(path.read_bytes()[:1000])
    same(fitted(out=out), maps)


def test_a_tile_that_is_another_or_blank_is_done_again(maps, tmp_path):
    out = tmp_path / "out"
    fitted(out=out)
    for second in out.glob("*/c/1"):
        for other in (second.with_name("0"), second.with_name("2")):
            shutil.rmtree(other) if other.is_dir() else other.unlink()
        copy = shutil.copytree if second.is_dir() else shutil.copy
        copy(second, second.with_name("0"))
    same(fitted(out=out), maps)


@pytest.mark.parametrize("text", ["[]", "7", "{"])
def test_a_store_that_is_none(tmp_path, text):
    (tmp_path / "zarr.json").write_text(text)
    with pytest.raises(ValueError, match=f"{tmp_path}: cannot be written"):
        fitted(out=tmp_path)


@pytest.mark.extended
def test_photographs_that_change_meanwhile_do_not_matter(tmp_path):
    paths = [tmp_path / f"{k}.png" for k in range(4)]
    for path, image in zip(paths, stack().images, strict=True):
        write_image(path, image, "linear", 16)
    before = pf.PhotographStack(paths, "linear")
    read = [pf.read_image(path, "linear") for path in paths]
    write_image(paths[1], stack().images[2], "linear", 16)
    paths[2].unlink()
    found, expected = (fitted(images) for images in (before, read))
    same(found, expected)


@pytest.mark.extended
def test_masked_arrays_keep_their_masks(maps):
    hidden = np.zeros(stack().images.shape, bool)
    hidden[0, :, ::2] = True
    spoilt = np.where(hidden, 0.9, stack().images)
    found, wanted = (
        fitted(images, mask=mask)
        for images, mask in (
            (np.ma.MaskedArray(spoilt, hidden), None),
            (spoilt, list(~hidden)),
        )
    )
    same(found, wanted)


def test_another_job_is_refused(tmp_path):
    out = tmp_path / "out"
    fitted(out=out)
    with pytest.raises(ValueError, match="another job .*images differs"):
        fitted(2 * stack().images, out=out)
    with pytest.raises(ValueError, match="another job .*settings differs"):
        fitted(out=out, min_cosine=0.1)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "a.txt").write_text("a")
    with pytest.raises(OSError, match=r"is not replaced, since it holds a\.txt"):
        fitted(out=tmp_path / "full")


def test_a_folder_with_names_as_maps_have_stays(tmp_path):
    (tmp_path / "normals").mkdir()
    (tmp_path / "normals" / "mine.txt").write_text("mine")
    with pytest.raises(OSError, match="is not replaced, since it holds no maps"):
        fitted(out=tmp_path)
    assert (tmp_path / "normals" / "mine.txt").read_text() == "mine"


def test_a_run_that_was_refused_leaves_no_store(maps, tmp_path):
    with pytest.raises(ValueError, match="mask: it leaves no pixel"):
        fitted(out=tmp_path / "out", mask=np.zeros((48, 64), bool))
    same(fitted(out=tmp_path / "out"), maps)


def test_images_of_a_store_of_any_name(maps, tmp_path):
    zarr.create_array(tmp_path / "stack", data=stack().images, chunks=(4, 16, 64, 3))
    same(fitted(tmp_path / "stack"), maps)
    same(fitted(str(tmp_path / "stack")), maps)


def test_an_image_of_one_pixel_and_its_normal_map(tmp_path):
    """It does not stand for a plane, and its pixel may be outside the surface."""
    camera = pf.OrthographicCamera(1, 1)
    lamp = pf.DirectionalLight((0, 0, 1))
    for normal, outside in ((1.0, False), (0.0, True)):
        surface = pf.NormalMap(np.array([[[0, 0, normal]]]))
        scenes = [pf.Scene(surface, camera, lamp)] * 2
        images, out = np.full((2, 1, 1, 3), 0.3), tmp_path / f"{normal}"
        options: Any = QUICK | {"tile_pixels": None, "out": out, "load": False}
        found = pf.fit_maps(scenes, images, **options).load()
        assert found.flagged(pf.Flag.OUTSIDE).tolist() == [[outside]]


def test_shadows_fall_from_one_block_on_others(tmp_path):
    y, x = np.mgrid[:48, :64].astype(float)
    positions = np.stack([x - 31.5, 23.5 - y, 0 * x], axis=-1)
    up = np.broadcast_to([0.0, 0, 1], positions.shape)
    surface = pf.NormalMap(up, positions=positions)
    scenes = [
        dataclasses.replace(scene, surface=surface, shadows=True)
        for scene in stack().scenes
    ]
    options: Any = QUICK | {"tile_pixels": None}
    with pytest.raises(ValueError, match="scenes: expected load=True with a normal"):
        pf.fit_maps(scenes, stack().images, out=tmp_path, load=False, **options)
    assert not any(tmp_path.iterdir())


def test_stores_of_before_and_old_names(maps, tmp_path):
    with pytest.warns(DeprecationWarning, match="write out=") as told:
        same(fitted(output=tmp_path / "tiles"), maps)
    # Python shows it to those whose line it is; checks of annotations are in between.
    mine = {__file__} if "tests.annotations" not in sys.modules else {told[0].filename}
    assert told[0].filename in mine
    options: Any = {"unknowns": ("diffuse",), "film": pf.Film(clamp=False)}
    out = tmp_path / "maps"
    with pytest.warns(DeprecationWarning, match="load=False") as told:
        stored = pf.fit_stored_maps(stack().scenes, stack().images, out, **options)
    with pytest.raises(ValueError, match="output: expected its new name out alone"):
        with pytest.deprecated_call():
            fitted(out=tmp_path / "a", output=tmp_path / "b")
    assert told[0].filename == __file__
    same(stored.load(), maps)
    # Version 1 has no arrays of the maps as a whole.
    record = json.loads((out / "zarr.json").read_text())
    record["attributes"] |= {"version": 1}
    del record["attributes"]["whole"]
    (out / "zarr.json").write_text(json.dumps(record))
    same(pf.StoredMaps(out).load(slice(0, 48)), maps)


@pytest.mark.parametrize(
    "options, told",
    [
        ({"out": "a", "passes": 2, "normals": "fit"}, "passes: expected 1"),
        ({"out": "a", "tile_pixels": 9}, "tile_pixels: expected None"),
        ({"out": "a", "normals": "fit", "strengths": "fit"}, "strengths: expected"),
        ({}, "out: expected a store with load=False"),
        ({"load": True, "client": 1}, "client: expected load=False"),
        ({"load": True, "block": (2, 2)}, "block: expected it with out alone"),
        (
            {"load": True, "out": "a", "block": (2, 2), "tile_pixels": 9},
            r"tile_pixels: expected it or block, got 9 and \(2, 2\)",
        ),
    ],
)
def test_what_blocks_one_by_one_do_not_allow(options, told):
    with pytest.raises(ValueError, match=told):
        pf.fit_maps(stack().scenes, stack().images, **{"load": False} | options)


def test_other_noise_is_another_job():
    """How large it is, not only whether it is known."""
    images = ArrayStack(stack().images)
    one, other = (
        make_job(stack().scenes, images, noise=np.full((48, 64), level)).identify()
        for level in (0.01, 0.02)
    )
    assert {name for name in one if one[name] != other[name]} == {"noise"}


def test_saved_and_loaded(maps, tmp_path):
    maps.save(tmp_path / "maps.npz")
    read = pf.load_maps(tmp_path / "maps.npz")
    same(read, maps)
    assert eqx.tree_equal(read.camera, stack().scenes[0].camera)
    assert eqx.tree_equal(read.specular_model, pf.BlinnPhong())
    normals = np.asarray(stack().scenes[0].trace().normal)
    np.testing.assert_allclose(read.normals, normals, atol=1e-6)
    # Normals that were given are known; a normal map does not know how far it is.
    assert not read.normals_stderr.any() and np.isnan(read.depth).all()
    assert str(maps).startswith("phongfit: maps of 48 × 64 pixels, 3,072 fitted")
    with pytest.raises(ValueError, match="ends in .npz"):
        maps.save(tmp_path / "maps.png")
    (tmp_path / "broken.npz").write_bytes(b"PK")
    with pytest.raises(ValueError, match=r"broken\.npz: cannot be read"):
        pf.load_maps(tmp_path / "broken.npz")


@pytest.mark.parametrize(
    "name, wrong, told",
    [
        ("flags", np.zeros(5, np.uint16), r"flags: expected shape \(height, width\)"),
        ("flags", np.zeros((48, 64)), "flags: expected whole numbers"),
        ("diffuse", np.zeros((48, 64, 1), np.float32), "diffuse: expected floats of"),
        ("specular", np.full((48, 64, 3), np.nan), "specular: expected finite"),
        ("stderr_ambient", np.full((48, 64, 3), -1.0), "stderr_ambient: expected"),
        ("shininess", np.float32(3), "shininess: expected 1 or 3 channels"),
        ("unknowns", np.array(["gloss"]), "unknowns: expected names of"),
        ("noise_given", np.zeros(3), "noise_given: expected floats of"),
        ("noise", None, "has no array 'noise'"),
        ("normals", np.full((48, 64, 3), 0.9), "normals: expected unit vectors"),
        ("normals_stderr", np.full((48, 64), -1.0), "normals_stderr: expected numbers"),
        ("depth", np.zeros((48, 64), int), "depth: expected floats"),
        ("view", np.array('{"camera": {"kind": "x"}}'), "view: camera.kind: expected"),
        (
            "view",
            np.array('{"camera": {"kind": "orthographic", "height": 3}}'),
            r"camera: expected \(48, 64\) pixels",
        ),
    ],
)
def test_maps_of_wrong_arrays(maps, tmp_path, name, wrong, told):
    path = tmp_path / "maps.npz"
    maps.save(path)
    with np.load(path) as arrays:
        changed = dict(arrays) | {name: wrong}
    if wrong is None:
        del changed[name]
    np.savez(path, **changed)
    with pytest.raises(ValueError, match=rf"maps\.npz: cannot be read: {told}"):
        pf.load_maps(path)


def test_a_camera_that_files_do_not_know(maps, tmp_path):
    class Pinhole(pf.geometry.AbstractCamera):
        width: int = 64
        height: int = 48
        position: Any = None
        rotation: Any = None

        def ray(self, x, y):
            raise NotImplementedError

        def to_viewer(self, position):
            raise NotImplementedError

        def project(self, position):
            raise NotImplementedError

    own = dataclasses.replace(maps, camera=Pinhole())
    with pytest.warns(UserWarning, match="camera: is left out: Pinhole"):
        own.save(tmp_path / "maps.npz")
    read = pf.load_maps(tmp_path / "maps.npz")
    assert read.camera is None and read.specular_model is not None


@pytest.mark.extended
def test_shape_in_the_axes_of_the_camera():
    """A sphere before a turned camera: normals and depth as the camera has them."""
    camera = pf.PerspectiveCamera.look_at((4, 0, 3), width=64, height=48, fov_y=30.0)
    scenes = [pf.Scene(pf.Sphere(), camera, s.lights) for s in stack().scenes]
    maps = pf.fit_maps(scenes, stack().images, **QUICK)
    seen = maps.normals.any(axis=-1)
    np.testing.assert_array_equal(seen, ~maps.flagged(pf.Flag.OUTSIDE))
    np.testing.assert_array_equal(np.isfinite(maps.depth), seen)
    np.testing.assert_array_equal(maps.normals_stderr, np.where(seen, 0, np.inf))
    middle = maps.normals[23:25, 31:33].mean(axis=(0, 1))
    np.testing.assert_allclose(middle, [0, 0, 1], atol=0.01)
    assert maps.depth[24, 32] == pytest.approx(4, abs=0.01)
    y, x = np.argwhere(seen)[0]
    assert maps.normals[y, x, 1] > 0.9 and maps.depth[y, x] > 4.5


PROGRAM = """
import os
import signal
import sys
from pathlib import Path

import phongfit as pf
from phongfit.maps.stacks import AbstractStack, ArrayStack
from tests.maps.test_tiles import finished, fitted, stack

out, file, last = sys.argv[1:]


class Killed(AbstractStack):
    def __init__(self, inner):
        self.inner = inner

    @property
    def shape(self):
        return self.inner.shape

    def identify(self, update):
        self.inner.identify(update)

    def take(self, pixels, order):
        done = len(finished(Path(out))) if out else 0
        if done >= int(last) >= 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return self.inner.take(pixels, order)


images = Killed(ArrayStack(stack().images))
fitted(images, out=out or None).save(file)
"""


def run(*arguments: str, **environment: str) -> int:
    """Status of the program above: given a folder, a file, and when it is killed."""
    return subprocess.run(
        [sys.executable, "-c", PROGRAM, *arguments],
        cwd=Path(__file__).parents[2],
        env=os.environ | environment,
    ).returncode


@pytest.mark.extended
def test_killed_and_run_again(maps, tmp_path):
    """kill -9 in the middle: the second run ends with the bits of a quiet one."""
    out, file = tmp_path / "out", tmp_path / "maps.npz"
    assert run(str(out), str(file), "2") == -signal.SIGKILL
    assert not file.exists()
    assert 2 <= len(finished(out)) < 6
    assert run(str(out), str(file), "-1") == 0
    same(pf.load_maps(file), maps)


@pytest.mark.extended
def test_four_devices_give_what_one_gives(maps, tmp_path):
    file = tmp_path / "maps.npz"
    flags = "--xla_force_host_platform_device_count=4"
    assert run("", str(file), "-1", XLA_FLAGS=flags) == 0
    found = pf.load_maps(file)
    for name in ("diffuse", "noise"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(maps, name), rtol=1e-5, atol=1e-6
        )
    np.testing.assert_array_equal(found.flags, maps.flags)
