"""RAW photographs: a sensor's own numbers, as linear light."""

import struct
import sys

import numpy as np
import pytest

from phongfit.files.images import read_film, read_head, read_image, read_light
from phongfit.files.photographs import open_photographs, read_photograph
from phongfit.rendering.film import Film

BLACK, WHITE = 64, 4095
# From XYZ to sRGB, IEC 61966-2-1, and to Display P3: cameras that see these primaries.
SEES_SRGB = (3.2405, -1.5371, -0.4985, -0.9693, 1.8760, 0.0416, 0.0556, -0.2040, 1.0572)
SEES_P3 = (2.4935, -0.9314, -0.4027, -0.8295, 1.7627, 0.0236, 0.0358, -0.0762, 0.9569)


def dng(
    mosaic: np.ndarray,
    matrix: tuple[float, ...] = SEES_SRGB,
    neutral: tuple[float, ...] = (0.5, 1, 0.8),
    black: tuple[int, ...] = (BLACK,) * 4,
    orientation: int = 1,
    white: int = WHITE,
) -> bytes:
    """A DNG, red and green above green and blue; a linear DNG of an (H, W, 3) array.

    `neutral`: what the sensor sees of white. Source: Adobe, *Digital Negative
    Specification 1.4*, 2012, chapter 4.
    """

    def ratios(kind: str, values: tuple[float, ...]) -> bytes:
        pairs = [n for value in values for n in (round(value * 10**6), 10**6)]
        return struct.pack(f"<{len(pairs)}{kind}", *pairs)

    def shorts(*values: int) -> bytes:
        return struct.pack(f"<{len(values)}H", *values)

    pixels = mosaic.astype("<u2").tobytes()
    height, width = mosaic.shape[:2]
    samples, photometric = (3, 34892) if mosaic.ndim == 3 else (1, 32803)
    exposure = [(33434, 5, 1, struct.pack("<II", 1, 60)),
                (33437, 5, 1, struct.pack("<II", 8, 1)),
                (34855, 3, 1, shorts(200))]  # fmt: skip
    cells = [(33421, 3, 2, shorts(2, 2)), (33422, 1, 4, bytes([0, 1, 1, 2]))]
    tags = [(254, 4, 1, bytes(4)), (256, 3, 1, shorts(width)),
            (257, 3, 1, shorts(height)), (258, 3, samples, shorts(*[16] * samples)),
            (259, 3, 1, shorts(1)), (262, 3, 1, shorts(photometric)),
            (271, 2, 5, b"Test\0"), (272, 2, 5, b"Test\0"), (273, 4, 1, bytes(4)),
            (274, 3, 1, shorts(orientation)), (277, 3, 1, shorts(samples)),
            (278, 3, 1, shorts(height)), (279, 4, 1, struct.pack("<I", len(pixels))),
            (284, 3, 1, shorts(1)), *(cells if samples == 1 else []),
            (34665, 4, 1, bytes(4)),
            (50706, 1, 4, bytes([1, 4, 0, 0])), (50708, 2, 5, b"Test\0"),
            *([(50713, 3, 2, shorts(2, 2))] if samples == 1 else []),
            (50714, 3, len(black), shorts(*black)),
            (50717, 3, samples, shorts(*[white] * samples)),
            (50721, 10, 9, ratios("i", matrix)),
            (50728, 5, 3, ratios("I", neutral)), (50778, 3, 1, shorts(21))]  # fmt: skip
    second = 8 + len(directory(tags, 8))
    behind = directory(exposure, second)
    places = {273: second + len(behind), 34665: second}
    tags = [
        (tag, kind, count, struct.pack("<I", places[tag]) if tag in places else value)
        for tag, kind, count, value in tags
    ]
    return b"II*\0" + struct.pack("<I", 8) + directory(tags, 8) + behind + pixels


def directory(tags: list[tuple[int, int, int, bytes]], start: int) -> bytes:
    """Tags of a TIFF, with what does not fit in them behind."""
    entries, beside = b"", b""
    for tag, kind, count, value in tags:
        held = value.ljust(4, b"\0")
        if len(value) > 4:
            held = struct.pack("<I", start + 2 + 12 * len(tags) + 4 + len(beside))
            beside += value
        entries += struct.pack("<HHI", tag, kind, count) + held
    return struct.pack("<H", len(tags)) + entries + bytes(4) + beside


def seen(*rgb: float) -> np.ndarray:
    """The mosaic of one colour, in shares of white beyond black, 32 × 48."""
    mosaic = np.empty((32, 48))
    cells = ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2))
    for row, column, channel in cells:
        mosaic[row::2, column::2] = BLACK + rgb[channel] * (WHITE - BLACK)
    return np.round(mosaic)


@pytest.fixture
def rawpy():
    return pytest.importorskip("rawpy", reason="rawpy is not installed here")


def test_the_light_of_a_raw_photograph(tmp_path, rawpy):
    path = tmp_path / "a.dng"
    # White balance: red is seen at a half, blue at four fifths.
    path.write_bytes(dng(seen(0.1, 0.2, 0.24)))
    photo = read_light(path, "linear")
    image = photo.image
    assert image.shape == (32, 48, 3) and photo.usable.all()
    expected = np.broadcast_to([0.2, 0.2, 0.3], image.shape)
    np.testing.assert_allclose(image, expected, atol=3e-4)
    assert read_film(path, "linear") == Film()
    photo = read_photograph(path, "linear")
    assert str(photo.exposure) == "1/60 s, f/8, ISO 200"
    assert read_head(path).white_balance == pytest.approx((2, 1.25), rel=1e-4)


def test_white_is_the_sensors_own(tmp_path, rawpy):
    """A darker photograph is darker: nothing is made as bright as will go."""
    for share in (0.02, 0.2):
        path = tmp_path / "a.dng"
        path.write_bytes(dng(seen(share / 2, share, share * 0.8)))
        image = read_image(path, "linear")
        np.testing.assert_allclose(image, share, atol=3e-4)


def test_black_of_each_channel(tmp_path, rawpy):
    mosaic, black = seen(0.1, 0.2, 0.16), (64, 80, 72, 100)
    for place, level in enumerate(black):
        mosaic[place // 2 :: 2, place % 2 :: 2] += level - BLACK
    (tmp_path / "a.dng").write_bytes(dng(mosaic, black=black))
    image = read_image(tmp_path / "a.dng", "linear")
    # White lies above the least black.
    np.testing.assert_allclose(image, 0.2, rtol=0.02)
    assert np.ptp(image.mean(axis=(0, 1))) < 0.004


def test_colours_become_those_of_srgb(tmp_path, rawpy):
    path = tmp_path / "a.dng"
    path.write_bytes(dng(seen(0.2, 0.3, 0.1), SEES_P3, (1, 1, 1)))
    from_p3 = [[1.2249, -0.2249, 0], [-0.0420, 1.0420, 0], [-0.0197, -0.0786, 1.0983]]
    expected = np.array(from_p3) @ [0.2, 0.3, 0.1]
    image = read_image(path, "linear")
    np.testing.assert_allclose(image[16, 24], expected, atol=1e-3)


def test_saturated_and_turned(tmp_path, rawpy):
    mosaic = seen(0.1, 0.2, 0.16)
    mosaic[:8, :8] = WHITE
    path = tmp_path / "a.dng"
    path.write_bytes(dng(mosaic, orientation=6))
    assert read_head(path).size == (32, 48)
    photo = read_light(path, "linear")
    image = photo.image
    assert image.shape == (48, 32, 3)
    # The file's upper left corner has come to the right.
    usable = photo.usable
    assert not usable[:8, -8:].any() and usable[12:].all() and usable[:, :20].all()
    assert (image[:6, -6:] == 1).all()
    np.testing.assert_allclose(image[14:, :16], 0.2, atol=3e-4)


@pytest.mark.parametrize("white, black", [
    (4095, 256), (4095, 0), (16383, 512), (15892, 600), (65535, 4096), (65535, 0),
])  # fmt: skip
def test_burnt_out_whatever_the_white_level(tmp_path, rawpy, white, black):
    """In a mosaic, of which green alone is burnt out, and in a linear DNG."""
    light = np.full((32, 48, 3), (0.15, 0.3, 0.24))
    light[:12, :12, 1] = 1.3
    numbers = np.round(black + np.minimum(light, 1) * (white - black))
    mosaic = numbers[..., 1].copy()
    mosaic[::2, ::2], mosaic[1::2, 1::2] = numbers[::2, ::2, 0], numbers[1::2, 1::2, 2]
    for sensor, levels in ((mosaic, 4), (numbers, 3)):
        path = tmp_path / "a.dng"
        path.write_bytes(dng(sensor, black=(black,) * levels, white=white))
        photo = read_photograph(path, "linear")
        assert not photo.unsaturated[4, 4].any() and photo.unsaturated[20:].all()
        np.testing.assert_allclose(photo.image[20:], 0.3, atol=3e-4)


def test_one_white_balance_for_all(tmp_path, rawpy):
    (tmp_path / "a.dng").write_bytes(dng(seen(0.1, 0.2, 0.16)))
    (tmp_path / "b.dng").write_bytes(dng(seen(0.1, 0.2, 0.16), neutral=(0.6, 1, 0.8)))
    words = r"b\.dng: expected the white balance of a\.dng, red × 2 and blue × 1\.25, g"
    with pytest.raises(ValueError, match=words):
        open_photographs([tmp_path / "a.dng", tmp_path / "b.dng"], "linear")
    series = open_photographs([tmp_path / "a.dng"] * 2, "linear")
    assert series.relative_exposures.tolist() == [1, 1] and series.notes == ()


def test_broken_and_misread(tmp_path, rawpy, capfd):
    path, data = tmp_path / "a.dng", dng(seen(0.1, 0.2, 0.16))
    for broken in (b"", b"hello", data[:300], data[:-100]):
        path.write_bytes(broken)
        with pytest.raises(
            ValueError, match=r"a\.dng: is broken or no \.dng image: \w"
        ):
            read_image(path, "linear")
    path.write_bytes(data)
    with pytest.raises(ValueError, match="expected encoding 'linear', as RAW photogr"):
        read_image(path, "srgb")
    with pytest.raises(ValueError, match="1535 pixels .max_pixels., got 48 × 32"):
        read_image(path, "linear", max_pixels=32 * 48 - 1)
    assert capfd.readouterr() == ("", "")


def test_without_rawpy(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rawpy", None)
    (tmp_path / "a.nef").write_bytes(b"")
    words = r"a\.nef: expected rawpy.*pip install 'phongfit\[raw\]'"
    with pytest.raises(ValueError, match=words):
        read_image(tmp_path / "a.nef", "linear")
