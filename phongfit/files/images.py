"""Images on disk: read as linear light, written in a stated encoding."""

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

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
    PNG_START,
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

T = TypeVar("T")

SUFFIXES = (*READERS, *RAW)
"""Of the files that images are read from."""

Bits = Literal[8, 16, 32]
"""A channel's size in a file; 32 is a floating-point number."""


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
    photographs with `phongfit[raw]`. Grey becomes three equal channels. The image is
    upright, as its EXIF orientation says.

    Colours are those of sRGB. Those of another ICC profile, such as Display P3, of
    Adobe RGB by EXIF data, and of primaries that an EXR or Radiance file states, are
    converted. A profile that contradicts `encoding` is refused, and so is a PNG whose
    gAMA chunk says that it is linear where `encoding` is `"srgb"`. The other way round
    `encoding` is believed: many programs write sRGB's gAMA into every PNG. A PNG of
    other primaries without a profile (cHRM, cICP) is refused.

    **Arguments:**

    - `path`: the first bytes determine the format, and the suffix if it is RAW.
    - `encoding`: `"linear"`, `"srgb"` or a [`ResponseCurve`][]: what the numbers in the
        file are. A fit in the wrong one is wrong, so it is never guessed.
        Floating-point formats and RAW are linear. With a profile `"srgb"` stands for
        any curve that the profile tells.
    - `white`: the number in a PNG or TIFF of whole numbers that is white, and what lies
        above it, too: 4095 for a camera's 12 bits in a file of 16. Default: the largest
        of the format.
    - `max_pixels`: images with more are refused before they are decoded: a small file
        can hold an image that fills the memory. Default: what one file may take of it
        (1 GB, or `PHONGFIT_MAX_MEMORY`), which is some 50 million pixels.

    **Raises:** `ValueError` that names the file: it is missing, broken, of an unknown
    format, too large, partly transparent ([`read_photograph`][] masks such pixels), of
    colours that are not understood, of several pictures, or holds NaN or infinity. That
    names `white`, where the format does not have that number.

    **Warns:** where EXIF data is broken; and where a channel is saturated in a file
    whose profile mixes channels, so that the others are wrong: [`read_photograph`][]
    has a mask of such pixels.
    """
    light = read_light(path, encoding, white=white, max_pixels=max_pixels, opaque=True)
    lost = np.count_nonzero(~light.usable)
    if lost:
        warn(
            "saturated",
            f"{path}: {lost} pixels are saturated, which changes all channels when its "
            "colours become those of sRGB",
            stacklevel=2,
        )
    return light.image


class Light(NamedTuple):
    """Linear light of an image, as its file has it, where all of its channels can be
    believed, and whether the file's format ends at white."""

    coded: Coded
    usable: Bool[np.ndarray, "height width"]
    clamped: bool

    @property
    def image(self) -> Float[np.ndarray, "height width 3"]:
        """The light."""
        return self.coded.light


def read_light(
    path: str | os.PathLike[str],
    encoding: Encoding,
    *,
    white: int | None = None,
    max_pixels: int | None = None,
    opaque: bool = False,
) -> Light:
    """As [`read_image`][], with a mask instead of a warning.

    The mask is false where a saturated channel was mixed into others, and where alpha
    is less than 1: light from behind may be mixed in there, and the light is 0.

    **Arguments:** `opaque`: refuse pictures with such an alpha.
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
    with naming(str(path)), refusing():
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
    return Light(Coded(numbers, coded.table), usable, clamped)


def _to_white(path: Path, values: np.ndarray, white: int | None) -> np.ndarray:
    """Numbers of a file so that its white is the largest of 16 bits.

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
    """How light became the numbers of an image file, for [`fit`][].

        image = pf.read_image("ball.jpg", "srgb")
        fit = pf.fit(scene, image, film=pf.read_film("ball.jpg", "srgb"))

    A JPEG file says what it rounds; turned by its EXIF orientation it is turned with
    it. For the photograph as it lies in the file alone: one that was cropped, rotated
    or shrunk has other blocks. Leave pixels out by a mask, and fit all of the camera's.
    In colours other than those of sRGB its roundings are taken as if they were these;
    of other formats they are left out, since nothing in the image is a whole level.

    **Arguments:** as of [`read_image`][].

    **Raises:** `ValueError` that names the file, as [`read_image`][] does.

    **Warns:** where a JPEG was turned, and its blocks begin outside of the image: they
    are left out.
    """
    path = Path(path)
    film = Film(encoding=as_encoding(encoding))
    if _is_jpeg(path):
        return with_jpeg(film, path)
    read = _read_numbers(path)
    if read.values.dtype.kind == "f":
        return Film(clamp=False)
    with naming(str(path)), refusing():
        converted = find_profile(read.metadata.profile, film.encoding) is not None
    if converted or read.linear:
        return film
    bits = 8 * read.values.dtype.itemsize
    # Of as many levels as there are up to white, or a few less: only errors go by it.
    bits = bits if white is None else int(np.log2(white + 1))
    return Film(encoding=film.encoding, bits=bits)


def _is_jpeg(path: Path) -> bool:
    """Whether a file starts as a JPEG does; false where there is none."""
    if not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            return file.read(len(JPEG_START)) == JPEG_START
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error


def with_jpeg(film: Film, path: Path) -> Film:
    """A film that clamps with what a file of it rounds besides, if that is a JPEG.

    **Raises:** `ValueError` that names the file.
    """
    if not film.clamp or not _is_jpeg(path):
        return film
    jpeg, size, metadata = _decoded(path, _jpeg_head)
    turned = _turned(jpeg, size, metadata.orientation)
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


def _jpeg_head(data: bytes) -> tuple[JpegCompression, tuple[int, int], Metadata]:
    with opened_jpeg(data) as image:
        size = image.size
    return jpeg_compression(data), size, read_metadata(data, Path())


def _turned(
    jpeg: JpegCompression, size: tuple[int, int], orientation: int
) -> JpegCompression | None:
    """What the upright image of a file was rounded by; `None` if that is no JPEG.

    Cosines are even or odd about a block's middle, so that a mirrored block is rounded
    as it was; but blocks must begin where the image does.
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

    Upright, as [`read_image`][] gives what it is a mask of.

    **Arguments:** `max_pixels`: as of [`read_image`][].

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
    """Write linear light to a file, in one piece.

    **Arguments:**

    - `path`: the suffix tells the format: `.png` (8, 16 bits), `.jpg` (8), `.tif` (8,
        16, 32), `.hdr` (32), `.exr` (32).
    - `image`: (H, W, 3), or (H, W) for grey, linear.
    - `encoding`: `"linear"`, `"srgb"` or a [`ResponseCurve`][]; it must be told again
        when the file is read.
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
    shown = np.clip(np.asarray(light, np.float64), 0, 1)
    levels = np.round(encode(shown, as_encoding(encoding)) * (2**bits - 1))
    return levels.astype(np.uint8 if bits == 8 else np.uint16)


def from_levels(
    levels: UInt[np.ndarray, "..."], encoding: Encoding
) -> Float[np.ndarray, "..."]:
    """The whole numbers of an image file as linear light: the inverse of the above."""
    return Coded(levels, level_table(levels.dtype, encoding)).light


def level_table(dtype: Any, encoding: Encoding) -> Float[np.ndarray, " levels"]:
    """The light of each whole number of 8 or 16 bits: there are fewer than pixels."""
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
        """Whether any texel is less than opaque."""
        return self.alpha is not None and bool(np.any(self.alpha < 1))


def read_texels(data: bytes, path: Path, encoding: NamedEncoding) -> Texels:
    """A texture from the bytes of an image file.

    Whatever the file says of its colours is passed over, as renderers do: what the
    numbers are is a matter of what the texture is for.

    **Arguments:** `path`: where the bytes come from; its suffix tells the format of
    what is neither PNG nor JPEG.

    **Raises:** `ValueError` that names `path`.
    """
    suffix = path.suffix.lower()
    for start, format in ((PNG_START, ".png"), (b"\xff\xd8", ".jpg")):
        suffix = format if data.startswith(start) else suffix
    if suffix not in TEXTURE_READERS:
        raise ValueError(f"{path}: {_wanted_suffix(path, TEXTURE_READERS)}")

    numbers = _decoding(
        path, lambda data: TEXTURE_READERS[suffix](data, path, _room(data, None)), data
    )
    numbers = numbers[..., None] if numbers.ndim == 2 else numbers
    if numbers.ndim != 3 or 0 in numbers.shape or numbers.shape[-1] > 4:
        raise ValueError(f"{path}: expected one image, got shape {numbers.shape}")
    whole = numbers.dtype in (np.uint8, np.uint16)
    if not whole and numbers.dtype.kind != "f":
        raise ValueError(f"{path}: expected uint8, uint16 or floats")
    alpha = None
    if numbers.shape[-1] in (2, 4):
        highest = np.iinfo(numbers.dtype).max if whole else 1
        alpha = (numbers[..., -1:] / highest).astype(_float_type())
        numbers = numbers[..., :-1]
    values = from_levels(numbers, encoding) if whole else numbers.astype(_float_type())
    if not np.isfinite(values).all():
        raise ValueError(f"{path}: has NaN or infinite pixels")
    return Texels(values, alpha)


class Head(NamedTuple):
    """What a file says of its photograph before any pixel is decoded.

    - `size`: (width, height), upright.
    - `exposure`: as the camera says.
    - `white_balance`: what a RAW file's red and blue are multiplied by.
    - `fov`: angle of view from the lower to the upper edge, degrees, if it is stated.
    - `turned`: whether the image in the file is not upright, by EXIF's orientation.
    """

    size: tuple[int, int]
    exposure: Exposure
    white_balance: tuple[float, float] | None
    fov: float | None = None
    turned: bool = False


def read_head(path: Path) -> Head:
    """What a photograph's file says of it.

    **Raises:** `ValueError` that names the file.
    """
    _check_suffix(path)

    def head(data: bytes) -> Head:
        if format_of(data, path) in RAW:
            return Head(*read_raw_head(data, path))
        metadata = read_metadata(data, path)
        width, height = _size(data, path)
        if TURNS[metadata.orientation][2]:
            width, height = height, width
        fov = metadata.lens.fov(width, height)
        turned = metadata.orientation != 1
        return Head((width, height), metadata.exposure, None, fov, turned)

    return _decoded(path, head)


class _Sized(Exception):
    """Width and height are known."""


def _size(data: bytes, path: Path) -> tuple[int, int]:
    """Width and height in the file: every reader asks for room before it decodes."""

    def room(width: int, height: int, pixel: float) -> None:
        del pixel
        raise _Sized(width, height)

    try:
        READERS[format_of(data, path)](data, path, room)
    except _Sized as found:
        return found.args
    raise ValueError("it has no size")


class _Numbers(NamedTuple):
    """What stands in a file, upright.

    - `values`: (H, W, channels), whole numbers or floats.
    - `usable`: (H, W).
    - `linear`: which images these are, if they are linear by their format.
    """

    values: np.ndarray
    usable: np.ndarray
    metadata: Metadata
    linear: str


def _read_numbers(path: Path, max_pixels: int | None = None) -> _Numbers:
    _check_suffix(path)

    def decode(data: bytes) -> _Numbers:
        room, format = _room(data, max_pixels), format_of(data, path)
        if format in RAW:
            raw = read_raw(data, path, room)
            return _Numbers(raw.numbers, raw.usable, Metadata(), "RAW photographs")
        values = READERS[format](data, path, room)
        values = values[..., None] if values.ndim == 2 else values
        usable = np.ones(values.shape[:2], bool)
        return _Numbers(values, usable, read_metadata(data, path), "")

    read = _decoded(path, decode)
    values, metadata = read.values, read.metadata
    if values.ndim != 3 or 0 in values.shape:
        raise ValueError(f"{path}: expected one image, got shape {values.shape}")
    if values.dtype not in (np.uint8, np.uint16) and values.dtype.kind != "f":
        raise ValueError(
            f"{path}: expected samples of uint8, uint16 or floats, got {values.dtype}"
        )
    if metadata.broken:
        warn(
            "exif-broken",
            f"{path}: its EXIF data is broken ({metadata.broken}): it is taken as "
            "upright, and its exposure as unknown",
            stacklevel=4,
        )
    if values.dtype.kind == "f":
        read = read._replace(linear="floating-point images")
    elif metadata.gamma is not None and abs(metadata.gamma - 1) < 0.01:
        read = read._replace(linear="PNGs whose gAMA chunk is 1")
    return read._replace(
        values=metadata.upright(values), usable=metadata.upright(read.usable)
    )


def _check_suffix(path: Path) -> None:
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{path}: {_wanted_suffix(path, SUFFIXES)}")


def _room(data: bytes, max_pixels: int | None) -> Room:
    """Asks for room beside the bytes of a file, which are there already."""

    def ask(width: int, height: int, pixel: float) -> None:
        pixels = width * height
        if max_pixels is not None and pixels > max_pixels:
            raise Refused(
                f"expected at most {max_pixels} pixels (max_pixels), got {width} × "
                f"{height}; a smaller copy will do"
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
    return _decoding(path, decode, read_bytes(path))


def _decoding(path: Path, decode: Callable[[bytes], T], data: bytes) -> T:
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


@contextlib.contextmanager
def refusing() -> Iterator[None]:
    """What is refused is a `ValueError`."""
    try:
        yield
    except Refused as error:
        raise ValueError(str(error)) from None


def _without_alpha(
    path: Path, numbers: np.ndarray, remedy: str | None
) -> tuple[np.ndarray, Bool[np.ndarray, "height width"]]:
    """Numbers without their alpha channel, and where it is 1; they are 0 elsewhere.

    **Arguments:** `remedy`: what to do if the file must be opaque and is not; `None`
    where it need not be.

    **Raises:** `ValueError` that names the file.
    """
    channels = numbers.shape[-1]
    if channels not in (1, 2, 3, 4):
        raise ValueError(
            f"{path}: expected 1 or 3 channels, or these and alpha, got {channels}"
        )
    if channels in (1, 3):
        return numbers, np.ones(numbers.shape[:2], bool)
    highest = 1 if numbers.dtype.kind == "f" else np.iinfo(numbers.dtype).max
    solid = numbers[..., -1] >= highest
    if solid.all():
        return numbers[..., :-1], solid
    if remedy is not None:
        raise ValueError(
            f"{path}: expected an opaque image, got a partly transparent one: {remedy}"
        )
    # Numbers behind, which may be no numbers, are left out.
    return np.where(solid[..., None], numbers[..., :-1], 0), solid
