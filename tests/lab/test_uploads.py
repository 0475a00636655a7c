"""Files from the page: whole ones, broken ones, and those that are no such file."""

import struct

import imagecodecs
import numpy as np
import pytest

from phongfit.lab import uploads
from phongfit.lab.uploads import read_mesh, read_photograph, read_photograph_mask
from tests.helpers import said

TRIANGLE = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def _png(*shape: int) -> bytes:
    levels = np.arange(np.prod(shape)).reshape(shape) * 7 % 251
    return bytes(imagecodecs.png_encode(levels.astype(np.uint8)))


@pytest.mark.parametrize(
    "name, content, words",
    [
        ("a.obj", b"v 1 2\nf 1 2 3\n", "a.obj: line 1: v: expected 3 finite numbers"),
        ("a.obj", b"", "a.obj: "),
        ("a.obj", b"\xff\xfe\0", "a.obj: it holds no triangles"),
        ("a.stl", b"solid", "a.stl: "),
        ("a.ply", b"ply\nformat", "a.ply: cannot be read"),
        ("a.glb", b"glTF", "a.glb: does not start as a GLB file"),
        ("a.blend", TRIANGLE, "a.blend: its suffix is none of"),
        ("", TRIANGLE, "its suffix is none of"),
        ("../../a.obj", b"f 1 2 3", "a.obj: "),
        ("a\n\0.obj" + "b" * 300, TRIANGLE, "its suffix is none of"),
    ],
)
def test_meshes_that_cannot_be_read(name, content, words):
    with pytest.raises(ValueError) as caught:
        read_mesh(name, content)
    told = str(caught.value)
    assert said(words, told) and "\n" not in told and "/tmp" not in told, told


@pytest.mark.parametrize("library", [b"a.mtl", b"../a.mtl", b"/etc/a.mtl"])
def test_a_mesh_without_its_materials(library):
    content = b"mtllib " + library + b"\nusemtl red\n" + TRIANGLE
    mesh = read_mesh("a.OBJ", content)
    assert mesh.faces.shape == (1, 3) and mesh.materials == 1


def test_too_many_faces(monkeypatch):
    monkeypatch.setattr(uploads, "MAX_FACES", 0)
    with pytest.raises(ValueError, match="a.obj: expected at most 0, got 1 faces"):
        read_mesh("a.obj", TRIANGLE)


@pytest.mark.parametrize(
    "name, content, words",
    [
        ("a.png", _png(4, 4, 3)[:-20], "a.png: is broken or no .png image"),
        ("a.png", b"", "a.png: "),
        ("a.jpg", b"\xff\xd8\xff", "a.jpg: is broken"),
        ("a.gif", b"GIF89a", "a.gif: expected ... got suffix '.gif'"),
    ],
)
def test_photographs_that_cannot_be_read(name, content, words):
    with pytest.raises(ValueError) as caught:
        read_photograph(name, content, "srgb")
    told = str(caught.value)
    assert said(words, told) and "\n" not in told and "/tmp" not in told, told


@pytest.mark.parametrize("side", [4097, 2**20])
def test_a_small_file_that_would_fill_the_memory(side):
    """Its head alone tells: nothing is decoded."""
    size = struct.pack(">II", side, 4096)
    content = _png(4, 4, 3)
    content = content[:16] + size + content[24:]
    words = f"16777216 pixels .max_pixels., got {side} × 4096; a smaller"
    with pytest.raises(ValueError, match=words):
        read_photograph("a.png", content, "srgb")
    with pytest.raises(ValueError, match=words):
        read_photograph_mask("a.png", content, 1, (4, 4))


def test_a_large_photograph_is_shrunk(monkeypatch):
    monkeypatch.setattr(uploads, "MAX_SIDE", 10)
    image, times, clamps = read_photograph("a.png", _png(25, 15, 3), "linear")
    assert clamps and times == 3 and image.shape == (8, 5, 3)
    whole, once = uploads._read("a.png", _png(25, 15, 3), _linear), 3
    np.testing.assert_allclose(image[1, 2], whole[3:6, 6:9].mean(axis=(0, 1)), 1e-6)
    mask = np.zeros((25, 15), np.uint8)
    mask[3:9, :7] = 255
    content = bytes(imagecodecs.png_encode(mask))
    shrunk = read_photograph_mask("m.png", content, once, (8, 5))
    # A block counts where all of it is inside.
    assert shrunk.sum() == 2 * 2 and shrunk[1:3, :2].all()
    with pytest.raises(
        ValueError, match=r"m.png: expected \(24, 18\) pixels, got \(25, 15\)"
    ):
        read_photograph_mask("m.png", content, once, (8, 6))


def _linear(path):
    from phongfit.files.images import read_image

    return read_image(path, "linear")
