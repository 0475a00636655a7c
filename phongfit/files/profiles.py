"""Colour profiles (ICC): what a file's numbers are, told by the file.

A profile is judged by what it does, not by its name, of which sRGB alone has dozens.

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

# A profile is sRGB, or linear, where it is off by no more than a level of 8 bits; its
# channels are mixed where one makes more of another than this.
LEVEL, MIXED = 1 / 255, 0.01

Numbers = UInt[np.ndarray, "height width channels"] | Float[np.ndarray, "h w c"]


class Profile(NamedTuple):
    """A colour profile that is not sRGB's.

    - `profile`: its bytes.
    - `encoding`: `"linear"` if its numbers are light; else `"srgb"`, which stands for
        any curve.
    - `mixes`: whether its primaries are others than those of sRGB.
    - `grey`: whether it is one of grey pictures.
    """

    profile: bytes
    encoding: Encoding
    mixes: bool
    grey: bool

    def light(
        self, numbers: Numbers, kind: np.dtype
    ) -> Float[np.ndarray, "height width 3"]:
        """Linear light with the primaries of sRGB, as floats of a kind; white is 1."""
        highest = 1 if numbers.dtype.kind == "f" else np.iinfo(numbers.dtype).max
        white = np.full((1, 1, numbers.shape[-1]), highest, numbers.dtype)
        scale = _light(self.profile, white, self.grey)
        light = np.empty((*numbers.shape[:2], 3), kind)
        # Piece by piece, since numbers are copied on their way.
        rows = max(2**20 // max(numbers[:1].size, 1), 1)
        for start in range(0, len(numbers), rows):
            piece = slice(start, start + rows)
            light[piece] = _light(self.profile, numbers[piece], self.grey) / scale
        if numbers.dtype.kind != "f":
            # Colours that sRGB has not are cut off, as what is too bright is.
            np.clip(light, 0, 1, out=light)
            if not self.mixes:
                light[np.broadcast_to(numbers == highest, light.shape)] = 1
        return light


def find_profile(profile: bytes | None, encoding: Encoding) -> Profile | None:
    """What has to be converted; `None` for a picture without a profile, or in sRGB.

    **Raises:** `Refused` for profiles that are broken, of other colours than RGB and
    grey, or say otherwise than `encoding` does.
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
        # The curve is the camera's, whatever the profile's is; colours are not.
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
    # Ramps of grey, and of red, green, blue alone.
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
    # Little CMS has no floats of 16 bits.
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

    **Raises:** `Refused` for points that no three colours have.
    """
    red, green, blue, white = np.reshape(points, (4, 2)).tolist()
    primaries = (*red, 1.0, *green, 1.0, *blue, 1.0)
    # Their triangle has an area, and white has light.
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
    """Pixels of which a channel has the largest number that its format holds."""
    if numbers.dtype.kind == "f":
        return np.zeros(numbers.shape[:2], bool)
    return (numbers == np.iinfo(numbers.dtype).max).any(axis=-1)
