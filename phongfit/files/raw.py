"""RAW photographs as linear light, read with rawpy, which `phongfit[raw]` installs.

??? cite "Source"
    LibRaw's documentation of its processing, https://www.libraw.org/docs
"""

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, UInt16

from phongfit.files.formats import Refused, Room, silent_library
from phongfit.files.metadata import Exposure

RAW = (
    *(".dng", ".cr2", ".cr3", ".nef", ".nrw", ".arw", ".raf", ".orf"),
    *(".rw2", ".pef", ".srw", ".x3f", ".iiq", ".3fr"),
)
"""Suffixes of RAW photographs."""

# Bytes a pixel: the sensor's value, four colours and scratch space of their
# interpolation, and two pictures.
_PIXEL = 48

# Smallest number that is white in LibRaw's output, which may round it below 65535.
_CUT_OFF = 65535 - 8


class Raw(NamedTuple):
    """Pixels of a RAW photograph, with a mask, and the exposure that it states.

    - `numbers`: linear light with the primaries of sRGB; 65535 is white.
    - `usable`: false where a channel of the sensor was saturated, since the conversion
        of colours then makes all three wrong.
    """

    numbers: UInt16[np.ndarray, "height width 3"]
    usable: Bool[np.ndarray, "height width"]
    exposure: Exposure


def read_raw(data: bytes, path: Path, room: Room) -> Raw:
    """Read a RAW photograph: linear, upright, in the camera's white balance.

    Each channel's black level is subtracted, and white is the sensor's largest value,
    independent of the picture; nothing is brightened, sharpened or denoised.

    **Raises:** `Refused` if rawpy is missing, or the file states no white balance;
    `ValueError` for broken files.
    """
    with _opened(data, path) as raw:
        room(raw.sizes.raw_width, raw.sizes.raw_height, _PIXEL)
        if raw.num_colors != 3:
            raise Refused(f"expected a sensor of 3 colours, got {raw.num_colors}")
        _white_balance(raw)
        # Saturation shows only in the sensor's channels, before they are mixed into
        # the colours of sRGB.
        cut_off = _developed(raw, "raw") >= _CUT_OFF
        numbers = _developed(raw, "sRGB")
        # Set exactly, since the conversion of colours rounds.
        numbers[cut_off.all(axis=-1)] = 65535
        usable = ~_near(np.asarray(cut_off.any(axis=-1)))
        return Raw(numbers, usable, _exposure(raw))


def read_raw_head(
    data: bytes, path: Path
) -> tuple[tuple[int, int], Exposure, tuple[float, float]]:
    """Width and height, exposure, and white balance of a RAW file.

    The white balance has the factors of red and blue relative to green.

    **Raises:** as [`read_raw`][] does.
    """
    with _opened(data, path) as raw:
        sizes = raw.sizes
        size = sizes.width, sizes.height
        # In LibRaw's flip, the bit of value 4 exchanges rows and columns.
        size = size[::-1] if sizes.flip & 4 else size
        return size, _exposure(raw), _white_balance(raw)


def _exposure(raw: Any) -> Exposure:
    stated = (raw.other.shutter_speed, raw.other.aperture, raw.other.iso_speed)
    return Exposure(*(float(value) if value > 0 else None for value in stated))


@contextlib.contextmanager
def _opened(data: bytes, path: Path) -> Iterator[Any]:
    try:
        import rawpy
    except ImportError as error:
        raise Refused(
            f"expected rawpy, which reads {path.suffix}, to be installed: "
            "pip install 'phongfit[raw]'"
        ) from error
    try:
        with silent_library(), rawpy.imread(io.BytesIO(data)) as raw:
            yield raw
    except rawpy.LibRawError as error:
        # rawpy's messages may be bytes.
        words = (arg.decode() if isinstance(arg, bytes) else arg for arg in error.args)
        raise ValueError(" ".join(map(str, words))) from error


def _white_balance(raw: Any) -> tuple[float, float]:
    red, green, blue = raw.camera_whitebalance[:3]
    if not all(0 < value < np.inf for value in (red, green, blue)):
        raise Refused(
            "expected a white balance that the camera states, got none: develop it to "
            "a linear TIFF with one of your choice"
        )
    return red / green, blue / green


def _developed(raw: Any, colours: str) -> UInt16[np.ndarray, "height width 3"]:
    import rawpy

    white = None
    if raw.raw_type == rawpy.RawType.Stack:
        # Otherwise LibRaw subtracts the black level of linear DNGs from light, but not
        # from white.
        white = raw.white_level - min(raw.black_level_per_channel[: raw.num_colors])
    return raw.postprocess(
        user_sat=white,
        gamma=(1, 1),
        no_auto_bright=True,
        # Otherwise white depends on the brightest pixel.
        adjust_maximum_thr=0,
        output_bps=16,
        use_camera_wb=True,
        output_color=rawpy.ColorSpace[colours],
        highlight_mode=rawpy.HighlightMode.Clip,
    )


def _near(white: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels up to two away from `white`, whose colours are interpolated from it."""
    # Imported here, since SciPy takes long to import.
    import scipy.ndimage

    return scipy.ndimage.binary_dilation(white, np.ones((5, 5)))
