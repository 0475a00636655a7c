"""Style and layout of the experiments' figures, as wide as a page of text."""

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import StrMethodFormatter

from phongfit.report.pictures import displayed
from phongfit.report.style import (
    BLACK as BLACK,
    BLUE,
    GREEN,
    GRID as GRID,
    ORANGE,
    PALE as PALE,
    SKY as SKY,
    VERMILION,
    quiet,
    settings,
)

# Width of a page's text, inches: nothing is scaled, so a point of type is a point.
PAGE = 7.2
DPI = 150

# Colour, marker and symbol of each parameter, the same in all figures.
PARAMETERS = {
    "diffuse": (BLUE, "o", "ρ_d"),
    "specular": (VERMILION, "s", "ρ_s"),
    "shininess": (GREEN, "^", "f"),
    "ambient": (ORANGE, "D", "ρ_a"),
}

# Style of the report, changed for many small panels: titles above the middle of each.
STYLE: dict[Any, Any] = {
    **settings(),
    "axes.titlelocation": "center",
    "figure.titlesize": 10,
    "lines.markersize": 4.5,
    "figure.constrained_layout.h_pad": 0.03,
    "figure.constrained_layout.w_pad": 0.03,
}

# Decorator of functions that draw: Matplotlib uses `STYLE` while they run.
styled = matplotlib.rc_context(STYLE)


def symbol(name: str) -> str:
    """A parameter's symbol in Matplotlib's TeX, such as "$ρ_{d}$" for "diffuse"."""
    letter, _, index = PARAMETERS[name][2].partition("_")
    return f"${letter}_{{{index}}}$" if index else f"${letter}$"


def page(height: float) -> Figure:
    """An empty figure as wide as a page; `height` in inches."""
    return Figure(figsize=(PAGE, height), layout="constrained", dpi=DPI)


def bands(figure: Figure, *heights: float) -> list[SubFigure]:
    """Divide a page into parts, from top to bottom; `heights` are relative."""
    parts = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)
    return np.ravel(np.asarray(parts, object)).tolist()


def show(axes: Axes, image: Any, title: str = "", below: str = "") -> None:
    """Draw linear light (H, W, 3) as a screen shows it: clamped and sRGB-encoded.

    **Arguments:** `title`, `below`: text above and below the picture.
    """
    axes.imshow(displayed(image))
    quiet(axes)
    axes.set_title(title)
    axes.set_xlabel(below)


def plain_numbers(axes: Axes, which: str = "xy") -> None:
    """Label logarithmic axes by 0.1, 1, 10 instead of powers of ten.

    **Arguments:** `which`: `"x"`, `"y"` or `"xy"`.
    """
    for name, axis in (("x", axes.xaxis), ("y", axes.yaxis)):
        if name in which and axis.get_scale() == "log":
            axis.set_major_formatter(StrMethodFormatter("{x:g}"))


def picture_grid(
    figure: Figure | SubFigure,
    images: Sequence[Sequence[Any]],
    *,
    columns: Sequence[str],
    rows: Sequence[str],
) -> np.ndarray:
    """Draw pictures in a grid whose rows and columns have titles.

    **Arguments:** `images`: rows of images, each linear light (H, W, 3); `columns`,
    `rows`: titles.

    **Returns:** Matplotlib's axes, of shape (rows, columns).
    """
    axes = figure.subplots(len(images), len(images[0]), squeeze=False)
    for line, row, name in zip(axes, images, rows, strict=True):
        for panel, image in zip(line, row, strict=True):
            show(panel, image)
        line[0].set_ylabel(name)
    for panel, name in zip(axes[0], columns, strict=True):
        panel.set_title(name)
    return axes
