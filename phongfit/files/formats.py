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
import threading
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import imagecodecs
import imageio.v3 as iio
import numpy as np
import OpenEXR
from PIL import Image

from phongfit.files.tags import first_directory
from phongfit.rendering.jpeg import JpegCompression

# What a decoder minds and bears is for whoever asks for logs, not for the terminal.
logging.getLogger("imagecodecs").addHandler(logging.NullHandler())


class Refused(Exception):
    """The file is whole, but not what is wanted."""


Room = Callable[[int, int, float], None]
"""Asked before pixels are decoded: is there room for so many columns and rows, which
take so many bytes a pixel while they are? [`Refused`][] if not."""


PNG_START = b"\x89PNG\r\n\x1a\n"


def _read_png(data: bytes, path: Path, room: Room) -> np.ndarray:
    del path
    if data[:8] != PNG_START:
        raise ValueError("it does not start as a PNG does")
    width, height, depth, colour = struct.unpack(">IIBB", data[16:26])
    # Of a palette's colours a decoder makes up to four channels.
    channels = {0: 1, 2: 3, 3: 4, 4: 2, 6: 4}.get(colour, 4)
    room(width, height, channels * (2 if depth == 16 else 1))
    chunks = [chunk for kind, chunk in png_chunks(data) if kind in _PIXELS]
    return imagecodecs.png_decode(b"".join([data[:8], *chunks]))


# What tells of pixels; texts and profiles may unpack to any size.
_PIXELS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")


def png_chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Each chunk's kind, and the whole of it: length, kind, content, checksum."""
    at = 8
    while at + 8 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        kind, end = data[at + 4 : at + 8], at + 12 + length
        yield kind, data[at:end]
        # Decoders are content without the end, where a copy may have been cut off.
        if kind == b"IEND" and end <= len(data):
            return
        at = end
    raise ValueError("it is truncated")


@contextlib.contextmanager
def opened_jpeg(data: bytes) -> Iterator[Image.Image]:
    """A JPEG file, opened as nothing else: Pillow knows formats that run programs."""
    with warnings.catch_warnings():
        # Of sizes, which are asked for here, and of EXIF data, which is read elsewhere.
        warnings.simplefilter("ignore")
        with Image.open(io.BytesIO(data), formats=["JPEG"]) as image:
            yield image


# Of 16 MB each: four photographs of 60 megapixels.
_BLOCKS = 64
_KEPT = Image.core.get_blocks_max()


@contextlib.contextmanager
def pooled_memory() -> Iterator[None]:
    """Photographs that the block decodes take the memory of those before them.

    Pillow gives it back after each one, unless told otherwise, and fresh pages take as
    long as decoding. No more is kept than was in use at a time.

    ??? cite "Source"
        Pillow's documentation, *Block allocator*.
    """
    Image.core.set_blocks_max(_BLOCKS)
    try:
        yield
    finally:
        Image.core.set_blocks_max(_KEPT)


def _read_jpeg(data: bytes, path: Path, room: Room) -> np.ndarray:
    del path
    with opened_jpeg(data) as image:
        if image.mode not in ("L", "RGB"):
            raise Refused(f"expected RGB or grey, got {image.mode}")
        # Pillow holds four bytes of colour, and gives a copy of them.
        room(*image.size, {"L": 3, "RGB": 10}[image.mode])
        return np.asarray(image)


def jpeg_compression(data: bytes) -> JpegCompression:
    """What the head of a JPEG file says that it rounds."""
    with opened_jpeg(data) as image:
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


def _read_tiff(data: bytes, path: Path, room: Room) -> np.ndarray:
    del path
    tags = first_directory(data)
    width, height = tags.whole(_WIDTH), tags.whole(_HEIGHT)
    if tags.whole(_IMAGE_DEPTH, 1) != 1:
        raise Refused("expected a flat picture, got one of several layers")
    bits = tags.whole(_BITS, 1)
    channels, planes = tags.whole(_CHANNELS, 1), tags.whole(_PLANES, 1)
    pixel = channels * -(-bits // 8)
    # One that is cut into tiles is read tile by tile, and a tile may be the larger.
    tile = tags.whole(_TILE_WIDTH) * tags.whole(_TILE_HEIGHT)
    room(width, height, pixel * (1 + tile / max(width * height, 1)))
    # 1 and 2 are grey, where 0 is black, and RGB; there are inverted ones, palettes …
    photometric = tags.whole(_PHOTOMETRIC, -1)
    if photometric not in (1, 2):
        raise Refused(f"expected photometric interpretation 1 or 2, got {photometric}")
    if channels > 4:
        raise Refused(f"expected at most 4 channels, got {channels}")
    numbers = imagecodecs.tiff_decode(data)
    # Planar configuration 2: one plane a channel.
    return np.moveaxis(numbers, 0, -1) if planes == 2 else numbers


_WIDTH, _HEIGHT, _BITS, _PHOTOMETRIC, _CHANNELS, _PLANES = 256, 257, 258, 262, 277, 284
_TILE_WIDTH, _TILE_HEIGHT, _IMAGE_DEPTH = 322, 323, 32997


def _read_hdr(data: bytes, path: Path, room: Room) -> np.ndarray:
    del path
    header, _, _ = data.partition(b"\n\n")
    size = re.match(rb"\s*-Y (\d{1,9}) \+X (\d{1,9})\n", data[len(header) :])
    if not data.startswith(b"#?") or size is None:
        raise ValueError("it does not start as a Radiance picture does")
    height, width = int(size[1]), int(size[2])
    room(width, height, 12)
    # A pixel is radiance times all exposures that were ever applied to it.
    exposures = re.findall(rb"^EXPOSURE\s*=\s*(\S+)", header, re.MULTILINE)
    exposure = np.prod([float(value) for value in exposures], initial=1.0)
    if not 1e-30 < exposure < 1e30:
        raise Refused(f"expected an EXPOSURE > 0, got {exposure:g}")
    numbers = np.empty((height, width, 3), np.float32)
    imagecodecs.rgbe_decode(data, out=numbers)
    numbers /= np.float32(exposure)
    return numbers


def _read_exr(data: bytes, path: Path, room: Room) -> np.ndarray:
    with silent_library():
        with OpenEXR.File(os.fspath(path), header_only=True) as file:
            headers = [part.header for part in file.parts]
            width, height = _exr_window(headers[0])
            size = sum(map(_exr_bytes, headers))
            found = {channel.name for channel in headers[0]["channels"]}
        # All parts are read, whatever is wanted of them, and the first is copied.
        room(width, height, 2 * size / max(width * height, 1))
        orders = [names for names in ("RGB", "RGBA", "Y", "YA") if set(names) == found]
        if not orders:
            got = ", ".join(sorted(found)[:8])
            raise Refused(f"expected channels R, G, B or Y, got {got}")
        with OpenEXR.File(os.fspath(path), separate_channels=True) as file:
            channels = {k: v.pixels for k, v in file.channels().items()}
    # The library opens files by their names only.
    if path.read_bytes() != data:
        raise Refused("changed while it was read")
    return np.stack([channels[name] for name in orders[0]], axis=-1)


def _exr_window(header: dict[str, Any]) -> tuple[int, int]:
    (left, top), (right, bottom) = (map(int, ends) for ends in header["dataWindow"])
    return right - left + 1, bottom - top + 1


def _exr_bytes(header: dict[str, Any]) -> int:
    """Of all channels of a part, four to a number."""
    width, height = _exr_window(header)
    return 4 * width * height * len(header["channels"])


# One at a time, since the error output is the whole process's.
_silence = threading.Lock()


@contextlib.contextmanager
def silent_library() -> Iterator[None]:
    """Libraries that print their complaints; they come as exceptions as well."""
    with _silence:
        saved = os.dup(2)
        try:
            with open(os.devnull, "w") as nowhere:
                os.dup2(nowhere.fileno(), 2)
            with contextlib.redirect_stdout(None):
                yield
        finally:
            os.dup2(saved, 2)
            os.close(saved)


Reader = Callable[[bytes, Path, Room], np.ndarray]
"""Takes the file's bytes, its path, and whom to ask for room."""

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


def encode_webp(numbers: np.ndarray) -> bytes:
    """A lossless WebP file of (H, W, 3) whole numbers of 8 bits: smaller than a PNG."""
    pixels = np.ascontiguousarray(numbers, np.uint8)
    return bytes(imagecodecs.webp_encode(pixels, lossless=True, level=75))


def data_uri(picture: bytes, kind: str = "png") -> str:
    """A picture's file as an address that holds it."""
    return f"data:image/{kind};base64,{base64.b64encode(picture).decode('ascii')}"


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


def _read_picture(data: bytes, path: Path, room: Room) -> np.ndarray:
    """Colours as pictures for the screen have them: of palettes, or of four inks."""
    del path
    known = ["BMP", "GIF", "JPEG", "TGA", "WEBP"]
    with Image.open(io.BytesIO(data), formats=known) as image:
        # Pillow holds four bytes a pixel, before and after it changes the mode.
        room(*image.size, 12)
        if image.mode in ("L", "RGB", "RGBA"):
            return np.asarray(image)
        mode = "RGBA" if image.has_transparency_data else "RGB"
        return np.asarray(image.convert(mode))


TEXTURE_READERS: dict[str, Reader] = READERS | dict.fromkeys(
    (".jpg", ".jpeg", ".tga", ".bmp", ".gif", ".webp"), _read_picture
)
"""Readers of textures, whose files are of more formats than those of photographs."""

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
