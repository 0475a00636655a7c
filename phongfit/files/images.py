"""Images on disk: read as linear light, written in a stated encoding."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, UInt

from phongfit.checks import as_array
from phongfit.edge import checked
from phongfit.files.budget import afford
from phongfit.files.formats import (
    READERS,
    WRITERS,
    Refused,
    Room,
    jpeg_compression,
)
from phongfit.files.inputs import read_bytes, reason
from phongfit.files.outputs import check_file, replacing
from phongfit.rendering.film import Encoding, Film, as_encoding, decode, encode

T = TypeVar("T")

Bits = Literal[8, 16, 32]
"""A channel's size in a file; 32 is a floating-point number."""


@checked
def read_image(
    path: str | os.PathLike[str],
    encoding: Encoding,
    *,
    max_pixels: int | None = None,
) -> Float[np.ndarray, "height width 3"]:
    """An image as linear light, where 1 is the largest number of an integer format.

    PNG and TIFF of 8 and 16 bits, JPEG, floating-point TIFF, Radiance HDR and EXR.
    Grey becomes three equal channels. An EXIF rotation is not applied.

    **Arguments:**

    - `path`: the suffix tells the format.
    - `encoding`: `"linear"` or `"srgb"`: what the numbers in the file are. A fit in the
        wrong one is wrong, so it is never guessed. Floating-point formats are linear.
    - `max_pixels`: images with more are refused before they are decoded: a small file
        can hold an image that fills the memory. Default: what one file may take of it
        (1 GB, or `PHONGFIT_MAX_MEMORY`), which is some 50 million pixels.

    **Raises:** `ValueError` that names the file: it is missing, broken, of an unknown
    format, too large, partly transparent, or holds NaN or infinity.
    """
    path = Path(path)
    encoding = as_encoding(encoding)
    numbers = _opaque(path, _read_numbers(path, max_pixels))
    if numbers.dtype.kind == "f":
        if encoding != "linear":
            raise ValueError(
                f"{path}: expected encoding 'linear', as floating-point images have, "
                f"got {encoding!r}"
            )
        image = numbers.astype(_float_type(), copy=False)
        if not np.isfinite(image).all():
            raise ValueError(f"{path}: has NaN or infinite pixels")
    else:
        image = from_levels(numbers, encoding)
    if image.shape[-1] == 1:
        return np.repeat(image, 3, axis=-1)
    return np.ascontiguousarray(image)


@checked
def read_film(path: str | os.PathLike[str], encoding: Encoding) -> Film:
    """How light became the numbers of an image file, for [`fit`][].

        image = pf.read_image("ball.jpg", "srgb")
        fit = pf.fit(scene, image, film=pf.read_film("ball.jpg", "srgb"))

    A JPEG file says what it rounds. For the photograph as it lies in the file alone:
    one that was cropped, rotated or shrunk has other blocks. Leave pixels out by a
    mask, and fit all of the camera's.

    **Arguments:** as of [`read_image`][].

    **Raises:** `ValueError` that names the file, as [`read_image`][] does.
    """
    path = Path(path)
    film = Film(encoding=as_encoding(encoding))
    if path.suffix.lower() in JPEG:
        return with_jpeg(film, path)
    numbers = _read_numbers(path)
    if numbers.dtype.kind == "f":
        return Film(clamp=False)
    return Film(encoding=film.encoding, bits=8 * numbers.dtype.itemsize)


JPEG = (".jpg", ".jpeg")


def with_jpeg(film: Film, path: Path) -> Film:
    """A film that clamps with what a file of it rounds besides, if that is a JPEG.

    **Raises:** `ValueError` that names the file.
    """
    if path.suffix.lower() not in JPEG or not film.clamp:
        return film
    return Film(encoding=film.encoding, jpeg=_decoded(path, jpeg_compression))


def read_mask(
    path: str | os.PathLike[str], *, max_pixels: int | None = None
) -> Bool[np.ndarray, "height width"]:
    """A mask from an image: true where it is nearer to its brightest grey than to 0.

    **Arguments:** `max_pixels`: as of [`read_image`][].

    **Raises:** `ValueError` that names the file, as in [`read_image`][].
    """
    # Relative to the brightest, since masks of 0 and 1 are as common as 0 and 255.
    path = Path(path)
    grey = _opaque(path, _read_numbers(path, max_pixels)).max(axis=-1)
    return grey > grey.max() / 2


@checked
def write_image(
    path: str | os.PathLike[str],
    image: Any,
    encoding: Encoding,
    bits: Bits | None = None,
) -> None:
    """Write linear light to a file, in one piece.

    **Arguments:**

    - `path`: the suffix tells the format: `.png` (8, 16 bits), `.jpg` (8), `.tif` (8,
        16, 32), `.hdr` (32), `.exr` (32).
    - `image`: (H, W, 3), or (H, W) for grey, linear.
    - `encoding`: `"linear"` or `"srgb"`; it must be told again when the file is read.
    - `bits`: per channel; default the fewest that the format has. 8 and 16 cut off
        what is below 0 or above 1; 32 is floating-point, linear and not cut off.

    **Raises:** `ValueError` that names the file or the argument, `OSError` if the file
    cannot be written.
    """
    path = Path(path)
    depth = check_image(path, encoding, bits)
    light = _as_image(path, image)
    if depth == 32:
        numbers = light.astype(np.float32)
    else:
        numbers = to_levels(light, encoding, depth)
    with replacing(path) as temporary:
        WRITERS[path.suffix.lower()][depth](temporary, numbers)


def check_image(path: Path, encoding: Encoding, bits: Bits | None = None) -> int:
    """Could an image be written here, like this? Asked before what takes long.

    **Arguments:** as of [`write_image`][].

    **Returns:** bits per channel that the file will have.

    **Raises:** `ValueError` and `OSError` as [`write_image`][] does.
    """
    check_file(path)
    writers = WRITERS.get(path.suffix.lower())
    if writers is None:
        raise ValueError(f"{path}: {_wanted_suffix(path, WRITERS)}")
    depth = min(writers) if bits is None else bits
    if depth not in writers:
        depths = " or ".join(str(known) for known in writers)
        raise ValueError(f"{path}: bits: expected {depths}, got {depth!r}")
    if as_encoding(encoding) != "linear" and depth == 32:
        raise ValueError(
            f"{path}: expected encoding 'linear', as floating-point images have, "
            f"got {encoding!r}"
        )
    return depth


def to_levels(
    light: Float[Any, "..."], encoding: Encoding, bits: int
) -> UInt[np.ndarray, "..."]:
    """Linear light, of any shape, as the whole numbers of 8 or 16 bits in a file."""
    # In double precision: the curve of sRGB has to give all 65536 levels back.
    with jax.enable_x64(True):
        shown = jnp.clip(jnp.asarray(np.asarray(light, np.float64)), 0, 1)
        levels = jnp.round(encode(shown, as_encoding(encoding)) * (2**bits - 1))
        return np.asarray(levels).astype(np.uint8 if bits == 8 else np.uint16)


def from_levels(
    levels: UInt[np.ndarray, "..."], encoding: Encoding
) -> Float[np.ndarray, "..."]:
    """The whole numbers of an image file as linear light: the inverse of the above."""
    highest = np.iinfo(levels.dtype).max
    # A table, since there are fewer levels than pixels.
    with jax.enable_x64(True):
        encoded = jnp.asarray(np.arange(highest + 1) / highest)
        table = np.asarray(decode(encoded, as_encoding(encoding)))
    table = table.astype(_float_type())
    light = np.empty(levels.shape, table.dtype)
    # Piece by piece, since NumPy looks up in a copy of eight bytes a number.
    rows = max(2**20 // max(levels[:1].size, 1), 1)
    for start in range(0, len(levels), rows):
        light[start : start + rows] = table[levels[start : start + rows]]
    return light


def _float_type() -> np.dtype:
    return np.dtype(jnp.result_type(float))


def _wanted_suffix(path: Path, known: Any) -> str:
    came = f"suffix {path.suffix!r}" if path.suffix else "no suffix"
    return f"expected one of {' '.join(known)}, got {came}"


def _as_image(path: Path, image: Any) -> np.ndarray:
    light = as_array("image", image)
    if light.dtype.kind not in "bfiu":
        raise ValueError(f"{path}: expected an image of numbers, got {light.dtype}")
    if light.ndim == 2:
        light = np.stack([light] * 3, axis=-1)
    if light.ndim != 3 or light.shape[-1] != 3 or 0 in light.shape:
        raise ValueError(
            f"{path}: expected an image (height, width, 3), got shape {light.shape}"
        )
    light = light.astype(np.float64)
    if not np.isfinite(light).all():
        raise ValueError(f"{path}: the image has NaN or infinite pixels")
    return light


def _read_numbers(path: Path, max_pixels: int | None = None) -> np.ndarray:
    """What stands in the file: (H, W, channels), whole numbers or floats."""
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise ValueError(f"{path}: {_wanted_suffix(path, READERS)}")
    numbers = _decoded(path, lambda data: reader(data, path, _room(data, max_pixels)))
    numbers = numbers[..., None] if numbers.ndim == 2 else numbers
    if numbers.ndim != 3 or 0 in numbers.shape:
        raise ValueError(f"{path}: expected one image, got shape {numbers.shape}")
    if numbers.dtype not in (np.uint8, np.uint16) and numbers.dtype.kind != "f":
        raise ValueError(
            f"{path}: expected samples of uint8, uint16 or floats, got {numbers.dtype}"
        )
    return numbers


def _room(data: bytes, max_pixels: int | None) -> Room:
    """Asks for room beside the bytes of a file, which are there already."""

    def ask(width: int, height: int, pixel: float) -> None:
        pixels = width * height
        if max_pixels is not None and pixels > max_pixels:
            raise Refused(
                f"expected at most {max_pixels} pixels, got {width} × {height}; a "
                "smaller copy will do"
            )
        # First file and numbers are there, then numbers and light.
        light = 3 * pixels * _float_type().itemsize
        size = int(pixels * pixel) + max(len(data), light)
        try:
            if max_pixels is None:
                afford(size, f"{width} × {height} pixels")
        except ValueError as error:
            raise Refused(str(error)) from None

    return ask


def _decoded(path: Path, decode: Callable[[bytes], T]) -> T:
    """What is made of a file's bytes; what goes wrong names the file."""
    data = read_bytes(path)
    try:
        return decode(data)
    except Refused as error:
        raise ValueError(f"{path}: {error}") from None
    except MemoryError:
        raise
    except Exception as error:
        # Decoders raise whatever they like for what is broken, SyntaxError included.
        raise ValueError(
            f"{path}: is broken or no {path.suffix} image: {reason(error)}"
        ) from error


def _opaque(path: Path, numbers: np.ndarray) -> np.ndarray:
    """Without its alpha channel, which must not matter."""
    channels = numbers.shape[-1]
    if channels not in (1, 2, 3, 4):
        raise ValueError(
            f"{path}: expected 1 or 3 channels, or these and alpha, got {channels}"
        )
    if channels in (1, 3):
        return numbers
    highest = 1 if numbers.dtype.kind == "f" else np.iinfo(numbers.dtype).max
    if not (numbers[..., -1] == highest).all():
        raise ValueError(
            f"{path}: expected an opaque image, got a partly transparent one: what "
            "lies behind is unknown; leave pixels out with a mask"
        )
    return numbers[..., :-1]
