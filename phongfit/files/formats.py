"""Image formats: from the bytes of a file to its numbers, and back.

A reader raises whatever its decoder does; [`read_image`][] makes one line of it.
"""

import base64
import contextlib
import errno
import io
import logging
import os
import re
import struct
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import imagecodecs
import imageio.v3 as iio
import numpy as np
import OpenEXR
from PIL import Image

from phongfit.rendering.jpeg import JpegCompression

# What a decoder minds and bears is for whoever asks for logs, not for the terminal.
logging.getLogger("imagecodecs").addHandler(logging.NullHandler())

MAX_PIXELS = 2**27
"""Images with more pixels are refused: they would fill the memory."""


class Refused(Exception):
    """The file is whole, but not what is wanted."""


def _check_size(width: int, height: int, most: int) -> None:
    if width * height > most:
        raise Refused(
            f"expected at most {most} pixels, got {width} × {height}; a smaller copy "
            "will do"
        )


def _read_png(data: bytes, path: Path, most: int) -> np.ndarray:
    del path
    if data[:8] != b"\x89PNG\r\n\x1a\n":
        raise ValueError("it does not start as a PNG does")
    width, height = struct.unpack(">II", data[16:24])
    _check_size(width, height, most)
    # Decoders are content without the end, where a copy may have been cut off.
    if b"IEND\xaeB`\x82" not in data[-4096:]:
        raise ValueError("it is truncated")
    return imagecodecs.png_decode(data)


def _read_jpeg(data: bytes, path: Path, most: int) -> np.ndarray:
    del path
    with warnings.catch_warnings():
        # Pillow only warns of a picture that would fill the memory.
        warnings.filterwarnings("error", "Image size", RuntimeWarning)
        height, width = iio.improps(data, plugin="pillow", extension=".jpg").shape[:2]
        _check_size(width, height, most)
        numbers = iio.imread(data, plugin="pillow", extension=".jpg")
    if numbers.ndim == 3 and numbers.shape[-1] != 3:
        raise Refused("expected RGB or grey, got CMYK")
    return numbers


def jpeg_compression(data: bytes) -> JpegCompression:
    """What the head of a JPEG file says that it rounds."""
    with Image.open(io.BytesIO(data), formats=["JPEG"]) as image:
        steps: dict = getattr(image, "quantization", {})
        # Of each component its number, samples across and down, and its table's number.
        layers: list[tuple[int, int, int, int]] = getattr(image, "layer", [])
        # As the Independent JPEG Group's library takes it.
        rgb = [layer[0] for layer in layers] == [ord(name) for name in "RGB"]
        rgb = image.info["adobe_transform"] == 0 if "adobe" in image.info else rgb
        rgb = rgb and "jfif" not in image.info
    if len(layers) not in (1, 3):
        raise Refused("expected RGB or grey, got CMYK")
    return JpegCompression(
        tuple(np.reshape(steps[table], (8, 8)) for *_, table in layers),
        # Of one component alone its number of samples means nothing.
        tuple((across, down) for _, across, down, _ in layers) if layers[1:] else (),
        not rgb,
    )


def _read_tiff(data: bytes, path: Path, most: int) -> np.ndarray:
    del path
    tags = _tiff_tags(data)
    _check_size(tags.get(256, 0), tags.get(257, 0), most)
    # 1 and 2 are grey, where 0 is black, and RGB; there are inverted ones, palettes …
    photometric = tags.get(262)
    if photometric not in (1, 2):
        raise Refused(f"expected photometric interpretation 1 or 2, got {photometric}")
    numbers = imagecodecs.tiff_decode(data)
    # Planar configuration 2: one plane a channel.
    return np.moveaxis(numbers, 0, -1) if tags.get(284) == 2 else numbers


def _tiff_tags(data: bytes) -> dict[int, int]:
    """The whole numbers among the tags of a TIFF's first picture.

    ??? cite "Source"
        *TIFF, revision 6.0*, Adobe, 1992, section 2; BigTIFF, Aware Systems, 2008.
    """
    if data[:4] not in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        raise ValueError("it does not start as a TIFF does")
    order = "<" if data[:2] == b"II" else ">"
    (version,) = struct.unpack_from(order + "H", data, 2)
    offset, count, entry = {42: "IHI", 43: "QQQ"}[version]
    (start,) = struct.unpack_from(order + offset, data, 4 if version == 42 else 8)
    (tags,) = struct.unpack_from(order + count, data, start)
    start += struct.calcsize(order + count)
    size = struct.calcsize("<HH" + 2 * entry)
    values = {}
    for at in range(start, start + tags * size, size):
        tag, kind = struct.unpack_from(order + "HH", data, at)
        # Types 3 and 4 are whole numbers of 16 and 32 bits, stored in the entry.
        if kind in (3, 4):
            number = order + ("H" if kind == 3 else "I")
            (values[tag],) = struct.unpack_from(
                number, data, at + 4 + struct.calcsize("<" + entry)
            )
    return values


def _read_hdr(data: bytes, path: Path, most: int) -> np.ndarray:
    del path
    header, _, _ = data.partition(b"\n\n")
    size = re.match(rb"\s*[-+]Y (\d+) [-+]X (\d+)\n", data[len(header) :])
    if not data.startswith(b"#?") or size is None:
        raise ValueError("it does not start as a Radiance picture does")
    _check_size(int(size[2]), int(size[1]), most)
    # A pixel is radiance times all exposures that were ever applied to it.
    exposures = re.findall(rb"^EXPOSURE\s*=\s*(\S+)", header, re.MULTILINE)
    exposure = np.prod([float(value) for value in exposures], initial=1.0)
    return imagecodecs.rgbe_decode(data) / np.float32(exposure)


def _read_exr(data: bytes, path: Path, most: int) -> np.ndarray:
    del data
    with _silent_library():
        with OpenEXR.File(os.fspath(path), header_only=True) as file:
            (left, top), (right, bottom) = file.header()["dataWindow"]
        _check_size(int(right - left + 1), int(bottom - top + 1), most)
        with OpenEXR.File(os.fspath(path), separate_channels=True) as file:
            channels = {k: v.pixels for k, v in file.channels().items()}
    for names in ("RGB", "RGBA", "Y", "YA"):
        if set(channels) == set(names):
            return np.stack([channels[name] for name in names], axis=-1)
    raise Refused(f"expected channels R, G, B or Y, got {', '.join(channels)}")


@contextlib.contextmanager
def _silent_library() -> Iterator[None]:
    """OpenEXR prints its complaints itself; they come as exceptions as well."""
    saved = os.dup(2)
    try:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        with contextlib.redirect_stdout(None):
            yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)


Reader = Callable[[bytes, Path, int], np.ndarray]
"""Takes the file's bytes, its path, and how many pixels it may have at most."""

READERS: dict[str, Reader] = {
    ".png": _read_png,
    ".jpg": _read_jpeg,
    ".jpeg": _read_jpeg,
    ".tif": _read_tiff,
    ".tiff": _read_tiff,
    ".hdr": _read_hdr,
    ".exr": _read_exr,
}


# Writing.


def encode_png(numbers: np.ndarray) -> bytes:
    """A PNG file of (H, W, channels) whole numbers of 8 or 16 bits."""
    return bytes(imagecodecs.png_encode(np.ascontiguousarray(numbers)))


def data_uri(png: bytes) -> str:
    """A PNG file as an address that holds it."""
    return f"data:image/png;base64,{base64.b64encode(png).decode('ascii')}"


def _write_png(path: Path, numbers: np.ndarray) -> None:
    path.write_bytes(encode_png(numbers))


def _write_jpeg(path: Path, numbers: np.ndarray) -> None:
    # Without subsampling: colour is what is measured here.
    iio.imwrite(path, numbers, plugin="pillow", quality=95, subsampling=0)


def _write_tiff(path: Path, numbers: np.ndarray) -> None:
    path.write_bytes(imagecodecs.tiff_encode(numbers, photometric="rgb"))


def _write_hdr(path: Path, numbers: np.ndarray) -> None:
    # Its shared exponent knows no light below 0.
    path.write_bytes(imagecodecs.rgbe_encode(np.maximum(numbers, 0), header=True))


def _write_exr(path: Path, numbers: np.ndarray) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    try:
        with OpenEXR.File(header, {"RGB": numbers}) as file:
            file.write(os.fspath(path))
    except RuntimeError as error:
        # As OpenEXR tells of a full disk, in words alone.
        raise OSError(errno.EIO, str(error).rpartition('". ')[2]) from error


Writer = Callable[[Path, np.ndarray], None]

WRITERS: dict[str, dict[int, Writer]] = {
    ".png": {8: _write_png, 16: _write_png},
    ".jpg": {8: _write_jpeg},
    ".jpeg": {8: _write_jpeg},
    ".tif": {8: _write_tiff, 16: _write_tiff, 32: _write_tiff},
    ".tiff": {8: _write_tiff, 16: _write_tiff, 32: _write_tiff},
    ".hdr": {32: _write_hdr},
    ".exr": {32: _write_exr},
}
