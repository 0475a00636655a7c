"""Image formats: from the bytes of a file to its numbers, and back.

A reader raises any exception of its decoder; [`read_image`][] turns it into one line.
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
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import imagecodecs
import imageio.v3 as iio
import numpy as np
import OpenEXR
from jaxtyping import Float
from PIL import Image, ImageFile

from phongfit.files.tags import first_directory
from phongfit.rendering.jpeg import JpegCompression

# Keep the decoder's warnings off the terminal, unless logging is configured.
logging.getLogger("imagecodecs").addHandler(logging.NullHandler())


class Refused(ValueError):
    """An intact file whose contents are not supported."""


Room = Callable[[int, int, float], None]
"""Check of memory before pixels are decoded: takes columns, rows and the bytes that
decoding needs for each pixel; raises [`Refused`][] if there is not enough."""


PNG_START, JPEG_START = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
JPEG_END = b"\xff\xd9"


def _read_png(data: bytes, _path: Path, room: Room) -> np.ndarray:
    if data[:8] != PNG_START:
        raise ValueError("it does not start as a PNG does")
    width, height, depth, colour = struct.unpack(">IIBB", data[16:26])
    # A palette is decoded into up to four channels.
    channels = {0: 1, 2: 3, 3: 4, 4: 2, 6: 4}.get(colour, 4)
    room(width, height, channels * (2 if depth == 16 else 1))
    chunks = [chunk for kind, chunk in png_chunks(data) if kind in _PIXELS]
    return imagecodecs.png_decode(b"".join([data[:8], *chunks]))


# Chunks that hold pixels; texts and profiles may unpack to any size.
_PIXELS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")


def png_chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Each chunk's kind, and its bytes: length, kind, content, checksum."""
    at = 8
    while at + 8 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        kind, end = data[at + 4 : at + 8], at + 12 + length
        yield kind, data[at:end]
        # Required here, since decoders accept files without it, such as cut-off copies.
        if kind == b"IEND" and end <= len(data):
            return
        at = end
    raise ValueError("it is truncated")


@contextlib.contextmanager
def opened_jpeg(data: bytes) -> Iterator[ImageFile.ImageFile]:
    """A JPEG file opened in Pillow, as JPEG only: other formats may run programs."""
    with warnings.catch_warnings():
        # Pillow warns of sizes, which `room` checks, and of EXIF data, which is unused.
        warnings.simplefilter("ignore")
        with Image.open(io.BytesIO(data), formats=["JPEG"]) as image:
            yield image


def _read_jpeg(data: bytes, _path: Path, room: Room) -> np.ndarray:
    with opened_jpeg(data) as image:
        if image.mode not in ("L", "RGB"):
            raise Refused(f"expected RGB or grey, got {image.mode}")
        # libjpeg holds two more bytes of each number of a progressive file.
        room(*image.size, {"L": 3, "RGB": 9}[image.mode])
        start = image.fp.tell() if image.fp else 0
    # libjpeg fills missing data with grey; the end marker never occurs in coded data.
    if data.find(JPEG_END, start) < 0:
        raise ValueError("it is truncated")
    return imagecodecs.jpeg8_decode(data)


def jpeg_compression(data: bytes) -> JpegCompression:
    """Quantisation tables, subsampling and colour space from a JPEG file's header."""
    with opened_jpeg(data) as image:
        steps: dict = getattr(image, "quantization", {})
        # For each component: number, samples across and down, number of its table.
        layers: list[tuple[int, int, int, int]] = getattr(image, "layer", [])
        # The rules of the Independent JPEG Group's library.
        rgb = [layer[0] for layer in layers] == [ord(name) for name in "RGB"]
        rgb = image.info["adobe_transform"] == 0 if "adobe" in image.info else rgb
        rgb = rgb and "jfif" not in image.info
    if len(layers) not in (1, 3):
        raise Refused("expected RGB or grey, got CMYK")
    return JpegCompression(
        tuple(np.reshape(steps[table], (8, 8)) for *_, table in layers),
        # With a single component the sampling factors have no meaning.
        tuple((across, down) for _, across, down, _ in layers) if layers[1:] else (),
        not rgb,
    )


def _read_tiff(data: bytes, _path: Path, room: Room) -> np.ndarray:
    tags = first_directory(data)
    if tags.whole(_SUBFILE) & _SMALLER:
        raise Refused(
            "expected a whole picture first, got a small copy, as RAW photographs have "
            "it: give it their suffix (.dng, .nef)"
        )
    if not all(other.whole(_SUBFILE) & _NO_PICTURE for other in tags.others()):
        raise Refused(
            "expected one picture, got several (pages, or a page for each channel): "
            "save each as a file, or the channels as one picture"
        )
    width, height = tags.whole(_WIDTH), tags.whole(_HEIGHT)
    if tags.whole(_IMAGE_DEPTH, 1) != 1:
        raise Refused("expected a flat picture, got one of several layers")
    bits = tags.whole(_BITS, 1)
    channels, planes = tags.whole(_CHANNELS, 1), tags.whole(_PLANES, 1)
    pixel = channels * -(-bits // 8)
    # Tiled pictures are read tile by tile, and a tile may exceed the picture.
    tile = tags.whole(_TILE_WIDTH) * tags.whole(_TILE_HEIGHT)
    room(width, height, pixel * (1 + tile / max(width * height, 1)))
    # 1 is grey with 0 as black, 2 is RGB; others are inverted grey, palettes, …
    photometric = tags.whole(_PHOTOMETRIC, -1)
    if photometric not in (1, 2):
        raise Refused(f"expected photometric interpretation 1 or 2, got {photometric}")
    if channels > 4:
        raise Refused(f"expected at most 4 channels, got {channels}")
    numbers = imagecodecs.tiff_decode(data)
    # Planar configuration 2: one plane a channel.
    numbers = np.moveaxis(numbers, 0, -1) if planes == 2 else numbers
    if channels in (2, 4) and tags.whole(_EXTRA) not in _ALPHA:
        if np.any(numbers[..., -1] != numbers.flat[-1]):
            raise Refused(
                f"expected alpha as its channel {channels}, got one of an unknown kind "
                "(ExtraSamples): save it without"
            )
        numbers = numbers[..., :-1]
    return numbers


# Bits of the subfile type: a copy of fewer pixels, and a mask. ExtraSamples of alpha.
_SUBFILE, _SMALLER, _NO_PICTURE = 254, 1, 1 | 4
_EXTRA, _ALPHA = 338, (1, 2)
_WIDTH, _HEIGHT, _BITS, _PHOTOMETRIC, _CHANNELS, _PLANES = 256, 257, 258, 262, 277, 284
_TILE_WIDTH, _TILE_HEIGHT, _IMAGE_DEPTH = 322, 323, 32997


def _read_hdr(data: bytes, _path: Path, room: Room) -> np.ndarray:
    header = radiance_header(data)
    size = re.match(rb"\s*-Y (\d{1,9}) \+X (\d{1,9})\n", data[len(header) :])
    if not data.startswith(b"#?") or size is None:
        raise ValueError("it does not start as a Radiance picture does")
    height, width = int(size[1]), int(size[2])
    room(width, height, 12)
    if re.search(rb"^FORMAT\s*=\s*32-bit_rle_xyze", header, re.MULTILINE):
        # Its unit of light and its white depend on the program that wrote it.
        raise Refused("expected red, green and blue, got XYZ: convert it (ra_xyze -r)")
    # Pixels are radiance times the product of all factors in the header.
    factor = np.ones(3)
    for name, count in (("EXPOSURE", 1), ("COLORCORR", 3)):
        factor = factor * radiance_values(header, name, count).prod(axis=0)
        if not ((factor > 1e-30) & (factor < 1e30)).all():
            raise Refused(f"expected {name} > 0, got {factor.min():g}")
    numbers = np.empty((height, width, 3), np.float32)
    imagecodecs.rgbe_decode(data, out=numbers)
    numbers /= factor.astype(np.float32)
    return numbers


def radiance_header(data: bytes) -> bytes:
    """The lines before the size of a Radiance picture."""
    return data.partition(b"\n\n")[0]


def radiance_values(
    header: bytes, name: str, count: int
) -> Float[np.ndarray, "lines {count}"]:
    """Numbers of all lines with this name in a Radiance picture's header."""
    lines = re.findall(rf"^{name}\s*=(.*)$".encode(), header, re.MULTILINE)
    rows = [[float(word) for word in line.split()] for line in lines]
    if any(len(row) != count for row in rows):
        raise ValueError(f"{name}: expected {count} numbers")
    return np.array(rows).reshape(-1, count)


def _read_exr(data: bytes, path: Path, room: Room) -> np.ndarray:
    with silent_library():
        with OpenEXR.File(os.fspath(path), header_only=True) as file:
            header, parts = file.header(), len(file.parts)
            (left, top), (right, bottom) = header["dataWindow"]
            width, height = int(right) - int(left) + 1, int(bottom) - int(top) + 1
            found = {channel.name for channel in header["channels"]}
            points = header.get("chromaticities")
        if parts != 1:
            raise Refused(f"expected one part, got {parts}: save each as a file")
        # All channels are read, of four bytes, and then copied.
        room(width, height, 8 * len(found))
        orders = [names for names in ("RGB", "RGBA", "Y", "YA") if set(names) == found]
        if not orders:
            got = ", ".join(sorted(found)[:8])
            raise Refused(f"expected channels R, G, B or Y, got {got}")
        with OpenEXR.File(os.fspath(path), separate_channels=True) as file:
            channels = {k: v.pixels for k, v in file.channels().items()}
    # The library reads the file again by name, so its bytes are compared.
    if path.read_bytes() != data:
        raise Refused("changed while it was read")
    numbers = np.stack([channels[name] for name in orders[0]], axis=-1)
    if points is not None and _is_xyz(points) and "R" in found:
        numbers = numbers / np.array([*_XYZ_WHITE, 1], np.float32)[: len(found)]
    return numbers


def exr_primaries(path: Path) -> tuple[float, ...] | None:
    """x and y of red, green, blue and white, where an EXR file's header states them.

    Pixels in XYZ are read relative to the white of sRGB, since XYZ has none.
    """
    with silent_library(), OpenEXR.File(os.fspath(path), header_only=True) as file:
        points = file.header().get("chromaticities")
    if points is not None and _is_xyz(points):
        return (*points[:6], *_D65)
    return points


# White of sRGB: x and y, and X, Y and Z.
_D65 = 0.3127, 0.3290
_XYZ_WHITE = _D65[0] / _D65[1], 1.0, (1 - sum(_D65)) / _D65[1]


def _is_xyz(points: tuple[float, ...]) -> bool:
    return bool(np.allclose(points[:6], (1, 0, 0, 1, 0, 0)))


# Lock, since all threads share the process's error output.
_silence = threading.Lock()


@contextlib.contextmanager
def silent_library() -> Iterator[None]:
    """Silence libraries that print their errors, which they also raise."""
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
"""Function from a file's bytes, its path and a memory check to its numbers."""

READERS: dict[str, Reader] = {
    ".png": _read_png,
    ".jpg": _read_jpeg,
    ".jpeg": _read_jpeg,
    ".tif": _read_tiff,
    ".tiff": _read_tiff,
    ".hdr": _read_hdr,
    ".exr": _read_exr,
}

_STARTS = {
    PNG_START: ".png",
    JPEG_START: ".jpg",
    b"II*\0": ".tif",
    b"MM\0*": ".tif",
    b"II+\0": ".tif",
    b"MM\0+": ".tif",
    b"#?": ".hdr",
    b"v/1\x01": ".exr",
    b"GIF8": ".gif",
    b"BM": ".bmp",
    b"RIFF": ".webp",
    b"8BPS": ".psd",
}
_NOT_READ = {".gif": "GIF", ".bmp": "BMP", ".webp": "WebP", ".psd": "Photoshop"}


def format_of(data: bytes, path: Path, readers: Mapping[str, Reader] = READERS) -> str:
    """The suffix of an image's format, from its first bytes, not from its name.

    If the bytes match no known format, the file's suffix: for RAW photographs, many of
    which start like a TIFF, and for broken files.

    **Raises:** `Refused` that names a well-known format without one of `readers`.
    """
    suffix = path.suffix.lower()
    format = next((_STARTS[k] for k in _STARTS if data.startswith(k)), "")
    # CR3, a RAW format, starts the same way, so the suffix decides.
    iso_media = data[4:8] == b"ftyp" and suffix in readers
    kind = "HEIF or AVIF" if iso_media else _NOT_READ.get(format)
    if kind and format not in readers:
        raise Refused(f"is a {kind} image: convert it to PNG or TIFF")
    return (
        suffix if not format or suffix not in readers and format == ".tif" else format
    )


# Writing.


def encode_png(numbers: np.ndarray) -> bytes:
    """A PNG file of (H, W, channels) whole numbers of 8 or 16 bits."""
    return bytes(imagecodecs.png_encode(np.ascontiguousarray(numbers)))


def encode_webp(numbers: np.ndarray) -> bytes:
    """A lossless WebP file of (H, W, 3) whole numbers of 8 bits: smaller than a PNG."""
    pixels = np.ascontiguousarray(numbers, np.uint8)
    return bytes(imagecodecs.webp_encode(pixels, lossless=True, level=75))


def data_uri(picture: bytes, kind: str = "png") -> str:
    """A data URI that holds a picture's file."""
    return f"data:image/{kind};base64,{base64.b64encode(picture).decode('ascii')}"


def _write_png(path: Path, numbers: np.ndarray) -> None:
    path.write_bytes(encode_png(numbers))


def _write_jpeg(path: Path, numbers: np.ndarray) -> None:
    # Without subsampling, which would blur colours between pixels.
    iio.imwrite(path, numbers, plugin="pillow", quality=95, subsampling=0)


def _write_tiff(path: Path, numbers: np.ndarray) -> None:
    path.write_bytes(imagecodecs.tiff_encode(numbers, photometric="rgb"))


def _write_hdr(path: Path, numbers: np.ndarray) -> None:
    # The format has no sign.
    path.write_bytes(imagecodecs.rgbe_encode(np.maximum(numbers, 0), header=True))


def _write_exr(path: Path, numbers: np.ndarray) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    try:
        with OpenEXR.File(header, {"RGB": numbers}) as file:
            file.write(os.fspath(path))
    except RuntimeError as error:
        # OpenEXR reports a full disk by a message only, without an error number.
        raise OSError(errno.EIO, str(error).rpartition('". ')[2]) from error


def _read_picture(data: bytes, _path: Path, room: Room) -> np.ndarray:
    """Grey, RGB or RGBA numbers of a picture, from palettes and CMYK as well."""
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
"""Readers of textures, for more formats than those of photographs."""

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
