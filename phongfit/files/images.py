"""Images on disk: read as linear light, written in a stated encoding."""

import contextlib
import functools
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, UInt

from phongfit.checks import as_array
from phongfit.codes import warn
from phongfit.edge import checked
from phongfit.files.budget import afford
from phongfit.files.coded import Coded
from phongfit.files.formats import (
    JPEG_START,
    READERS,
    TEXTURE_READERS,
    WRITERS,
    Refused,
    Room,
    format_of,
    jpeg_compression,
    opened_jpeg,
)
from phongfit.files.inputs import naming, read_bytes, reason
from phongfit.files.metadata import TURNS, Exposure, Metadata, read_metadata
from phongfit.files.outputs import check_file, replacing
from phongfit.files.profiles import Profile, find_profile, saturated
from phongfit.files.raw import RAW, read_raw, read_raw_head
from phongfit.rendering.film import (
    Encoding,
    Film,
    NamedEncoding,
    as_encoding,
    decode,
    encode,
)
from phongfit.rendering.jpeg import JpegCompression

SUFFIXES = (*READERS, *RAW)
"""Suffixes of files from which images are read."""

Bits = Literal[8, 16, 32]
"""Bits of a channel in a file; 32 is floating-point."""


@checked
def read_image(
    path: str | os.PathLike[str],
    encoding: Encoding,
    *,
    white: int | None = None,
    max_pixels: int | None = None,
) -> Float[np.ndarray, "height width 3"]:
    """An image as linear light, where 1 is the largest number of an integer format.

    PNG and TIFF of 8 and 16 bits, JPEG, floating-point TIFF, Radiance HDR and EXR; RAW
    photographs with `phongfit[raw]`. Grey becomes three equal channels. Images are
    turned upright by their EXIF orientation.

    Colours are those of sRGB. Other colours are converted: of another ICC profile, such
    as Display P3, of Adobe RGB by EXIF data, and of primaries that an EXR or Radiance
    file states. A profile that contradicts `encoding` is an error, and so is a PNG with
    a linear gAMA chunk if `encoding` is `"srgb"`. A gAMA chunk of sRGB is ignored if
    `encoding` is `"linear"`, since many programs write it into every PNG. A PNG of
    other primaries without a profile (cHRM, cICP) is an error.

    **Arguments:**

    - `path`: the first bytes determine the format, and the suffix if it is RAW.
    - `encoding`: of the numbers in the file: `"linear"`, `"srgb"` or a
        [`ResponseCurve`][]. It is never guessed, since a wrong one makes a fit wrong.
        Floating-point formats and RAW are linear. With a profile, `"srgb"` means the
        profile's curve.
    - `white`: the number that is white in a PNG or TIFF of whole numbers; larger ones
        are white as well. For example 4095 for a camera's 12 bits in a file of 16.
        Default: the largest number of the format.
    - `max_pixels`: larger images are refused before they are decoded: a small file can
        hold an image that fills the memory. Default: limited by the memory for one file
        (1 GB, or `PHONGFIT_MAX_MEMORY`), which is enough for some 50 million pixels.

    **Raises:** `ValueError` that names the file: it is missing, broken, of an unknown
    format, too large, partly transparent ([`read_photograph`][] masks such pixels), of
    unsupported colours, of several pictures, or holds NaN or infinity. `ValueError`
    that names `white`, if the format lacks that number.

    **Warns:** if EXIF data is broken; and if a channel is saturated in a file whose
    profile mixes channels, so that the others are wrong: [`read_photograph`][] has a
    mask of such pixels.
    """
    return read_opaque(path, encoding, white=white, max_pixels=max_pixels).image


def read_opaque(
    path: str | os.PathLike[str],
    encoding: Encoding,
    *,
    white: int | None = None,
    max_pixels: int | None = None,
) -> "Photo":
    """Read like [`read_image`][], which describes arguments, errors and warnings."""
    light = read_light(path, encoding, white=white, max_pixels=max_pixels, opaque=True)
    lost = np.count_nonzero(~light.usable)
    if lost:
        warn(
            "saturated",
            f"{path}: {lost} pixels are saturated, which changes all channels when its "
            "colours become those of sRGB",
            stacklevel=3,
        )
    return light


@dataclass(frozen=True)
class Photo:
    """A photograph: upright linear light with the primaries of sRGB.

    - `path`: its file.
    - `encoding`: of its numbers.
    - `white`: as in [`read_image`][].
    - `coded`: light in the file's encoding; white and saturated samples are 1.
    - `usable`: false where the file's alpha is less than 1, and where a saturated
        channel was mixed into others in the conversion to sRGB.
    - `clamped`: true if the format ends at white; false for floating-point images.
    - `exposure`: as the camera recorded it.
    - `relative_exposure`: exposure relative to the first photograph of its series; 1
        for a single one.
    """

    path: Path
    encoding: Encoding
    coded: Coded
    usable: Bool[np.ndarray, "height width"]
    clamped: bool
    exposure: Exposure = Exposure()
    relative_exposure: float = 1.0
    white: int | None = None

    @property
    def name(self) -> str:
        """Name of the file."""
        return self.path.name

    @functools.cached_property
    def image(self) -> Float[np.ndarray, "height width 3"]:
        """The decoded linear light."""
        return self.coded.light

    @property
    def film(self) -> Film:
        """The film of the file: see [`read_film`][]."""
        return read_film(self.path, self.encoding, white=self.white)

    @property
    def unsaturated(self) -> Bool[np.ndarray, "height width 3"]:
        """Mask of samples that are neither cut off at white nor mixed with others."""
        usable = np.broadcast_to(self.usable[..., None], self.image.shape)
        return usable & (self.image < 1) if self.clamped else usable.copy()

    @property
    def common_light(self) -> Float[np.ndarray, "height width 3"]:
        """The image scaled to the exposure of the first photograph of its series.

        White is then 1 / `relative_exposure`: use `unsaturated` to find valid samples.
        To keep images as they are, multiply the lights of their scenes instead, and the
        ambient light, by `relative_exposure`.
        """
        return self.image / np.asarray(self.relative_exposure, self.image.dtype)


def read_light(
    path: str | os.PathLike[str],
    encoding: Encoding,
    *,
    white: int | None = None,
    max_pixels: int | None = None,
    opaque: bool = False,
) -> Photo:
    """Read an image like [`read_image`][], but return a mask instead of a warning.

    The mask is false where a saturated channel was mixed into others, and where alpha
    is less than 1: the background may be mixed in there, and the light is set to 0.

    **Arguments:** `opaque`: raise an error if any alpha is less than 1.
    """
    path = Path(path)
    encoding = as_encoding(encoding)
    read = _read_numbers(path, max_pixels)
    remedy = "read_photograph masks such pixels, and commands leave them out"
    values, solid = _without_alpha(path, read.values, remedy if opaque else None)
    values = _to_white(path, values, white)
    if read.linear and encoding != "linear":
        raise ValueError(
            f"{path}: expected encoding 'linear', as {read.linear} have, got "
            f"{encoding!r}"
        )
    with naming(str(path)):
        profile = find_profile(read.metadata.profile, encoding)
        coded = _coded(values, encoding, profile)
    if values.dtype.kind == "f" and not np.isfinite(coded.numbers).all():
        raise ValueError(f"{path}: has NaN or infinite pixels")
    usable = np.ascontiguousarray(read.usable & solid)
    if profile is not None and profile.mixes and values.shape[-1] == 3:
        usable &= ~saturated(values)
    numbers = coded.numbers
    grey = numbers.shape[-1] == 1
    numbers = np.repeat(numbers, 3, axis=-1) if grey else np.ascontiguousarray(numbers)
    clamped = values.dtype.kind != "f"
    coded = Coded(numbers, coded.table)
    exposure = read.metadata.exposure
    return Photo(path, encoding, coded, usable, clamped, exposure, white=white)


def _to_white(path: Path, values: np.ndarray, white: int | None) -> np.ndarray:
    """Numbers of a file, scaled so that white is the largest number of 16 bits.

    **Raises:** `ValueError` that names the file and `white`.
    """
    if white is None:
        return values
    if values.dtype.kind == "f" or _is_jpeg(path):
        raise ValueError(
            f"{path}: white: expected it of a PNG or TIFF of whole numbers alone, got "
            f"{white}"
        )
    highest = np.iinfo(values.dtype).max
    if not 1 <= white <= highest:
        raise ValueError(f"{path}: white: expected 1 … {highest}, got {white}")
    levels = np.minimum(np.arange(highest + 1) / white, 1) * np.iinfo(np.uint16).max
    return np.round(levels).astype(np.uint16)[values]


def _coded(values: np.ndarray, encoding: Encoding, profile: Profile | None) -> Coded:
    if profile is not None:
        return Coded(profile.light(values, _float_type()))
    if values.dtype.kind == "f":
        return Coded(values.astype(_float_type(), copy=False))
    return Coded(values, level_table(values.dtype, encoding))


@checked
def read_film(
    path: str | os.PathLike[str], encoding: Encoding, *, white: int | None = None
) -> Film:
    """The film of an image file: its clamp, encoding and rounding, for [`fit`][].

        image = pf.read_image("ball.jpg", "srgb")
        fit = pf.fit(scene, image, film=pf.read_film("ball.jpg", "srgb"))

    The header of a JPEG file states its quantisation, which is turned with the image by
    the EXIF orientation. The film holds only for the whole, unchanged photograph: a
    cropped, rotated or shrunk one has other blocks. So fit the camera's whole image,
    and exclude pixels by a mask. Colours of another profile than sRGB are treated as
    sRGB in a JPEG film; in other formats their rounding is left out, since the
    conversion leaves no whole levels.

    **Arguments:** as in [`read_image`][].

    **Raises:** `ValueError` that names the file, as [`read_image`][] does.

    **Warns:** if a JPEG was turned and its blocks begin outside of the image: the
    quantisation is then left out.
    """
    path = Path(path)
    film = Film(encoding=as_encoding(encoding))
    if _is_jpeg(path):
        return with_jpeg(film, path)
    read = _read_numbers(path)
    if read.values.dtype.kind == "f":
        return Film(clamp=False)
    with naming(str(path)):
        converted = find_profile(read.metadata.profile, film.encoding) is not None
    if converted or read.linear:
        return film
    bits = 8 * read.values.dtype.itemsize
    # Rounded down to whole bits: the number of levels affects only standard errors.
    bits = bits if white is None else int(np.log2(white + 1))
    return Film(encoding=film.encoding, bits=bits)


def _is_jpeg(path: Path) -> bool:
    """True if a file exists and starts like a JPEG."""
    if not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            return file.read(len(JPEG_START)) == JPEG_START
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error


def with_jpeg(film: Film, path: Path) -> Film:
    """A film with the quantisation of a file, if the file is a JPEG and `film` clamps.

    **Raises:** `ValueError` that names the file.
    """
    if not film.clamp or not _is_jpeg(path):
        return film
    data = read_bytes(path)
    with _decoding(path):
        with opened_jpeg(data) as image:
            size = image.size
        jpeg = jpeg_compression(data)
        orientation = read_metadata(data, path).orientation
    turned = _turned(jpeg, size, orientation)
    if turned is None:
        warn(
            "jpeg-turned",
            f"{path}: its orientation (EXIF) turns blocks of {jpeg.block[1]} × "
            f"{jpeg.block[0]} pixels, which do not fill {size[0]} × {size[1]}: what "
            "JPEG lost is left out, and errors may be too small",
            stacklevel=3,
        )
        return Film(encoding=film.encoding, bits=8)
    return Film(encoding=film.encoding, jpeg=turned)


def _turned(
    jpeg: JpegCompression, size: tuple[int, int], orientation: int
) -> JpegCompression | None:
    """The quantisation of the upright image, or `None` if its blocks do not fit.

    Cosines are even or odd about a block's middle, so mirrored blocks are rounded in
    the same way; but the first block must begin at the image's corner.
    """
    down, across, exchanged = TURNS[orientation]
    (width, height), (rows, columns) = size, jpeg.block
    if (down and height % rows) or (across and width % columns):
        return None
    return jpeg.transposed if exchanged else jpeg


@checked
def read_mask(
    path: str | os.PathLike[str], *, max_pixels: int | None = None
) -> Bool[np.ndarray, "height width"]:
    """A mask from an image: true where it is nearer to its brightest grey than to 0.

    Turned upright, like images of [`read_image`][].

    **Arguments:** `max_pixels`: as in [`read_image`][].

    **Raises:** `ValueError` that names the file, as in [`read_image`][].
    """
    # Relative to the brightest, since masks of 0 and 1 are as common as 0 and 255.
    path = Path(path)
    numbers = _read_numbers(path, max_pixels).values
    grey = _without_alpha(path, numbers, "save it without alpha")[0].max(axis=-1)
    return grey > grey.max() / 2


@checked
def write_image(
    path: str | os.PathLike[str],
    image: Any,
    encoding: Encoding,
    bits: Bits | None = None,
) -> None:
    """Write linear light to a file, whole or not at all.

    **Arguments:**

    - `path`: the suffix determines the format: `.png` (8, 16 bits), `.jpg` (8), `.tif`
        (8, 16, 32), `.hdr` (32), `.exr` (32).
    - `image`: (H, W, 3), or (H, W) for grey, linear.
    - `encoding`: `"linear"`, `"srgb"` or a [`ResponseCurve`][]; reading the file needs
        this argument again.
    - `bits`: per channel; default the fewest that the format has. 8 and 16 clip light
        to [0, 1]; 32 is floating-point, linear and not clipped.

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
    """Check that an image could be written, before a long computation.

    **Arguments:** as in [`write_image`][].

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
    # Double precision, so that all 65536 sRGB levels survive decoding and encoding.
    shown = np.clip(np.asarray(light, np.float64), 0, 1)
    levels = np.round(encode(shown, as_encoding(encoding)) * (2**bits - 1))
    return levels.astype(np.uint8 if bits == 8 else np.uint16)


def from_levels(
    levels: UInt[np.ndarray, "..."], encoding: Encoding
) -> Float[np.ndarray, "..."]:
    """Linear light from the whole numbers of an image file, inverse of `to_levels`."""
    return Coded(levels, level_table(levels.dtype, encoding)).light


def level_table(dtype: Any, encoding: Encoding) -> Float[np.ndarray, " levels"]:
    """The light of each whole number of 8 or 16 bits, a table shorter than an image."""
    highest = np.iinfo(dtype).max
    encoded = np.arange(highest + 1) / highest
    return decode(encoded, as_encoding(encoding)).astype(_float_type())


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


class Texels(NamedTuple):
    """Numbers of a texture, (H, W, 3 or 1), and alpha from 0 to 1 if it has any."""

    values: Float[np.ndarray, "rows columns channels"]
    alpha: Float[np.ndarray, "rows columns 1"] | None

    @property
    def transparent(self) -> bool:
        """True if the alpha of any texel is below 1."""
        return self.alpha is not None and bool(np.any(self.alpha < 1))


def read_texels(data: bytes, path: Path, encoding: NamedEncoding) -> Texels:
    """A texture from the bytes of an image file.

    Colour profiles and gamma in the file are ignored, as in renderers: the purpose of a
    texture determines its encoding.

    **Arguments:** `path`: source of the bytes; its suffix determines the format, unless
    the bytes do.

    **Raises:** `ValueError` that names `path`.
    """
    with _decoding(path):
        format = format_of(data, path, TEXTURE_READERS)
        if format not in TEXTURE_READERS:
            raise Refused(_wanted_suffix(path, TEXTURE_READERS))
        numbers = _one_image(TEXTURE_READERS[format](data, path, _room(data, None)))
    alpha = None
    if numbers.shape[-1] in (2, 4):
        alpha = (numbers[..., -1:] / _highest(numbers)).astype(_float_type())
        numbers = numbers[..., :-1]
    values = _coded(numbers, encoding, None).light
    if not np.isfinite(values).all():
        raise ValueError(f"{path}: has NaN or infinite pixels")
    return Texels(values, alpha)


class Head(NamedTuple):
    """Metadata of a photograph's file, read without decoding pixels.

    - `size`: (width, height), upright.
    - `exposure`: as the camera recorded it.
    - `white_balance`: factors of a RAW file's red and blue.
    - `fov`: angle of view from the lower to the upper edge, degrees, if it is stated.
    - `turned`: true if the EXIF orientation is not upright.
    """

    size: tuple[int, int]
    exposure: Exposure
    white_balance: tuple[float, float] | None
    fov: float | None = None
    turned: bool = False


def read_head(path: Path) -> Head:
    """Metadata of a photograph's file.

    **Raises:** `ValueError` that names the file.
    """
    data = _bytes_of_image(path)
    with _decoding(path):
        if format_of(data, path) in RAW:
            return Head(*read_raw_head(data, path))
        metadata = read_metadata(data, path)
        width, height = _size(data, path)
        if TURNS[metadata.orientation][2]:
            width, height = height, width
        fov = metadata.lens.fov(width, height)
        turned = metadata.orientation != 1
        return Head((width, height), metadata.exposure, None, fov, turned)


class _Sized(Exception):
    """Carries width and height out of a reader before it decodes."""


def _size(data: bytes, path: Path) -> tuple[int, int]:
    """Width and height in the file, from the memory check of its reader."""

    def room(width: int, height: int, pixel: float) -> None:
        del pixel
        raise _Sized(width, height)

    try:
        READERS[format_of(data, path)](data, path, room)
    except _Sized as found:
        return found.args
    raise ValueError("it has no size")


class _Numbers(NamedTuple):
    """Numbers of an image file, upright.

    - `values`: (H, W, channels), whole numbers or floats.
    - `usable`: (H, W).
    - `linear`: name of the kind of image, if that kind is always linear; else empty.
    """

    values: np.ndarray
    usable: np.ndarray
    metadata: Metadata
    linear: str


def _read_numbers(path: Path, max_pixels: int | None = None) -> _Numbers:
    data = _bytes_of_image(path)
    with _decoding(path):
        room, format = _room(data, max_pixels), format_of(data, path)
        if format in RAW:
            raw = read_raw(data, path, room)
            metadata = Metadata(exposure=raw.exposure)
            return _Numbers(raw.numbers, raw.usable, metadata, "RAW photographs")
        values = _one_image(READERS[format](data, path, room))
        metadata = read_metadata(data, path)
    if metadata.broken:
        warn(
            "exif-broken",
            f"{path}: its EXIF data is broken ({metadata.broken}): it is taken as "
            "upright, and its exposure as unknown",
            stacklevel=4,
        )
    linear = ""
    if values.dtype.kind == "f":
        linear = "floating-point images"
    elif metadata.gamma is not None and abs(metadata.gamma - 1) < 0.01:
        linear = "PNGs whose gAMA chunk is 1"
    values = metadata.upright(values)
    return _Numbers(values, np.ones(values.shape[:2], bool), metadata, linear)


def _one_image(numbers: np.ndarray) -> np.ndarray:
    """Numbers of a decoded file as (H, W, channels).

    **Raises:** `Refused` for other shapes and types.
    """
    numbers = numbers[..., None] if numbers.ndim == 2 else numbers
    if numbers.ndim != 3 or 0 in numbers.shape:
        raise Refused(f"expected one image, got shape {numbers.shape}")
    if numbers.shape[-1] > 4:
        got = numbers.shape[-1]
        raise Refused(f"expected 1 or 3 channels, or these and alpha, got {got}")
    if numbers.dtype not in (np.uint8, np.uint16) and numbers.dtype.kind != "f":
        raise Refused(f"expected uint8, uint16 or floats, got {numbers.dtype}")
    return numbers


def _highest(numbers: np.ndarray) -> int:
    """The number that is white in a file's format."""
    return 1 if numbers.dtype.kind == "f" else np.iinfo(numbers.dtype).max


def _bytes_of_image(path: Path) -> bytes:
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{path}: {_wanted_suffix(path, SUFFIXES)}")
    return read_bytes(path)


def _room(data: bytes, max_pixels: int | None) -> Room:
    """A memory check for decoding, in addition to the file's bytes `data`."""

    def ask(width: int, height: int, pixel: float) -> None:
        pixels = width * height
        if max_pixels is not None and pixels > max_pixels:
            raise Refused(
                f"expected at most {max_pixels} pixels (max_pixels), got {width} × "
                f"{height}; a smaller copy will do"
            )
        # In memory at once: file and numbers, later numbers and light.
        light = 3 * pixels * _float_type().itemsize
        size = int(pixels * pixel) + max(len(data), light)
        try:
            if max_pixels is None:
                afford(size, f"{width} × {height} pixels")
        except ValueError as error:
            raise Refused(str(error)) from None

    return ask


@contextlib.contextmanager
def _decoding(path: Path) -> Iterator[None]:
    """Make errors of decoders name the file."""
    try:
        yield
    except Refused as error:
        raise ValueError(f"{path}: {error}") from None
    except MemoryError:
        raise
    except Exception as error:
        # Decoders raise any exception for broken files, even SyntaxError.
        raise ValueError(
            f"{path}: is broken or no {path.suffix} image: {reason(error)}"
        ) from error


def _without_alpha(
    path: Path, numbers: np.ndarray, remedy: str | None
) -> tuple[np.ndarray, Bool[np.ndarray, "height width"]]:
    """Numbers without their alpha channel, and a mask of alpha 1; 0 outside the mask.

    **Arguments:** `remedy`: advice for the error if the file must be opaque and is not;
    `None` if transparency is allowed.

    **Raises:** `ValueError` that names the file.
    """
    if numbers.shape[-1] in (1, 3):
        return numbers, np.ones(numbers.shape[:2], bool)
    solid = numbers[..., -1] >= _highest(numbers)
    if solid.all():
        return numbers[..., :-1], solid
    if remedy is not None:
        raise ValueError(
            f"{path}: expected an opaque image, got a partly transparent one: {remedy}"
        )
    # Colours of transparent pixels may be NaN.
    return np.where(solid[..., None], numbers[..., :-1], 0), solid
