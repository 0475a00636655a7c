"""Images: every bit in, every bit out, and one clear line for what is broken."""

import io
import os
import struct
from concurrent.futures import ThreadPoolExecutor

import imagecodecs
import imageio.v3 as iio
import jax.numpy as jnp
import numpy as np
import OpenEXR
import pytest
from PIL import Image

from phongfit import Film
from phongfit.files.coded import Coded
from phongfit.files.images import (
    from_levels,
    level_table,
    read_film,
    read_image,
    read_mask,
    to_levels,
    write_image,
)
from phongfit.files.photographs import read_photograph
from phongfit.rendering import JpegCompression
from tests.helpers import png_promising, said

FORMATS = [
    (".png", 8, 0.5 / 255),
    (".png", 16, 0.5 / 65535),
    (".tif", 8, 0.5 / 255),
    (".tiff", 16, 0.5 / 65535),
    (".tif", 32, 0),
    (".exr", 32, 0),
    (".hdr", 32, 2**-8),
    # Last, since it alone loses a little each time.
    (".jpg", 8, 0.03),
]


@pytest.fixture
def picture():
    # Smooth, since a JPEG is.
    y, x = np.mgrid[0:24, 0:32] / 32
    return np.stack([x, y, (x + y) / 2], axis=-1).astype(jnp.result_type(float))


@pytest.mark.parametrize("suffix, bits, error", FORMATS)
def test_round_trip(tmp_path, picture, suffix, bits, error):
    path = tmp_path / f"a{suffix}"
    write_image(path, picture, "linear", bits)
    back = read_image(path, "linear")
    assert back.shape == picture.shape and back.dtype == picture.dtype
    np.testing.assert_allclose(back, picture, rtol=0, atol=error + 1e-7)


@pytest.mark.parametrize("suffix, bits", [row[:2] for row in FORMATS[:-1]])
def test_written_again_it_is_the_same(tmp_path, picture, suffix, bits):
    first, second = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
    encoding = "linear" if bits == 32 else "srgb"
    write_image(first, picture, encoding, bits)
    write_image(second, read_image(first, encoding), encoding, bits)
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize("encoding", ["linear", "srgb"])
@pytest.mark.parametrize("dtype, bits", [(np.uint8, 8), (np.uint16, 16)])
def test_every_level_survives(encoding, dtype, bits):
    levels = np.arange(2**bits).astype(dtype)
    light = from_levels(levels, encoding)
    assert np.array_equal(to_levels(light, encoding, bits), levels)


def test_light_that_is_looked_up_later():
    """One table for all images, or one for each; what is masked stays so."""
    rng = np.random.default_rng(0)
    numbers = rng.integers(0, 256, (2, 5, 7, 3), np.uint8)
    one = level_table(np.uint8, "srgb")
    light = Coded(numbers, one).light
    assert np.array_equal(light, from_levels(numbers, "srgb"))
    assert np.array_equal(Coded(light).light, light)
    half = Coded(numbers[1], one).times(0.5)
    assert np.array_equal(half.light, light[1] * light.dtype.type(0.5))
    assert np.array_equal(Coded(light[1]).times(0.5).light, half.light)
    hidden = rng.random(numbers.shape) < 0.5
    assert half.table is not None
    both = Coded(np.ma.MaskedArray(numbers, hidden), np.stack([one, half.table])).light
    assert np.array_equal(np.ma.getmaskarray(both), hidden)
    expected = np.where(hidden, 0, np.stack([light[0], half.light]))
    assert np.array_equal(np.ma.getdata(both), expected)


def test_film_and_file_agree(picture):
    exposed = np.asarray(Film(encoding="srgb", bits=8).expose(jnp.asarray(picture)))
    np.testing.assert_array_equal(
        np.round(exposed * 255), to_levels(picture, "srgb", 8)
    )


def test_srgb_by_hand(tmp_path):
    # IEC 61966-2-1: code 188 is (188/255 → 0.50289) linear; 10 is on the straight part.
    path = tmp_path / "a.png"
    path.write_bytes(imagecodecs.png_encode(np.array([[188, 10]], np.uint8)))
    light = read_image(path, "srgb")
    np.testing.assert_allclose(light[0, 0], [0.50289] * 3, atol=1e-5)
    np.testing.assert_allclose(light[0, 1], [10 / 255 / 12.92] * 3, rtol=1e-6)


def test_all_16_bits_of_a_png(tmp_path):
    # Neighbours that differ in the lowest bit only: 8 bits would make them equal.
    levels = np.array([[[256, 257, 258], [65533, 65534, 65535]]], np.uint16)
    path = tmp_path / "a.png"
    path.write_bytes(imagecodecs.png_encode(levels))
    light = read_image(path, "linear")
    assert np.array_equal(np.round(light.astype(float) * 65535), levels)


@pytest.mark.parametrize("suffix, write", [(".png", "png"), (".tif", "tiff")])
def test_white_below_the_largest_number(tmp_path, suffix, write):
    """12 bits in 16: 4095 is white, and so is what lies above it."""
    path = tmp_path / f"a{suffix}"
    levels = np.array([[0, 1, 2048, 4094, 4095, 5000]], np.uint16)
    path.write_bytes(getattr(imagecodecs, f"{write}_encode")(levels))
    light = read_image(path, "linear", white=4095)
    expected = np.minimum(levels / 4095, 1)
    np.testing.assert_allclose(light[..., 0], expected, atol=0.5 / 65535)
    assert (light[0, 3] < 1).all() and (light[0, 4:] == 1).all()
    photo = read_photograph(path, "srgb", white=4095)
    assert photo.unsaturated[0, :, 0].tolist() == [True] * 4 + [False] * 2
    assert photo.film == read_film(path, "srgb", white=4095) == Film(True, "srgb", 12)
    np.testing.assert_allclose(photo.image[0, 2, 0], 0.2140, atol=2e-4)
    with pytest.raises(ValueError, match=f"a{suffix}: white: expected 1 … 65535"):
        read_image(path, "linear", white=0)
    write_image(tmp_path / "a.exr", light, "linear")
    write_image(tmp_path / "a.jpg", light, "linear")
    for name in ("a.exr", "a.jpg"):
        with pytest.raises(ValueError, match=f"{name}: white: expected it of a PNG"):
            read_image(tmp_path / name, "linear", white=4095)


def test_other_bit_depths_and_greys_of_a_png(tmp_path):
    grey = tmp_path / "grey.png"
    grey.write_bytes(imagecodecs.png_encode(np.array([[0, 1000, 65535]], np.uint16)))
    assert np.array_equal(
        read_image(grey, "linear")[0] * 65535, [[0] * 3, [1000] * 3, [65535] * 3]
    )


def _write_exr(path, channels, **header):
    kind = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(kind | header, channels) as file:
        file.write(str(path))


@pytest.mark.parametrize("name", ["a.png", "wide.png", "a.tif", "a.exr", "grey.png"])
def test_alpha_is_a_mask(tmp_path, name):
    """Pixels that are transparent, if only by a level, are left out."""
    path = tmp_path / name
    kind = {"wide.png": np.uint16, "a.exr": np.float32}.get(name, np.uint8)
    highest = 1 if kind == np.float32 else np.iinfo(kind).max
    numbers = np.full((2, 3, 2 if name == "grey.png" else 4), highest, kind)
    numbers[1, :, -1] = 0, highest // 2, highest - highest / 255

    def write(numbers):
        if name == "a.exr":
            numbers = np.where(numbers[..., 3:] == 0, np.nan, numbers)
            _write_exr(path, {"RGBA": numbers.astype(kind)})
        else:
            encode = getattr(
                imagecodecs, f"{path.suffix[1:].replace('f', 'ff')}_encode"
            )
            path.write_bytes(encode(numbers))

    write(numbers)
    photo = read_photograph(path, "linear")
    expected = np.array([[True] * 3, [False] * 3])
    assert np.array_equal(photo.usable, expected)
    assert np.array_equal(photo.image, np.repeat(expected[..., None], 3, axis=-1))
    for read in (lambda: read_image(path, "linear"), lambda: read_mask(path)):
        with pytest.raises(ValueError, match=rf"{name}: expected an opaque image"):
            read()
    numbers[..., -1] = highest
    write(numbers)
    assert read_image(path, "linear").shape == (2, 3, 3)
    assert read_photograph(path, "linear").usable.all()


def test_a_fourth_channel_of_a_tiff_that_is_no_alpha(tmp_path):
    """Infrared, say: 0 in ExtraSamples, which stands for any other thing."""
    path, numbers = tmp_path / "a.tif", np.full((2, 2, 4), 255, np.uint8)
    for infrared, words in ((7, None), (0, "alpha as its channel 4, got one of an un")):
        numbers[0, 0, 3] = infrared
        numbers[0, 1:, 3] = numbers[1:, :, 3] = 7
        data = bytes(imagecodecs.tiff_encode(numbers, photometric="rgb"))
        alpha = struct.pack("<HHII", 338, 3, 1, 2)
        assert data.count(alpha) == 1
        path.write_bytes(data.replace(alpha, struct.pack("<HHII", 338, 3, 1, 0)))
        if words is None:
            assert read_image(path, "linear").shape == (2, 2, 3)
            continue
        with pytest.raises(ValueError, match=rf"a\.tif: expected {words}"):
            read_image(path, "linear")


def test_a_tiff_of_several_pictures(tmp_path):
    path, page = tmp_path / "a.tif", Image.fromarray(np.zeros((8, 8), np.uint8))
    page.save(path, save_all=True, append_images=[page, page])
    words = r"a\.tif: expected one picture, got several .*save each as a file"
    with pytest.raises(ValueError, match=words):
        read_image(path, "linear")
    # A smaller copy after it is none; before it there is one in RAW photographs.
    (small := page.copy()).encoderinfo = {"tiffinfo": {254: 1}}
    page.save(path, save_all=True, append_images=[small])
    assert read_image(path, "linear").shape == (8, 8, 3)
    page.save(path, tiffinfo={254: 1})
    with pytest.raises(ValueError, match="expected a whole picture first, got a small"):
        read_image(path, "linear")
    # A list that refers to itself.
    tags = _tiff((254, 0), (256, 4), (257, 4), (262, 1))
    path.write_bytes(tags[: 8 + 2 + 4 * 12] + struct.pack("<I", 8))
    with pytest.raises(ValueError, match=words):
        read_image(path, "linear")


def test_tiff_with_a_plane_for_each_channel(tmp_path):
    path = tmp_path / "a.tif"
    planes = np.arange(18, dtype=np.uint8).reshape(3, 2, 3)
    path.write_bytes(
        imagecodecs.tiff_encode(planes, photometric="rgb", planarconfig="separate")
    )
    expected = np.moveaxis(planes, 0, -1)
    assert np.array_equal(np.round(read_image(path, "linear") * 255), expected)


def test_exr_with_separate_and_half_channels(tmp_path):
    path = tmp_path / "a.exr"
    numbers = (np.arange(18, dtype=np.float16) / 16).reshape(2, 3, 3)
    channels = {c: np.ascontiguousarray(numbers[..., i]) for i, c in enumerate("RGB")}
    _write_exr(path, channels)
    assert np.array_equal(read_image(path, "linear"), numbers)
    _write_exr(path, {"Z": channels["R"]})
    with pytest.raises(ValueError, match=r"a\.exr: expected.*got Z"):
        read_image(path, "linear")


# x and y of red, green, blue and white, and the red one in Rec. 709: SMPTE EG 432-1 and
# S-2008-001, with white taken to white by Bradford's method.
PRIMARIES = {
    "P3": ((0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.329),
           [1.2249, -0.0420, -0.0197]),
    "ACES": ((0.7347, 0.2653, 0, 1, 0.0001, -0.077, 0.32168, 0.33767),
             [2.5219, -0.2765, -0.0154]),
}  # fmt: skip


@pytest.mark.parametrize("name", PRIMARIES)
@pytest.mark.parametrize("suffix, kind", [
    (".exr", np.float16), (".exr", np.float32), (".hdr", np.float32),
])  # fmt: skip
def test_primaries_of_floats(tmp_path, name, suffix, kind):
    path, (points, red) = tmp_path / f"a{suffix}", PRIMARIES[name]
    points = tuple(map(float, points))
    numbers = np.array([[[1, 0, 0], [0.5, 0.5, 0.5]]], kind)
    if suffix == ".exr":
        _write_exr(path, {"RGB": numbers}, chromaticities=points)
    else:
        data = bytes(imagecodecs.rgbe_encode(numbers, header=True))
        line = f"PRIMARIES= {' '.join(map(str, points))}\nFORMAT".encode()
        path.write_bytes(data.replace(b"FORMAT", line))
    expected = [[red, [0.5] * 3]]
    np.testing.assert_allclose(read_image(path, "linear"), expected, atol=2e-3)
    assert read_film(path, "linear") == Film(clamp=False)


def test_exr_in_xyz(tmp_path):
    """Light of sRGB by IEC 61966-2-1's matrix: XYZ itself has no white."""
    light = np.array([[[0.8, 0.2, 0.1], [1, 1, 1], [0, 0, 2]]])
    matrix = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722],
              [0.0193, 0.1192, 0.9505]]  # fmt: skip
    points = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3)
    xyz = (light @ np.transpose(matrix)).astype(np.float32)
    for pixels in (xyz, np.dstack([xyz, np.ones((1, 3, 1), np.float32)])):
        channels = {"RGBA"[: pixels.shape[-1]]: pixels}
        _write_exr(tmp_path / "a.exr", channels, chromaticities=points)
        read = read_image(tmp_path / "a.exr", "linear")
        np.testing.assert_allclose(read, light, atol=1e-3)


def test_primaries_that_no_colours_have(tmp_path, picture):
    write_image(tmp_path / "a.hdr", picture, "linear")
    data = (tmp_path / "a.hdr").read_bytes()
    for numbers in ("0 0 0 0 0 0 0 0", "nan 0 0 1 0 0 1 1", ".6 .3 .3 .6 .1 .1 1 0"):
        line = f"PRIMARIES={numbers}\nFORMAT".encode()
        (tmp_path / "a.hdr").write_bytes(data.replace(b"FORMAT", line))
        with pytest.raises(ValueError, match=r"a\.hdr: expected primaries and white"):
            read_image(tmp_path / "a.hdr", "linear")


def test_exposure_of_a_radiance_picture(tmp_path, picture):
    path = tmp_path / "a.hdr"
    write_image(path, picture, "linear", 32)
    light = read_image(path, "linear")
    data = path.read_bytes()
    path.write_bytes(data.replace(b"FORMAT", b"EXPOSURE=2.0\nEXPOSURE=4\nFORMAT"))
    np.testing.assert_allclose(read_image(path, "linear"), light / 8, rtol=1e-6)
    corrected = b"COLORCORR=2 1 .5\nCOLORCORR= 1 1 4\nFORMAT"
    path.write_bytes(data.replace(b"FORMAT", corrected))
    expected = light / np.array([2, 1, 2], light.dtype)
    np.testing.assert_allclose(read_image(path, "linear"), expected, rtol=1e-6)
    path.write_bytes(data.replace(b"FORMAT", b"COLORCORR=2 1\nFORMAT"))
    with pytest.raises(ValueError, match=r"a\.hdr: .*COLORCORR: expected 3 numbers"):
        read_image(path, "linear")
    path.write_bytes(data.replace(b"rle_rgbe", b"rle_xyze"))
    with pytest.raises(ValueError, match="expected red, green and blue, got XYZ: conv"):
        read_image(path, "linear")


def test_integers_are_clamped_and_floats_are_not(tmp_path):
    light = np.array([[[-1, 0.5, 7]]])
    write_image(tmp_path / "a.png", light, "linear", 8)
    assert np.array_equal(
        read_image(tmp_path / "a.png", "linear")[0, 0] * 255, [0, 128, 255]
    )
    write_image(tmp_path / "a.exr", light, "linear")
    assert np.array_equal(read_image(tmp_path / "a.exr", "linear"), light)


def test_mask_of_0_and_1_or_0_and_255(tmp_path):
    path = tmp_path / "mask.png"
    for white in (1, 255):
        path.write_bytes(
            imagecodecs.png_encode(np.array([[0, white, white]], np.uint8))
        )
        assert np.array_equal(read_mask(path), [[False, True, True]])
    path.write_bytes(imagecodecs.png_encode(np.zeros((1, 3), np.uint8)))
    assert not read_mask(path).any()


HUGE_HDR = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 99999 +X 99999\n"
HUGE_TIFF = b"II*\0" + struct.pack(
    "<IHHHIIHHIII", 8, 2, 256, 4, 1, 99999, 257, 4, 1, 99999, 0
)

BROKEN = {
    "empty.png": (b"", "does not start as a PNG"),
    "text.png": (b"hello", "does not start as a PNG"),
    "text.jpg": (b"hello", "is broken or no .jpg image"),
    "text.tif": (b"hello", "does not start as a TIFF"),
    "text.hdr": (b"hello", "does not start as a Radiance"),
    "text.exr": (b"hello", "is broken or no .exr image"),
    "text.gif": (b"GIF89a", "expected one of .png ... got suffix '.gif'"),
    "nothing": (b"", "expected one of .png ... got no suffix"),
    "bomb.png": (png_promising(60000, 60000), "got 60000 × 60000 pixels"),
    "bomb.hdr": (HUGE_HDR, "got 99999 × 99999 pixels"),
    "bomb.tif": (HUGE_TIFF, "got 99999 × 99999 pixels"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_files(tmp_path, name, capfd):
    data, message = BROKEN[name]
    path = tmp_path / name
    path.write_bytes(data)
    _check_one_line(path, message, capfd)


@pytest.mark.parametrize("suffix, bits, error", FORMATS)
@pytest.mark.parametrize("share", [0.02, 0.5, 0.9])
def test_truncated_files(tmp_path, picture, suffix, bits, error, share, capfd):
    path = tmp_path / f"a{suffix}"
    noisy = picture + np.random.default_rng(0).uniform(0, 0.1, picture.shape)
    write_image(path, noisy, "linear", bits)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    _check_one_line(path, "is broken", capfd)


@pytest.mark.parametrize("suffix, bits, error", FORMATS)
def test_more_pixels_than_are_allowed(tmp_path, picture, suffix, bits, error):
    path = tmp_path / f"a{suffix}"
    write_image(path, picture, "linear", bits)
    assert read_image(path, "linear", max_pixels=24 * 32).shape == (24, 32, 3)
    words = "expected at most 767 pixels .max_pixels., got 32 × 24"
    with pytest.raises(ValueError, match=words):
        read_image(path, "linear", max_pixels=24 * 32 - 1)
    with pytest.raises(ValueError, match=words):
        read_mask(path, max_pixels=24 * 32 - 1)


def test_a_jpeg_with_another_before_and_bytes_after_it(tmp_path, picture, capfd):
    """A thumbnail has an end of its own; phones add films after the picture's."""
    path, small = tmp_path / "a.jpg", io.BytesIO()
    Image.new("RGB", (16, 16)).save(small, "JPEG")
    pixels = Image.fromarray((picture * 255).astype(np.uint8))
    thumbnail = b"Exif\0\0II*\0\x08\0\0\0\0\0" + small.getvalue()
    for progressive in (False, True):
        pixels.save(path, quality=95, exif=thumbnail, progressive=progressive)
        whole, light = path.read_bytes(), read_image(path, "linear")
        path.write_bytes(whole + b"\xff\xda film \xff\xd8")
        assert np.array_equal(read_image(path, "linear"), light)
        path.write_bytes(whole[:-2])
        _check_one_line(path, "is broken or no .jpg image: it is truncated", capfd)


def test_png_without_its_end(tmp_path, picture, capfd):
    path = tmp_path / "a.png"
    write_image(path, picture, "linear")
    path.write_bytes(path.read_bytes()[:-6])
    _check_one_line(path, "is truncated", capfd)


def _check_one_line(path, message, capfd) -> None:
    with pytest.raises(ValueError) as caught:
        read_image(path, "linear")
    text = str(caught.value)
    assert text.startswith(str(path)) and said(message, text) and "\n" not in text
    assert " at 0x" not in text
    # Libraries must not talk to the user past us.
    assert capfd.readouterr() == ("", "")


def test_missing_file_folder_and_device(tmp_path):
    with pytest.raises(ValueError, match=r"a\.png: cannot be read: No such file"):
        read_image(tmp_path / "a.png", "linear")
    (tmp_path / "b.png").mkdir()
    with pytest.raises(ValueError, match=r"b\.png: is not a file"):
        read_image(tmp_path / "b.png", "linear")
    (tmp_path / "c.png").symlink_to("/dev/zero")
    with pytest.raises(ValueError, match=r"c\.png: is not a file"):
        read_image(tmp_path / "c.png", "linear")


def test_cmyk_and_inverted_grey_are_refused(tmp_path):
    grey = np.zeros((4, 4), np.uint8)
    path = tmp_path / "a.tif"
    path.write_bytes(imagecodecs.tiff_encode(grey, photometric="miniswhite"))
    with pytest.raises(
        ValueError, match=r"a\.tif: expected photometric interpretation 1 or 2, got 0"
    ):
        read_image(path, "linear")
    path = tmp_path / "a.jpg"
    iio.imwrite(path, np.zeros((8, 8, 4), np.uint8), plugin="pillow", mode="CMYK")
    with pytest.raises(ValueError, match=r"a\.jpg: expected.*got CMYK"):
        read_image(path, "linear")


def test_nan_pixels(tmp_path):
    path = tmp_path / "a.exr"
    light = np.full((2, 2, 3), np.nan, np.float32)
    _write_exr(path, {"RGB": light})
    with pytest.raises(ValueError, match=r"a\.exr: has NaN or infinite pixels"):
        read_image(path, "linear")


def test_encoding_is_never_guessed(tmp_path, picture):
    with pytest.raises(TypeError, match="encoding"):
        read_image(tmp_path / "a.png")  # pyright: ignore
    with pytest.raises(ValueError, match="encoding: expected .*, got 'gamma'"):
        read_image(tmp_path / "a.png", "gamma")  # pyright: ignore
    write_image(tmp_path / "a.exr", picture, "linear")
    with pytest.raises(ValueError, match="as floating-point images have, got 'srgb'"):
        read_image(tmp_path / "a.exr", "srgb")


@pytest.mark.parametrize(
    "name, image, encoding, bits, message",
    [
        (
            "a.png",
            np.zeros((2, 3, 4)),
            "linear",
            8,
            r"expected an image.*got shape \(2, 3, 4\)",
        ),
        (
            "a.png",
            np.zeros((0, 3, 3)),
            "linear",
            8,
            r"expected an image.*got shape \(0, 3, 3\)",
        ),
        ("a.png", np.full((2, 3, 3), np.nan), "linear", 8, "NaN"),
        ("a.png", np.full((2, 3, 3), np.inf), "linear", 8, "infinite"),
        (
            "a.png",
            np.zeros((2, 3, 3)),
            "linear",
            32,
            "bits: expected 8 or 16.*got 32",
        ),
        ("a.jpg", np.zeros((2, 3, 3)), "linear", 16, "bits: expected 8.*got 16"),
        ("a.exr", np.zeros((2, 3, 3)), "srgb", 32, "expected encoding 'linear', as"),
        ("a.bmp", np.zeros((2, 3, 3)), "linear", 8, "expected.*got suffix '.bmp'"),
        (
            "a.png",
            np.zeros((2, 3, 3)),
            "gamma",
            8,
            "encoding: expected .*, got 'gamma'",
        ),
    ],
)
def test_what_cannot_be_written(tmp_path, name, image, encoding, bits, message):
    with pytest.raises(ValueError, match=message):
        write_image(tmp_path / name, image, encoding, bits)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("sampling, name", [(0, "4:4:4"), (1, "4:2:2"), (2, "4:2:0")])
def test_a_jpeg_says_what_it_rounds(tmp_path, picture, sampling, name):
    levels = to_levels(picture, "srgb", 8)
    iio.imwrite(tmp_path / "a.jpg", levels, quality=80, subsampling=sampling)
    film = read_film(tmp_path / "a.jpg", "srgb")
    assert film == Film(encoding="srgb", jpeg=JpegCompression.at_quality(80, name))


def test_jpegs_that_are_grey_or_have_no_luma(tmp_path, picture):
    levels = to_levels(picture, "srgb", 8)
    iio.imwrite(tmp_path / "grey.jpg", levels[..., 0], quality=80)
    grey = read_film(tmp_path / "grey.jpg", "srgb").jpeg
    assert grey is not None and grey.subsampling == "grey"
    iio.imwrite(tmp_path / "rgb.jpg", levels, quality=80, keep_rgb=True)
    rgb = read_film(tmp_path / "rgb.jpg", "srgb").jpeg
    assert rgb is not None and not rgb.ycbcr
    assert rgb.tables == grey.tables * 3


@pytest.mark.parametrize(
    "suffix, bits, film",
    [
        (".png", 8, Film(encoding="srgb", bits=8)),
        (".tif", 16, Film(encoding="srgb", bits=16)),
        (".exr", 32, Film(clamp=False)),
    ],
)
def test_films_of_other_formats(tmp_path, picture, suffix, bits, film):
    path = tmp_path / f"image{suffix}"
    write_image(path, picture, "linear" if bits == 32 else "srgb", bits)
    assert read_film(path, "srgb") == film


@pytest.mark.parametrize("format", ["GIF", "BMP", "TGA", "PPM", "WEBP", "AVIF", "EPS"])
def test_other_formats_are_no_jpeg(tmp_path, format, monkeypatch):
    path = tmp_path / "a.jpg"
    Image.new("RGB", (16, 16)).save(path, format)
    # An EPS file is a program, which Pillow gives to Ghostscript.
    monkeypatch.setattr("PIL.EpsImagePlugin.Ghostscript", None)
    words = {"WEBP": "is a WebP", "AVIF": "is a HEIF or AVIF"} | {
        kind: f"is a {kind}" for kind in ("GIF", "BMP")
    }
    words = words.get(format, r"is broken or no \.jpg") + " image"
    for read in (read_image, read_film):
        with pytest.raises(ValueError, match=rf"a\.jpg: {words}"):
            read(path, "srgb")


@pytest.mark.parametrize("suffix, bits, error", FORMATS)
@pytest.mark.parametrize("wrong", [".png", ".jpg", ".tif", ".exr", ".hdr", ".dng"])
def test_the_first_bytes_tell_the_format(tmp_path, picture, suffix, bits, error, wrong):
    """A file with another format's suffix is read, with its film, as what it is."""
    path, renamed = tmp_path / f"a{suffix}", tmp_path / f"b{wrong}"
    write_image(path, picture, "linear", bits)
    renamed.write_bytes(path.read_bytes())
    if (suffix[:4], wrong) == (".tif", ".dng"):
        # RAW photographs start as a TIFF does.
        with pytest.raises(ValueError, match=r"b\.dng"):
            read_image(renamed, "linear")
        return
    assert np.array_equal(read_image(renamed, "linear"), read_image(path, "linear"))
    assert read_film(renamed, "linear") == read_film(path, "linear")
    assert (read_film(renamed, "linear").jpeg is not None) == (suffix == ".jpg")


def _tiff(*tags: tuple[int, int], kind: int = 4, big: bool = False) -> bytes:
    """A TIFF of these tags alone, little end first, and no pixels."""
    head = struct.pack("<2sHHHQ", b"II", 43, 8, 0, 16) if big else b"II*\0\x08\0\0\0"
    count, entry = ("<Q", "<HHQQ") if big else ("<H", "<HHII")
    parts = [struct.pack(entry, tag, kind, 1, value) for tag, value in tags]
    return head + struct.pack(count, len(tags)) + b"".join(parts) + bytes(8)


BOMBS = {
    "long8.tif": (_tiff((256, 10**6), (257, 10**6), kind=16, big=True), "1000000 × "),
    "tiles.tif": (
        _tiff((256, 4), (257, 4), (258, 8), (277, 3), (322, 10**6), (323, 10**6)),
        "at most 1 GB of memory",
    ),
    "twice.tif": (_tiff((256, 4), (257, 4), (257, 10**6)), "has tag 257 twice"),
    "layers.tif": (_tiff((256, 4), (257, 4), (32997, 10**6)), "of several layers"),
    "channels.tif": (
        _tiff((256, 4), (257, 4), (258, 8), (262, 2), (277, 60)),
        "at most 4 channels, got 60",
    ),
    "dark.hdr": (
        b"#?RADIANCE\nEXPOSURE=-2\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 1\nabcd",
        "expected EXPOSURE > 0, got -2",
    ),
    "huge.hdr": (
        b"#?RADIANCE\nEXPOSURE=nan\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 1\nabcd",
        "expected EXPOSURE > 0, got nan",
    ),
}


@pytest.mark.parametrize("name", BOMBS)
def test_headers_that_are_not_believed(tmp_path, name, capfd):
    data, message = BOMBS[name]
    (tmp_path / name).write_bytes(data)
    _check_one_line(tmp_path / name, message, capfd)


def test_exr_of_many_channels_or_parts(tmp_path, monkeypatch, capfd):
    path, plane = tmp_path / "a.exr", np.zeros((64, 64), np.float16)
    many = {f"c{k}": plane for k in range(60)}
    _write_exr(path, many)
    _check_one_line(path, "expected channels R, G, B or Y, got c0", capfd)
    small = {name: plane[:4, :4].copy() for name in "RGB"}
    rows = ("one", small), ("two", {name: plane for name in "RGB"})
    window = {"displayWindow": ((0, 0), (3, 3))}
    parts = [OpenEXR.Part(dict(window), channels, name) for name, channels in rows]
    OpenEXR.File(parts).write(str(path))
    _check_one_line(path, "expected one part, got 2: save each as a file", capfd)
    _write_exr(path, many)
    monkeypatch.setenv("PHONGFIT_MAX_MEMORY", "64K")
    _check_one_line(path, "at most 64 KB of memory, got 64 × 64 pixels", capfd)


def test_texts_of_a_png_are_not_unpacked(tmp_path, picture):
    path = tmp_path / "a.png"
    write_image(path, picture, "linear", 8)
    text = b"zTXtkey\0\0not packed at all"
    chunk = struct.pack(">I", len(text) - 4) + text + bytes(4)
    data, light = path.read_bytes(), read_image(path, "linear")
    path.write_bytes(data[:33] + chunk + data[33:])
    np.testing.assert_array_equal(read_image(path, "linear"), light)


def test_parallel_readers_leave_the_error_output_alone(tmp_path, picture, capfd):
    path = tmp_path / "a.exr"
    write_image(path, picture, "linear")
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda _: read_image(path, "linear"), range(40)))
    os.write(2, b"still heard")
    assert capfd.readouterr().err == "still heard"
