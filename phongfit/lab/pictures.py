"""Pictures for the page: PNG files and outlines."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from phongfit.files.formats import encode_png
from phongfit.files.images import to_levels

# Display level of a photograph's 99 % quantile, as a fraction of white.
SHOWN = 0.8
MOST_BRIGHTENED = 64.0
# Standard deviation of an outline's smoothing, pixels.
SMOOTHED = 0.8


def png(light: Any, brighten: float = 1.0) -> bytes:
    """Linear light (H, W, 3) as a PNG file for a screen: 8-bit sRGB.

    **Arguments:** `brighten`: factor on the light.
    """
    return encode_png(to_levels(brighten * np.asarray(light), "srgb", 8))


def brightening(image: Float[np.ndarray, "*pixels 3"]) -> float:
    """The factor that makes a dark photograph visible; never below 1."""
    bright = float(np.quantile(image.max(axis=-1), 0.99))
    return float(np.clip(SHOWN / max(bright, 1e-9), 1, MOST_BRIGHTENED))


def outline_path(mask: Bool[np.ndarray, "height width"]) -> str:
    """The border of a mask as an SVG path in pixels, open at the edges of the frame.

    Steps between pixels are smoothed for display.
    """
    # Imported here, since they take long to import.
    from contourpy import contour_generator
    from scipy.ndimage import gaussian_filter

    if min(mask.shape) < 2:
        return ""
    soft = gaussian_filter(mask.astype(float), SMOOTHED, mode="nearest")
    # Pixels' centres are at half integers.
    found: Any = contour_generator(z=soft).lines(0.5)
    lines = [line + 0.5 for line in found]
    return "".join(
        "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in line) for line in lines
    )


def residual_png(
    residual: Float[np.ndarray, "height width 3"],
    used: Bool[np.ndarray, "height width"],
) -> tuple[bytes, float]:
    """A map of the residual: red where the target is brighter, blue where darker.

    Each pixel has the largest residual of its channels, with its sign. Unused pixels
    are grey.

    **Returns:** a PNG file, and the residual at the ends of the scale, which 0.5 % of
    the used pixels exceed.
    """
    # Imported here, since it takes long to import.
    from matplotlib import colormaps

    from phongfit.report.pictures import signed
    from phongfit.report.style import SIGNED

    values = signed(residual)
    reach = np.quantile(np.abs(values[used]), 0.995) if used.any() else 0.0
    scale = max(float(reach), 1e-6)
    colours = colormaps[SIGNED](0.5 + 0.5 * np.clip(values / scale, -1, 1))
    shown = np.where(used[..., None], colours[..., :3], 0.5)
    return encode_png(np.round(255 * shown).astype(np.uint8)), scale
