"""Data sets in our own layout and in DiLiGenT's."""

import dataclasses
import io
import json
from pathlib import Path
from typing import Any

import imagecodecs
import jax
import numpy as np
import pytest
import scipy.io

import phongfit as pf
from data_synth import make_dataset, make_lights, write_dataset
from phongfit.files.dataset import Dataset
from phongfit.files.datasets import open_dataset, read_dataset
from tests.helpers import photographs, said

SIZE = 12


def _make(**options) -> Dataset:
    return make_dataset(
        pf.Material((0.6, 0.3, 0.2), 0.3, 30.0, 0.5),
        key=jax.random.key(0),
        camera=pf.OrthographicCamera(SIZE, SIZE),
        **({"lights": make_lights(3, "mixed"), "noise": 0.01} | options),
    )


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("ours") / "set"
    write_dataset(_make(), folder, noise=0.01, seed=0)
    return folder


@pytest.fixture
def ours(written, tmp_path) -> Path:
    """A copy that a test may break."""
    for path in written.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    return tmp_path


def _edit(folder: Path, **changes) -> None:
    path = folder / "scene.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def _check_error(folder: Path, *words: str) -> None:
    with pytest.raises(ValueError) as caught:
        read_dataset(folder)
    told = str(caught.value)
    assert all(said(word, told) for word in words) and "\n" not in told, told


def test_what_was_made_is_read_back(written):
    made, read = _make(), read_dataset(written)
    assert read.name == "set" and read.names == made.names and read.film == made.film
    for one, other in (
        (made.images, read.images),
        (made.masks, read.masks),
        (jax.tree.leaves(made.scenes), jax.tree.leaves(read.scenes)),
        (jax.tree.leaves(made.truth), jax.tree.leaves(read.truth)),
    ):
        for a, b in zip(one, other, strict=True):
            assert np.array_equal(a, b) and a.dtype == b.dtype


def test_masks_and_lights_of_an_image(ours):
    mask = np.zeros((SIZE, SIZE), np.uint8)
    mask[2:5] = 255
    (ours / "mask.png").write_bytes(imagecodecs.png_encode(mask))
    _edit(
        ours,
        images=[
            {"file": "001.png", "lights": [2, 0], "mask": "mask.png"},
            {"file": "002.png", "lights": []},
            {"file": "003.png"},
        ],
    )
    read = read_dataset(ours)
    assert np.array_equal(read.masks[0], mask > 0) and read.masks[1].all()
    kinds = [[type(light).__name__ for light in scene.lights] for scene in read.scenes]
    every = ["DirectionalLight", "PointLight", "SpotLight"]
    assert kinds == [["SpotLight", "DirectionalLight"], [], every]


def test_cut_outs(ours):
    """Alpha is a mask, together with that of a file: NeRF's synthetic sets have it."""
    levels = imagecodecs.png_decode((ours / "001.png").read_bytes())
    highest = np.iinfo(levels.dtype).max
    alpha = np.full((SIZE, SIZE, 1), highest, levels.dtype)
    alpha[:4], alpha[4] = 0, highest // 2
    cut_out = np.concatenate([levels, alpha], axis=-1)
    (ours / "001.png").write_bytes(imagecodecs.png_encode(cut_out))
    mask = np.full((SIZE, SIZE), 255, np.uint8)
    mask[:, :3] = 0
    (ours / "mask.png").write_bytes(imagecodecs.png_encode(mask))
    for more, first in (({}, 0), ({"mask": "mask.png"}, 3)):
        _edit(ours, images=[{"file": "001.png", "lights": [0]} | more])
        expected = np.zeros((SIZE, SIZE), bool)
        expected[5:, first:] = True
        assert np.array_equal(read_dataset(ours).masks[0], expected)


def test_unclamped_images(ours):
    _edit(ours, clamped=False)
    assert read_dataset(ours).film == pf.Film(clamp=False)


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"images": []}, ["scene.json: images: is missing"]),
        ({"encoding": None}, ["scene.json: encoding: is missing"]),
        ({"images": [{"file": "009.png"}]}, ["009.png: cannot be read"]),
        (
            {"images": [{"file": "../001.png"}]},
            ["images[0]: expected ... got '../001.png'"],
        ),
        (
            {"images": [{"file": "/001.png"}]},
            ["images[0]: expected ... got '/001.png'"],
        ),
        ({"images": [{"file": "out.png"}]}, ["images[0]: 'out.png': is a link"]),
        ({"images": [{}]}, ["images[0].file: is missing"]),
        (
            {"images": [{"file": "001.png", "lights": [3]}]},
            ["images[0].lights: expected ... got [3]"],
        ),
        (
            {"images": [{"file": "001.png", "lights": [-1]}]},
            ["images[0].lights: expected ... got [-1]"],
        ),
        (
            {"images": [{"file": "001.png", "lights": [0, 0]}]},
            ["images[0].lights: expected ... got [0, 0]"],
        ),
        ({"images": [{"file": "001.png", "mask": "no.png"}]}, ["no.png: cannot be"]),
        (
            {"images": [{"file": "small.png"}]},
            ["small.png: expected 12 × 12 pixels ... got 3 × 2"],
        ),
        (
            {"images": [{"file": "001.png", "mask": "small.png"}]},
            ["small.png: expected 12 × 12 pixels ... got 3 × 2"],
        ),
        ({"images": [{"file": "scene.json"}]}, ["expected ... got suffix '.json'"]),
    ],
)
def test_wrong_lists_of_images(ours, changes, words):
    (ours / "out.png").symlink_to("/etc/passwd")
    small = np.zeros((2, 3), np.uint8)
    (ours / "small.png").write_bytes(imagecodecs.png_encode(small))
    _edit(ours, **changes)
    _check_error(ours, *words)


def test_truncated_image_and_wrong_truth(ours):
    data = (ours / "002.png").read_bytes()
    (ours / "002.png").write_bytes(data[: len(data) // 2])
    _check_error(ours, "002.png: is broken")
    (ours / "002.png").write_bytes(data)
    (ours / "truth.json").write_text("{}")
    _check_error(ours, "truth.json: format: is missing")
    (ours / "truth.json").unlink()
    assert read_dataset(ours).truth is None


def test_no_data_set(tmp_path):
    _check_error(tmp_path, "is no data set")
    _check_error(tmp_path / "absent", "there is no such folder")


def test_datasets_are_checked():
    made = _make()
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"images": made.images[:2]}, r"expected as many .*got \[3, 2, 3, 3\] of them"),
        (
            {"images": (np.zeros((3, 3, 3)),) * 3},
            r"001.png: expected image of .*got \(3, 3, 3\)",
        ),
        (
            {"masks": (np.ones((3, 3), bool),) * 3},
            r"001.png: expected mask of .*got \(3, 3\)",
        ),
    ]
    for changes, words in wrong:
        with pytest.raises(ValueError, match=words):
            dataclasses.replace(made, **changes)


# DiLiGenT's layout, with two lights on a slanted plate.

DIRECTIONS = [[0, 0, 1], [0.6, 0, -0.8]]
INTENSITIES = [[1, 2, 4], [0.5, 0.5, 0.5]]


@pytest.fixture
def diligent(tmp_path) -> Path:
    levels = np.full((2, 3, 3), 6553, np.uint16)
    levels[0, 1, 2] = 65535
    for name in ("001.png", "002.png"):
        (tmp_path / name).write_bytes(imagecodecs.png_encode(levels))
    (tmp_path / "filenames.txt").write_text("001.png\n002.png\n")
    np.savetxt(tmp_path / "light_directions.txt", DIRECTIONS)
    np.savetxt(tmp_path / "light_intensities.txt", INTENSITIES)
    mask = np.full((2, 3), 255, np.uint8)
    mask[1, 2] = 0
    (tmp_path / "mask.png").write_bytes(imagecodecs.png_encode(mask))
    normals = np.zeros((2, 3, 3))
    normals[...] = [0.6, 0, 0.8]
    normals[0, 0] = [np.sqrt(1 - 0.01), 0, 0.1]
    normals[1, 2] = 0
    scipy.io.savemat(tmp_path / "Normal_gt.mat", {"Normal_gt": normals})
    return tmp_path


def test_diligent(diligent):
    read = read_dataset(diligent)
    assert read.names == ("001.png", "002.png") and read.truth is None
    assert read.film == pf.Film(clamp=False)
    np.testing.assert_allclose(
        read.images[0][1, 1], np.array([1, 1 / 2, 1 / 4]) * 6553 / 65535, rtol=1e-6
    )
    expected = np.ones((2, 3, 3), bool)
    # The blue sample is saturated, the last pixel is outside of the mask.
    expected[0, 1, 2] = expected[1, 2] = False
    assert np.array_equal(read.masks[0], expected)
    for scene, direction in zip(read.scenes, DIRECTIONS, strict=True):
        (light,) = scene.lights
        assert isinstance(light, pf.DirectionalLight)
        np.testing.assert_allclose(light.direction, direction, rtol=1e-6)
        assert np.array_equal(light.intensity, [1, 1, 1])
        assert np.array_equal(
            pf.geometry.trace(scene.surface, scene.camera).to_viewer[0, 0], [0, 0, 1]
        )


def test_diligent_without_its_truth(diligent):
    """Where normals are fitted, the truth is not read, whether it is there or not."""
    with_truth = read_dataset(diligent, normals="fit")
    (diligent / "Normal_gt.mat").unlink()
    read = read_dataset(diligent, normals="fit")
    for scene in (with_truth.scenes[0], read.scenes[0]):
        assert isinstance(scene.surface, pf.NormalMap)
        assert (np.asarray(scene.surface.normals) == [0, 0, 1]).all()
        assert np.asarray(scene.surface.mask).tolist() == [
            [True] * 3,
            [True, True, False],
        ]
    assert np.array_equal(read.masks, with_truth.masks)


def test_diligent_with_alpha(diligent):
    levels = np.full((2, 3, 4), 6553, np.uint16)
    levels[..., 3], levels[1, 0, 3] = 65535, 65534
    (diligent / "002.png").write_bytes(imagecodecs.png_encode(levels))
    expected = [[True, True, True], [False, True, False]]
    assert read_dataset(diligent).masks[1].all(axis=-1).tolist() == expected


def test_diligent_leaves_out_grazing_samples(diligent):
    read = read_dataset(diligent, min_cosine=0.1, min_facing=0.15)
    used = [mask[..., 0] for mask in read.masks]
    # n_z = 0.1 at the first pixel; the second light is behind all of the others.
    assert np.array_equal(used[0], [[False, True, True], [True, True, False]])
    assert not used[1].any()


@pytest.mark.parametrize("layout", ["diligent", "ours"])
def test_photographs_are_read_when_they_are_wanted(layout, request):
    """A file that goes missing matters to those alone who ask for it."""
    folder = request.getfixturevalue(layout)
    data, loaded = open_dataset(folder), read_dataset(folder)
    (folder / "002.png").unlink()
    photograph = data.read(0)
    assert np.array_equal(photograph.image, loaded.images[0])
    assert np.array_equal(photograph.mask, loaded.masks[0])
    for read in (lambda: data.read(1), data.load):
        with pytest.raises(ValueError, match=r"002\.png: cannot be read"):
            read()


@pytest.mark.parametrize(
    "name, content, words",
    [
        (
            "light_directions.txt",
            "0 0 1\n",
            ["light_directions.txt: expected 2 lines ... got 1"],
        ),
        ("light_directions.txt", "0 0 1\n0 0 0\n", ["light_directions.txt: light 2"]),
        ("light_directions.txt", "0 0 1\n0 0\n", ["light_directions.txt: line 2"]),
        ("light_intensities.txt", "1 1 1\n1 0 1\n", ["light_intensities.txt: light 2"]),
        ("filenames.txt", "001.png\n009.png\n", ["009.png: cannot be read"]),
        (
            "filenames.txt",
            "001.png\n../a.png\n",
            ["filenames.txt: expected ... got '../a.png'"],
        ),
        ("filenames.txt", "", ["expected 0 lines, one for each photograph"]),
        ("Normal_gt.mat", "junk", ["Normal_gt.mat: "]),
        ("Normal_gt.mat", None, ["Normal_gt.mat: expected ... --normals fit"]),
        ("mask.png", None, ["mask.png: cannot be read"]),
        ("002.png", "junk", ["002.png: is broken"]),
    ],
)
def test_wrong_diligent(diligent, name, content, words):
    if content is None:
        (diligent / name).unlink()
    else:
        (diligent / name).write_text(content)
    _check_error(diligent, *words)


def test_diligent_of_unequal_sizes(diligent):
    small = imagecodecs.png_encode(np.zeros((3, 3, 3), np.uint16))
    (diligent / "002.png").write_bytes(small)
    _check_error(diligent, "002.png: expected (2, 3) pixels ... got (3, 3)")
    normals = np.ones((3, 3, 3))
    scipy.io.savemat(diligent / "Normal_gt.mat", {"Normal_gt": normals})
    _check_error(diligent, "Normal_gt.mat: Normal_gt: expected ... got (3, 3, 3)")
    scipy.io.savemat(diligent / "Normal_gt.mat", {"normals": normals})
    _check_error(diligent, "Normal_gt.mat: Normal_gt: expected ... got none")
    # Where the type of the numbers stood; SciPy's reader would end the process.
    file = io.BytesIO()
    scipy.io.savemat(file, {"Normal_gt": np.ones((2, 3, 3))})
    data = file.getvalue()
    (diligent / "Normal_gt.mat").write_bytes(data[:193] + data[197:])
    _check_error(diligent, "Normal_gt.mat: ")


def test_real_photographs():
    folder = photographs("diligent_ball")
    read = read_dataset(folder)
    assert len(read.images) == 96 and read.images[0].shape == (150, 150, 3)
    # 001.png has 22 saturated samples, and the mask 15791 pixels.
    assert read.masks[0].sum() == 3 * 15791 - 22
    raw = imagecodecs.png_decode((folder / "001.png").read_bytes())
    np.testing.assert_allclose(
        read.images[0][75, 75],
        raw[75, 75] / 65535 / np.array([1.2909, 1.5776, 2.1336]),
        rtol=1e-6,
    )
