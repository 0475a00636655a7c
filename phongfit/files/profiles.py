"""Colour profiles (ICC): the meaning of a file's numbers, as the file states it.

A profile is classified by its effect on colours, not by its name, since sRGB alone has
dozens of names.

??? cite "Source"
    ISO 15076-1 (ICC.1); Little CMS does the arithmetic, relative to the media's white,
    in floating-point numbers.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import imagecodecs
import numpy as np
from jaxtyping import Bool, Float, UInt

from phongfit.files.formats import Refused
from phongfit.rendering.film import Encoding, encode
from phongfit.rendering.response import ResponseCurve

# A profile is sRGB, or linear, within one level of 8 bits; it mixes channels if one
# channel adds more than MIXED to another.
LEVEL, MIXED = 1 / 255, 0.01

Numbers = UInt[np.ndarray, "height width channels"] | Float[np.ndarray, "h w c"]


class Profile(NamedTuple):
    """A colour profile that is not sRGB's.

    - `profile`: its bytes.
    - `encoding`: `"linear"` if its numbers are linear light; else `"srgb"`, for any
        other curve.
    - `mixes`: true if its primaries differ from those of sRGB.
    - `grey`: true for a profile of grey pictures.
    """

    profile: bytes
    encoding: Encoding
    mixes: bool
    grey: bool

    def light(
        self, numbers: Numbers, kind: np.dtype
    ) -> Float[np.ndarray, "height width 3"]:
        """Linear light with the primaries of sRGB, as dtype `kind`; white is 1."""
        highest = 1 if numbers.dtype.kind == "f" else np.iinfo(numbers.dtype).max
        white = np.full((1, 1, numbers.shape[-1]), highest, numbers.dtype)
        scale = _light(self.profile, white, self.grey)
        light = np.empty((*numbers.shape[:2], 3), kind)
        # In pieces, since the conversion copies numbers.
        rows = max(2**20 // max(numbers[:1].size, 1), 1)
        for start in range(0, len(numbers), rows):
            piece = slice(start, start + rows)
            light[piece] = _light(self.profile, numbers[piece], self.grey) / scale
        if numbers.dtype.kind != "f":
            # Colours outside sRGB are clipped, like those above white.
            np.clip(light, 0, 1, out=light)
            if not self.mixes:
                light[np.broadcast_to(numbers == highest, light.shape)] = 1
        return light


def find_profile(profile: bytes | None, encoding: Encoding) -> Profile | None:
    """The profile to convert from; `None` for a picture without profile, or in sRGB.

    **Raises:** `Refused` for profiles that are broken, of other colours than RGB and
    grey, or that contradict `encoding`.
    """
    if profile is None:
        return None
    space = profile[16:20].decode("latin-1").strip()
    if space not in ("RGB", "GRAY"):
        raise Refused(
            f"expected a colour profile (ICC) of RGB or grey, got {space!r}: convert "
            "it to sRGB"
        )
    found = _judged(profile, space == "GRAY")
    if isinstance(encoding, ResponseCurve):
        # The response curve replaces the profile's curve, but not its primaries.
        if found is not None and found.mixes:
            raise Refused(
                "expected the colours of sRGB, since its encoding is a response curve, "
                "got a colour profile (ICC) of others: convert it to sRGB"
            )
        return None
    told = "srgb" if found is None else found.encoding
    if told != encoding:
        kind = "encoded" if told == "srgb" else "linear"
        raise Refused(
            f"expected encoding {told!r}, since its colours (ICC profile, or Adobe RGB "
            f"by EXIF) have numbers that are {kind}, got {encoding!r}: remove the "
            "profile if it is wrong"
        )
    if found is None or (found.encoding == "linear" and not found.mixes):
        return None
    return found


def _judged(profile: bytes, grey: bool) -> Profile | None:
    # Ramps of grey, of red, of green and of blue.
    levels = np.arange(256, dtype=np.uint8)
    ramps = np.zeros((4, 256, 3), np.uint8)
    ramps[0] = levels[:, None]
    for channel in range(3):
        ramps[1 + channel, :, channel] = levels
    neutral, *alone = _light(profile, ramps, grey)
    if not np.isfinite(neutral).all() or np.ptp(neutral[-1]) > MIXED:
        raise Refused("its colour profile (ICC) is broken: its white is not white")
    curve = neutral / neutral[-1]
    own = np.stack([ramp[:, channel] for channel, ramp in enumerate(alone)], axis=-1)
    others = max(
        float(np.abs(np.delete(ramp, channel, axis=-1)).max())
        for channel, ramp in enumerate(alone)
    )
    mixes = not grey and max(others, float(np.abs(own - neutral).max())) > MIXED
    stated = levels[:, None] / 255
    if not mixes and _near(encode(np.clip(curve, 0, 1), "srgb"), stated):
        return None
    linear = _near(curve, stated)
    return Profile(profile, "linear" if linear else "srgb", mixes, grey)


def _near(one: Any, other: Any) -> bool:
    return bool(np.abs(one - other).max() <= LEVEL)


def _light(
    profile: bytes, numbers: Numbers, grey: bool
) -> Float[np.ndarray, "height width 3"]:
    channels, kind = (1, "gray") if grey else (3, "rgb")
    if numbers.shape[-1] != channels:
        numbers = np.repeat(numbers[..., :1], channels, axis=-1)
    # Little CMS does not support 16-bit floats here.
    half = numbers.dtype == np.float16
    numbers = np.ascontiguousarray(numbers, np.float32 if half else None)
    try:
        light = imagecodecs.cms_transform(
            numbers[..., 0] if grey else numbers,
            profile,
            _linear(kind),
            colorspace=kind,
            outcolorspace=kind,
            outdtype=np.float64,
        )
    except imagecodecs.CmsError as error:
        raise Refused(
            f"its colour profile (ICC) cannot be used: {error}: convert it to sRGB"
        ) from None
    return np.repeat(light[..., None], 3, axis=-1) if grey else light


def _linear(kind: str) -> bytes:
    """The profile of linear light, with the primaries of sRGB."""
    if kind == "gray":
        white = (*SRGB_POINTS[6:], 1.0)
        return imagecodecs.cms_profile(kind, whitepoint=white, gamma=1.0)
    return linear_profile(SRGB_POINTS)


SRGB_POINTS = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
"""x and y of red, green, blue and white."""


def linear_profile(points: Sequence[float]) -> bytes:
    """The profile of linear light with other primaries.

    **Arguments:** `points`: x and y of red, green, blue and white.

    **Raises:** `Refused` for invalid points, such as primaries on one line.
    """
    red, green, blue, white = np.reshape(points, (4, 2)).tolist()
    primaries = (*red, 1.0, *green, 1.0, *blue, 1.0)
    # Valid primaries span a triangle, and white has y > 0.
    sound = np.isfinite(points).all() and np.abs(points).max() < 10 and white[1] > 1e-3
    if not sound or abs(np.linalg.det([[*p, 1] for p in (red, green, blue)])) < 1e-3:
        raise Refused(
            "expected primaries and white, x and y of each, that colours can have, got "
            f"{', '.join(f'{value:g}' for value in points)}"
        )
    return imagecodecs.cms_profile(
        "rgb", whitepoint=(*white, 1.0), primaries=primaries, gamma=1.0
    )


def adobe_profile() -> bytes:
    """The profile of Adobe RGB (1998)."""
    return imagecodecs.cms_profile("adobergb")


def saturated(numbers: Numbers) -> Bool[np.ndarray, "height width"]:
    """Mask of pixels with a channel at the largest number of the format."""
    if numbers.dtype.kind == "f":
        return np.zeros(numbers.shape[:2], bool)
    return (numbers == np.iinfo(numbers.dtype).max).any(axis=-1)
