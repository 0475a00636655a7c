"""Photographs: upright, with their film, and in common light."""

import struct
from fractions import Fraction
from pathlib import Path

import imagecodecs
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image, ImageCms
from PIL.TiffImagePlugin import IFDRational

import phongfit as pf
from phongfit.files.images import read_film, read_head, read_image, read_mask
from phongfit.files.metadata import TURNS, Exposure, Metadata
from phongfit.files.photographs import (
    list_photographs,
    open_photographs,
    read_photograph,
    relative_exposures,
)
from phongfit.rendering.film import decode
from tests.helpers import png_chunk

# What Pillow calls the way from a file's pixels to upright ones.
UPRIGHT = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
# Numbers of EXIF's tags, as Pillow takes them.
ORIENTATION, EXIF, TIME, F_NUMBER, ISO = 274, 0x8769, 33434, 33437, 34855
# Whole numbers: focal length on film, image's width and height, unit of the density.
COUNTS = {"equivalent": 41989, "width": 40962, "height": 40963, "unit": 41488}
RATIOS = {"focal": 37386, "density": 41486}


def exif(orientation: int = 1, **exposure: float) -> bytes:
    data = Image.Exif()
    data[ORIENTATION] = orientation
    tags = {"time": TIME, "f_number": F_NUMBER, "iso": ISO} | COUNTS | RATIOS
    ratios = {k: IFDRational(Fraction(v).limit_denominator(8000)) for k, v in
              exposure.items() if k not in ("iso", *COUNTS)}  # fmt: skip
    data[EXIF] = {tags[k]: ratios.get(k, v) for k, v in exposure.items()}
    return data.tobytes()


def levels(height: int = 16, width: int = 32) -> np.ndarray:
    """No two corners alike, and smooth, since a JPEG is."""
    y, x = np.mgrid[:height, :width]
    smooth = np.stack([4 * x + y, 60 + 5 * y, 100 + 2 * x + y], axis=-1)
    return smooth.astype(np.uint8)


def write_png(path: Path, numbers: np.ndarray, **chunks: bytes) -> None:
    """A PNG with chunks of one's own after its head."""
    data = bytes(imagecodecs.png_encode(numbers))
    own = b"".join(png_chunk(kind.encode(), body) for kind, body in chunks.items())
    path.write_bytes(data[:33] + own + data[33:])


@pytest.mark.parametrize("orientation", sorted(TURNS))
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
def test_every_orientation(tmp_path, orientation, suffix):
    path = tmp_path / f"a{suffix}"
    flat = Image.fromarray(levels())
    if suffix == ".tif":
        flat.save(path, tiffinfo={ORIENTATION: orientation})
    else:
        flat.save(path, exif=exif(orientation))
    pixels = Image.fromarray(levels())
    if suffix == ".jpg":
        pixels = Image.fromarray(imagecodecs.jpeg_decode(path.read_bytes()))
    turn = UPRIGHT.get(orientation)
    expected = np.asarray(pixels if turn is None else pixels.transpose(turn))
    shown = np.round(read_image(path, "linear") * 255)
    np.testing.assert_array_equal(shown, expected)
    assert np.array_equal(read_mask(path), expected.max(axis=-1) > expected.max() / 2)
    assert read_head(path).size == expected.shape[1::-1]


@pytest.mark.parametrize("orientation", sorted(TURNS))
@pytest.mark.parametrize("sampling", [0, 1, 2])
def test_the_film_of_a_turned_jpeg(tmp_path, orientation, sampling):
    """It loses of the upright image what the file lost of the one that lies in it."""
    path, pixels = tmp_path / "a.jpg", levels(32, 48)
    options = {"quality": 40, "subsampling": sampling}
    Image.fromarray(pixels).save(path, **options)
    lying = read_film(path, "srgb")
    Image.fromarray(pixels).save(path, exif=exif(orientation), **options)
    film, upright = read_film(path, "srgb"), Metadata(orientation).upright
    light = decode(pixels / 255, "srgb")
    shown = np.asarray(film.expose(jnp.asarray(upright(light)))) * 255
    expected = np.asarray(lying.expose(jnp.asarray(light))) * 255
    off = np.abs(shown - upright(expected))
    # But for what lies in the middle of two levels.
    assert np.mean(off > 0.5) < 0.02
    assert np.abs(expected - pixels).mean() > 1


def test_blocks_that_begin_outside_of_a_turned_jpeg(tmp_path):
    path = tmp_path / "a.jpg"
    Image.fromarray(levels(16, 30)).save(path, exif=exif(8))
    with pytest.warns(UserWarning, match=r"a\.jpg: its orientation .*jpegtran"):
        film = read_film(path, "srgb")
    assert film == pf.Film(encoding="srgb", bits=8)
    # Mirrored top to bottom all rows of blocks are whole.
    Image.fromarray(levels(16, 30)).save(path, exif=exif(4))
    assert read_film(path, "srgb").jpeg is not None


# 36 × 24 mm film behind 50 mm sees 26.99° from bottom to top, 39.6° on its side.
@pytest.mark.parametrize(
    ("lens", "orientation", "expected"),
    [
        ({"equivalent": 50}, 1, 26.991),
        ({"equivalent": 50}, 6, 39.598),
        ({"equivalent": 50, "width": 30, "height": 20}, 1, 26.991),
        ({"equivalent": 50, "width": 20, "height": 30}, 1, 26.991),
        # Cut out of a larger image.
        ({"equivalent": 50, "width": 60, "height": 40}, 1, None),
        # 30 pixels on 24 mm behind 28 mm, in inches and in centimetres.
        ({"focal": 28, "density": 30 / 24 * 25.4}, 1, 31.891),
        ({"focal": 28, "density": 12.5, "unit": 3}, 1, 31.891),
        ({"focal": 28}, 1, None),
        ({"equivalent": 0}, 1, None),
        ({}, 1, None),
    ],
)
def test_angle_of_view(tmp_path, lens, orientation, expected):
    path = tmp_path / "a.jpg"
    Image.fromarray(levels(20, 30)).save(path, exif=exif(orientation, **lens))
    found = open_photographs([path], "srgb").fov
    assert found == (None if expected is None else pytest.approx(expected, rel=1e-3))


def test_photographs_that_zoom_have_no_common_angle_of_view(tmp_path):
    paths = [tmp_path / "a.jpg", tmp_path / "b.jpg"]
    for path, focal in zip(paths, (50, 70), strict=True):
        Image.fromarray(levels()).save(path, exif=exif(equivalent=focal))
    assert open_photographs(paths, "srgb").fov is None


# What a colour space, and the rules of interoperability, say of red 200, green 60, blue
# 30: light of Adobe RGB (1998) in the primaries of sRGB, by its specification's matrix.
FROM_ADOBE = np.array([[1.39836, -0.39836, 0], [0, 1, 0], [0, -0.04293, 1.04293]])


@pytest.mark.parametrize(
    "space, rules, adobe",
    [(65535, "R03", True), (65535, "R98", False), (1, "R03", False), (2, None, True)],
)
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_adobe_rgb_by_exif_alone(tmp_path, space, rules, adobe, suffix):
    path, data = tmp_path / f"a{suffix}", Image.Exif()
    data[EXIF] = {40961: space} | ({40965: {1: rules}} if rules else {})
    flat = Image.new("RGB", (16, 16), (200, 60, 30))
    flat.save(path, exif=data.tobytes(), quality=100, subsampling=0)
    expected = decode(np.array([200, 60, 30]) / 255, "srgb")
    if adobe:
        expected = FROM_ADOBE @ (np.array([200, 60, 30]) / 255) ** 2.19921875
    image = read_image(path, "srgb")
    assert np.abs(image - expected).max() < 0.012
    # What an ICC profile says goes before it.
    flat.save(path, exif=data.tobytes(), icc_profile=SRGB, quality=100, subsampling=0)
    expected = decode(np.array([200, 60, 30]) / 255, "srgb")
    assert np.abs(read_image(path, "srgb") - expected).max() < 0.012
    if adobe:
        flat.save(path, exif=data.tobytes(), quality=100, subsampling=0)
        with pytest.raises(ValueError, match="expected encoding 'srgb', since its col"):
            read_image(path, "linear")


def test_broken_exif_is_said(tmp_path):
    path = tmp_path / "a.jpg"
    Image.fromarray(levels()).save(path, exif=b"Exif\0\0" + b"II*\0\xff\xff\0\0")
    with pytest.warns(UserWarning, match=r"a\.jpg: its EXIF data is broken .*upright"):
        image = read_image(path, "srgb")
    assert image.shape == (16, 32, 3)
    # No orientation, as some programs write it, is none.
    Image.fromarray(levels()).save(path, exif=exif(0))
    assert read_image(path, "srgb").shape == (16, 32, 3)


@pytest.mark.parametrize(
    "chunks, encoding, words",
    [
        ({"gAMA": struct.pack(">I", 100000)}, "srgb", "expected encoding 'linear'"),
        ({"gAMA": struct.pack(">I", 100000)}, "linear", None),
        # Written by many programs whatever the numbers are.
        ({"gAMA": struct.pack(">I", 45455)}, "linear", None),
        ({"sRGB": b"\0", "gAMA": struct.pack(">I", 100000)}, "srgb", None),
        ({"cICP": bytes([12, 13, 0, 1])}, "srgb", "cICP.*: convert it"),
        ({"cICP": bytes([1, 13, 0, 1])}, "srgb", None),
        (
            {"cHRM": struct.pack(">8I", 31270, 32900, 68000, 32000, 26500, 69000,
                                 15000, 6000)},
            "srgb", "cHRM.*: convert it",
        ),
        (
            {"cHRM": struct.pack(">8I", 31270, 32900, 64000, 33000, 30000, 60000,
                                 15000, 6000)},
            "srgb", None,
        ),
    ],
)  # fmt: skip
def test_what_a_png_says_of_its_colours(tmp_path, chunks, encoding, words):
    path = tmp_path / "a.png"
    write_png(path, levels(), **chunks)
    if words is None:
        bare = decode(levels() / 255, encoding)
        np.testing.assert_allclose(read_image(path, encoding), bare, atol=1e-6)
        return
    with pytest.raises(ValueError, match=rf"a\.png: expected .*{words}|{words}"):
        read_image(path, encoding)


def test_exposure_of_a_photograph(tmp_path):
    path = tmp_path / "a.jpg"
    stated = exif(6, time=1 / 60, f_number=8, iso=200)
    Image.fromarray(levels()).save(path, exif=stated)
    photo = read_photograph(path, "srgb")
    assert photo.exposure == pytest.approx(Exposure(1 / 60, 8, 200))
    assert str(photo.exposure) == "1/60 s, f/8, ISO 200"
    assert photo.image.shape == (32, 16, 3) and photo.usable.all()
    assert photo.film == read_film(path, "srgb")
    Image.fromarray(levels()).save(tmp_path / "a.tif", exif=stated)
    assert read_head(tmp_path / "a.tif").exposure == pytest.approx(photo.exposure)
    Image.fromarray(levels()).save(tmp_path / "a.png", exif=stated)
    assert read_head(tmp_path / "a.png").exposure == pytest.approx(photo.exposure)
    pf.write_image(tmp_path / "a.exr", photo.image, "linear")
    assert read_head(tmp_path / "a.exr") == ((16, 32), Exposure(), None, None, False)


def test_mixed_exposures_come_to_common_light(tmp_path):
    light = np.full((8, 8, 3), 0.2)
    light[0, 0] = 0.7
    settings = {"001.png": (1 / 60, 8, 100), "002.png": (1 / 30, 8, 100),
                "003.png": (1 / 60, 4, 50)}  # fmt: skip
    for name, (time, f_number, iso) in settings.items():
        exposed = light * time * iso / f_number**2 / (1 / 60 * 100 / 64)
        shown = np.round(np.clip(exposed, 0, 1) * 255).astype(np.uint8)
        Image.fromarray(shown).save(
            tmp_path / name, exif=exif(time=time, f_number=f_number, iso=iso)
        )
    series = open_photographs(list_photographs(tmp_path), "linear")
    np.testing.assert_allclose(series.relative_exposures, [1, 2, 2], rtol=1e-6)
    assert series.notes == (
        "001.png 1/60 s, f/8, ISO 100, 002.png 1/30 s, f/8, ISO 100, 003.png 1/60 s, "
        "f/4, ISO 50: brought to common light, to some 5 %, as cameras state rounded "
        "numbers",
    )
    for number in range(len(series)):
        photo = series.read(number)
        known = photo.unsaturated
        # Saturation is seen before light is scaled.
        assert known.all() == (number == 0) and known[1:].all()
        difference = np.abs(photo.common_light - light)[known]
        assert difference.max() <= 0.5 / 255 + 1e-6


def test_exposures_that_are_alike_or_not_stated():
    names = ["a", "b"]
    alike = Exposure(1 / 60, 8, 100)
    ratios, notes = relative_exposures(names, [alike, alike])
    assert ratios.tolist() == [1, 1] and notes == ()
    ratios, notes = relative_exposures(names, [Exposure(), Exposure()])
    assert ratios.tolist() == [1, 1]
    (note,) = notes
    assert note.startswith("no exposure times are stated: taken to be the same in all")
    assert note.endswith("where they differ, lamps' strengths contain them")
    _, notes = relative_exposures(names, [alike, alike._replace(time=None)])
    assert notes[0].startswith("b does not state an exposure time: taken as")
    with pytest.raises(ValueError, match=r"c: expected an exposure time.*; a states"):
        other = Exposure(1 / 30, 8, 100)
        relative_exposures([*names, "c"], [alike, other, Exposure(None, 8, 100)])
    _, notes = relative_exposures(
        [str(k) for k in range(9)], [Exposure(1 + k) for k in range(9)]
    )
    assert notes == (
        "0 1 s, 1 2 s, 2 3 s, 3 4 s, 4 5 s, 5 6 s and 3 more: brought to common light, "
        "to some 5 %, as cameras state rounded numbers",
    )


def test_photographs_of_unequal_size(tmp_path):
    Image.fromarray(levels()).save(tmp_path / "a.png")
    Image.fromarray(levels()).save(tmp_path / "b.jpg", exif=exif(6))
    words = r"b\.jpg: expected 32 × 16 pixels, as a\.png has, got 16 × 32 pixels"
    with pytest.raises(ValueError, match=words):
        open_photographs(list_photographs(tmp_path), "srgb")


def test_what_is_a_photograph_in_a_folder(tmp_path):
    for name in ("b.png", "A.JPG", "mask.png", "b.mask.png", ".c.png", "lights.lp"):
        (tmp_path / name).write_bytes(b"")
    assert [p.name for p in list_photographs(tmp_path)] == ["A.JPG", "b.png"]
    (tmp_path / "b.png").unlink()
    with pytest.raises(
        ValueError, match=r"expected at least 2 photographs, got A\.JPG"
    ):
        list_photographs(tmp_path)
    with pytest.raises(ValueError, match="there is no such file or folder"):
        list_photographs(tmp_path / "none")
    with pytest.raises(ValueError, match="paths: expected at least one"):
        open_photographs([], "srgb")
