"""The picture of a calibration: spheres, highlights and lamps."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.patches import Circle

from phongfit.calibration.result import Calibration
from phongfit.report.pictures import displayed
from phongfit.report.style import (
    ACCENT,
    GREEN,
    INK,
    ORANGE,
    PALE,
    VERMILION,
    Picture,
    picture,
    quiet,
    styled,
)

WIDEST = 1200
"""Largest longer side of the image, pixels."""


def brightest(
    photographs: Iterable[Float[np.ndarray, "height width 3"]],
) -> Float[np.ndarray, "height width 3"]:
    """The maximum of photographs at each pixel, subsampled for display."""
    most = None
    for image in photographs:
        step = max(1, -(-max(image.shape[:2]) // WIDEST))
        small = np.asarray(image)[::step, ::step]
        most = small if most is None else np.maximum(most, small)
    if most is None:
        raise ValueError("photographs: expected at least one, got none")
    return most


def calibration_figure(
    calibration: Calibration, image: Float[np.ndarray, "height width 3"]
) -> Picture:
    """A figure of spheres and highlights on the photographs, and of the lamps.

    **Arguments:** `image`: linear light, as from [`brightest`][].
    """
    with styled():
        figure = picture(11, 4.7)
        left, right = figure.subplots(1, 2, width_ratios=(1.5, 1))
        _draw_spheres(left, calibration, image)
        _draw_lamps(right, calibration)
    return figure


def _draw_spheres(axes: Axes, calibration: Calibration, image: np.ndarray) -> None:
    width, height = calibration.view.width, calibration.view.height
    # Edges of pixels are at whole numbers.
    axes.imshow(displayed(image), extent=(0, width, height, 0))
    quiet(axes)
    chrome = 0
    for sphere in calibration.spheres:
        x, y, radius = sphere.outline
        colour = ORANGE if sphere.kind == "chrome" else GREEN
        axes.add_patch(Circle((x, y), radius, fill=False, ec=colour, lw=1.2))
        side = 1 if y - radius > 0.06 * height else -1
        _label(axes, sphere.kind, (x, y - side * radius), side, colour, 8)
        if sphere.kind == "chrome":
            spots = np.array([lamp.highlights[chrome] for lamp in calibration.lamps])
            axes.plot(*spots.T, "+", color=VERMILION, ms=5, mew=0.8)
            chrome += 1
    axes.set_title("brightest of the photographs, with spheres and highlights")


def _label(
    axes: Axes, words: str, at: tuple[float, float], side: int, colour: str, size: float
) -> None:
    """Write words above a point, or below it where `side` is −1."""
    edge = "bottom" if side > 0 else "top"
    how: dict[str, Any] = {
        "textcoords": "offset points",
        "ha": "center",
        "va": edge,
    }
    axes.annotate(words, at, (0, 3 * side), color=colour, fontsize=size, **how)


def _draw_lamps(axes: Axes, calibration: Calibration) -> None:
    """Draw directions of lamps, projected along the camera's axis."""
    for angle in (30, 60, 90):
        radius = float(np.sin(np.radians(angle)))
        axes.add_patch(Circle((0, 0), radius, fill=False, ec=PALE, lw=0.6))
        _label(axes, f"{angle}°", (0, -radius), 1, PALE, 7)
    strengths = np.array([lamp.intensity.mean() for lamp in calibration.lamps])
    sizes = 4 + 4 * np.clip(np.nan_to_num(strengths, nan=1.0), 0.1, 3) ** 0.5
    for number, lamp in enumerate(calibration.lamps):
        x, y, z = lamp.direction
        face = "none" if z < 0 else ACCENT
        axes.plot(x, y, "o", ms=sizes[number], mfc=face, mec=ACCENT, mew=0.8)
        _label(axes, str(number + 1), (x, y), 1, INK, 7)
    quiet(axes)
    axes.set_aspect("equal")
    axes.set_xlim(-1.12, 1.12)
    axes.set_ylim(-1.12, 1.12)
    errors = [lamp.direction_error for lamp in calibration.lamps]
    axes.set_title(
        f"lamps as the camera sees them, numbered in order, ± {np.median(errors):.2f}°"
    )
