"""Orientation, colours and exposure from the metadata of a photograph's file.

??? cite "Source"
    CIPA DC-008, *Exif 2.32*, 2019; ISO 15076-1 (ICC.1), annex B; *PNG, third edition*,
    W3C, 2025, sections 4.3 and 11.3.
"""

import struct
import zlib
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

import numpy as np

from phongfit.files.formats import (
    Refused,
    exr_primaries,
    format_of,
    opened_jpeg,
    png_chunks,
    radiance_header,
    radiance_values,
)
from phongfit.files.profiles import SRGB_POINTS, adobe_profile, linear_profile
from phongfit.files.tags import Directory, first_directory

MAX_PROFILE = 2**23
"""Largest size of a colour profile, bytes: cameras' and screens' have some thousands.
"""

_ORIENTATION, _EXIF, _PROFILE = 274, 34665, 34675
_TIME, _F_NUMBER, _ISO = 33434, 33437, 34855
# Tags for ISO values above 16 bits: recommended exposure index, ISO speed.
_MORE_ISO, _FULL = (34866, 34867), 65535
_FOCAL, _FOCAL_35MM, _WIDTH, _HEIGHT = 37386, 41989, 40962, 40963
_DENSITY, _DENSITY_UNIT = 41486, 41488
# Adobe RGB: the value by EXIF's rules, and the value that some cameras write.
_COLOURS, _UNCALIBRATED, _ADOBE = 40961, 65535, 2
_INTEROPERABILITY, _RULES = 40965, 1
# Millimetres of the units that EXIF counts sensors' pixels by: inch, cm, mm, µm.
_UNITS = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}

FILM_DIAGONAL = float(np.hypot(36, 24))
"""Diagonal of 36 × 24 mm film, to which equivalent focal lengths refer, millimetres.
"""


class Exposure(NamedTuple):
    """Exposure settings that the camera recorded; `None` if it did not.

    - `time`: exposure time, seconds.
    - `f_number`: focal length over the aperture's diameter.
    - `iso`: sensitivity.
    """

    time: float | None = None
    f_number: float | None = None
    iso: float | None = None

    def only(self, fields: Collection[str]) -> "Exposure":
        """The exposure with only some of its fields."""
        kept = {name: getattr(self, name) for name in fields}
        return Exposure(**kept)

    def __str__(self) -> str:
        words = [_seconds(self.time)] if self.time else []
        words += [f"f/{self.f_number:g}"] if self.f_number else []
        return ", ".join(words + ([f"ISO {self.iso:g}"] if self.iso else []))


class Lens(NamedTuple):
    """A camera's lens from EXIF data; `None` for values that they lack.

    - `equivalent`: focal length, millimetres, with this angle of view over the diagonal
        of 36 × 24 mm film.
    - `focal`: focal length in pixels of the camera's image.
    - `size`: width and height of that image, pixels.
    """

    equivalent: float | None = None
    focal: float | None = None
    size: tuple[int, int] | None = None

    def fov(self, width: int, height: int) -> float | None:
        """The angle of view from the lower to the upper edge, degrees.

        `None` if it is not stated, or if the image's size is not the camera's: a crop
        has a smaller angle.
        """
        if self.size is not None and sorted(self.size) != sorted((width, height)):
            return None
        focal = self.focal
        if self.equivalent is not None:
            focal = self.equivalent * float(np.hypot(width, height)) / FILM_DIAGONAL
        if focal is None:
            return None
        return float(np.degrees(2 * np.arctan(height / (2 * focal))))


class Metadata(NamedTuple):
    """Metadata of an image file.

    - `orientation`: 1 … 8 as in EXIF; 1 is upright.
    - `exposure`: time, aperture, sensitivity.
    - `lens`: focal length.
    - `profile`: an ICC profile, or one that is made from the file's primaries.
    - `gamma`: of the numbers in a PNG without a profile; 1 is linear.
    - `broken`: error message, if EXIF data cannot be read.
    """

    orientation: int = 1
    exposure: Exposure = Exposure()
    profile: bytes | None = None
    gamma: float | None = None
    broken: str | None = None
    lens: Lens = Lens()

    def upright(self, numbers: np.ndarray) -> np.ndarray:
        """Pixels turned upright, (H, W, …), from the order in the file."""
        down, across, exchanged = TURNS[self.orientation]
        turned = numbers[:: -1 if down else 1, :: -1 if across else 1]
        return turned.swapaxes(0, 1) if exchanged else turned


TURNS = {
    1: (False, False, False),
    2: (False, True, False),
    3: (True, True, False),
    4: (True, False, False),
    5: (False, False, True),
    6: (True, False, True),
    7: (True, True, True),
    8: (False, True, True),
}
"""Operations for each EXIF orientation: reverse rows, reverse columns, then exchange
rows and columns."""


def read_metadata(data: bytes, path: Path) -> Metadata:
    """Metadata of an image file; empty for RAW photographs.

    **Arguments:** `path`: of the file with these bytes.

    **Raises:** `Refused` for unsupported colours.
    """
    format = format_of(data, path)
    if format == ".png":
        return _of_png(data)
    if format == ".jpg":
        with opened_jpeg(data) as image:
            exif, profile = image.info.get("exif"), image.info.get("icc_profile")
        exif = exif.removeprefix(b"Exif\0\0") if exif else None
        return _of_exif(exif, _as_profile(profile))
    if format == ".tif":
        return _of_exif(data, _as_profile(first_directory(data).content(_PROFILE)))
    points = None
    if format == ".exr":
        points = exr_primaries(path)
    if format == ".hdr":
        lines = radiance_values(radiance_header(data), "PRIMARIES", 8)
        points = lines[-1] if len(lines) else None
    if points is None or np.allclose(points, SRGB_POINTS, atol=1e-3):
        return Metadata()
    return Metadata(profile=linear_profile(points))


def _of_exif(exif: bytes | None, profile: bytes | None) -> Metadata:
    """Metadata from EXIF; an invalid orientation, such as 0, becomes 1."""
    if not exif:
        return Metadata(profile=profile)
    try:
        directory = first_directory(exif)
        orientation = directory.whole(_ORIENTATION, 1)
        camera = directory.below(_EXIF)
        exposure, lens = _exposure(camera), _lens(camera)
        if profile is None and _is_adobe(camera):
            profile = adobe_profile()
    except (ValueError, struct.error) as error:
        return Metadata(profile=profile, broken=str(error))
    orientation = orientation if orientation in TURNS else 1
    return Metadata(orientation, exposure, profile, lens=lens)


def _is_adobe(exif: Directory) -> bool:
    """True if EXIF states Adobe RGB, for files without an ICC profile."""
    colours = exif.whole(_COLOURS)
    if colours != _UNCALIBRATED:
        return colours == _ADOBE
    rules = exif.below(_INTEROPERABILITY).content(_RULES) or b""
    return rules.startswith(b"R03")


def _exposure(exif: Directory) -> Exposure:
    iso = exif.whole(_ISO)
    if iso == _FULL:
        iso = max(exif.whole(tag) for tag in _MORE_ISO) or iso
    values = (exif.ratio(_TIME), exif.ratio(_F_NUMBER), float(iso))
    # Lenses without contacts have an aperture of 0.
    return Exposure(*(value if value and value > 0 else None for value in values))


def _lens(exif: Directory) -> Lens:
    focal, density = exif.ratio(_FOCAL), exif.ratio(_DENSITY)
    unit = _UNITS.get(exif.whole(_DENSITY_UNIT, 2))
    pixels = None
    if focal and density and unit and min(focal, density) > 0:
        pixels = focal * density / unit
    equivalent = exif.whole(_FOCAL_35MM)
    size = exif.whole(_WIDTH), exif.whole(_HEIGHT)
    return Lens(
        # In EXIF 0 means unknown.
        float(equivalent) if equivalent > 0 else None,
        pixels,
        size if min(size) > 0 else None,
    )


def _of_png(data: bytes) -> Metadata:
    found = {kind: chunk[8:-4] for kind, chunk in png_chunks(data) if kind in _TOLD}
    metadata = _of_exif(found.get(b"eXIf"), None)
    # Chunks in the order of precedence of the standard.
    if b"cICP" in found and found[b"cICP"] != _SRGB_CODES:
        raise Refused(
            "expected sRGB or an ICC profile, got other code points for its colours "
            "(cICP): convert it to sRGB"
        )
    if b"iCCP" in found and b"cICP" not in found:
        return metadata._replace(profile=_unpacked(found[b"iCCP"]))
    if b"cICP" in found or b"sRGB" in found:
        return metadata._replace(profile=None)
    if len(found.get(b"cHRM", b"")) == 32:
        points = np.array(struct.unpack(">8I", found[b"cHRM"])) / 100000
        if np.abs(points - np.roll(SRGB_POINTS, 2)).max() > 0.01:
            raise Refused(
                "expected the primaries of sRGB, got others (cHRM) without an ICC "
                "profile: convert it to sRGB"
            )
    if len(found.get(b"gAMA", b"")) == 4:
        (gamma,) = struct.unpack(">I", found[b"gAMA"])
        metadata = metadata._replace(gamma=gamma / 100000)
    return metadata


_TOLD = (b"eXIf", b"cICP", b"iCCP", b"sRGB", b"cHRM", b"gAMA")
# Code points of sRGB in ITU-T H.273: primaries, transfer function, matrix; full range.
_SRGB_CODES = bytes([1, 13, 0, 1])


def _unpacked(chunk: bytes) -> bytes | None:
    """A profile from its chunk: name, zero, method, and packed bytes."""
    _, _, packed = chunk.partition(b"\0")
    try:
        # Limit the output, since zeros are compressed a thousandfold.
        profile = zlib.decompressobj().decompress(packed[1:], MAX_PROFILE + 1)
    except zlib.error as error:
        raise Refused(f"its colour profile (ICC) is broken: {error}") from None
    return _as_profile(profile)


def _as_profile(profile: bytes | None) -> bytes | None:
    if profile is not None and len(profile) > MAX_PROFILE:
        raise Refused(
            f"expected a colour profile (ICC) of at most {MAX_PROFILE} bytes, got more"
        )
    return profile


def _seconds(time: float) -> str:
    """An exposure time as cameras show it, such as `1/60 s`."""
    return f"1/{1 / time:.4g} s" if time < 0.3 else f"{time:.3g} s"
