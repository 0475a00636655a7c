"""Figures of an image, and of photograph, fit and residual side by side."""

import dataclasses
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from phongfit.checks import as_array
from phongfit.edge import checked
from phongfit.plain import readable
from phongfit.rendering.film import encode
from phongfit.report.style import SIGNED, picture, quiet, scale, styled

Title = str | int | float | os.PathLike[str]
INCHES = 2.1


@dataclasses.dataclass(frozen=True)
class Row:
    """One image and its fit: linear light (H, W, 3), and a line of text."""

    target: Any
    fitted: Any
    residual: Any
    title: str


def displayed(image: Any) -> np.ndarray:
    """Linear light encoded for a screen: clamped to [0, 1] and sRGB-encoded.

    NaN, as outside of a mask, becomes black.
    """
    known = np.nan_to_num(np.asarray(image), nan=0.0)
    return np.asarray(encode(np.clip(known, 0, 1), "srgb"))


@checked
def show(image: Any, *, title: Title = "", brighten: float = 1.0) -> Figure:
    """A matplotlib figure of an image in linear light, encoded for the screen.

    **Arguments:**

    - `image`: (height, width, 3), where white is 1; (height, width) is a map of
        numbers, shown with a scale.
    - `title`: above the image.
    - `brighten`: factor on the light that is shown, for dark photographs.

    **Raises:** `ValueError` that names the argument.
    """
    pixels = as_array("image", image)
    if pixels.dtype.kind not in "bfiu" or not (
        pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] == 3)
    ):
        raise ValueError(
            "image: expected (height, width, 3) or (height, width) numbers, got shape "
            f"{pixels.shape} of {pixels.dtype}"
        )
    height, width = pixels.shape[:2]
    with styled():
        # Width by the image's shape, within limits.
        figure = picture(float(np.clip(4 * width / max(height, 1), 2, 8)), 4)
        axes = figure.subplots()
        if pixels.ndim == 3:
            axes.imshow(displayed(brighten * pixels))
        else:
            scale(axes, axes.imshow(brighten * pixels.astype(float), cmap="viridis"))
        axes.set_title(str(title))
        quiet(axes)
    return figure


def signed(residual: Any) -> np.ndarray:
    """For each pixel the largest residual of its channels, with its sign."""
    residual = np.asarray(residual)
    furthest = np.argmax(np.abs(residual), axis=-1)[..., None]
    return np.take_along_axis(residual, furthest, axis=-1)[..., 0]


def draw_residual(axes: Axes, residual: Any, *, below: bool = False) -> None:
    """Draw a residual (H, W, 3) in linear light, with its scale beside or `below`."""
    values = signed(residual)
    most = max(float(np.quantile(np.abs(values), 0.995)), 1e-6)
    shown = axes.imshow(values, cmap=SIGNED, vmin=-most, vmax=most)
    label = "linear light, white = 1; the channel furthest off"
    bar = scale(axes, shown, label, location="bottom") if below else scale(axes, shown)
    bar.ax.tick_params(labelsize=7)
    bar.locator = MaxNLocator(4 if below else 8, symmetric=True)
    # Without a common power of ten, which would overlap the label below.
    bar.formatter = StrMethodFormatter("{x:g}")


def comparison(
    rows: Sequence[Row],
    names: tuple[str, str] = ("target", "fit"),
    *,
    brighten: float = 1.0,
    blocks: int = 1,
) -> Figure:
    """A figure with a row for each image: target, fit, and residual with its scale.

    **Arguments:**

    - `rows`: the images and their fits.
    - `names`: of the first two columns; the third is their difference.
    - `brighten`: factor on the light that is shown, for dark photographs.
    - `blocks`: number of rows side by side.
    """
    lines = -(-len(rows) // blocks)
    with styled():
        figure = picture(3.6 * INCHES * blocks, (INCHES + 0.42) * lines + 0.3)
        axes = figure.subplots(lines, 3 * blocks, squeeze=False)
        blocked = axes.reshape(lines * blocks, 3)
        for axis in blocked[len(rows) :].ravel():
            axis.set_axis_off()
        for line, row in zip(blocked, rows, strict=False):
            line[0].imshow(displayed(brighten * np.asarray(row.target)))
            line[1].imshow(displayed(brighten * np.asarray(row.fitted)))
            draw_residual(line[2], row.residual)
            # A file's name may contain $ or characters that the font lacks.
            line[0].set_title(readable(row.title), fontsize=9, parse_math=False)
            for axis in line:
                quiet(axis)
        columns = (*names, f"{names[0]} − {names[1]} (linear light)")
        for axis, name in zip(axes[-1], columns * blocks, strict=True):
            axis.set_xlabel(name, fontsize=9)
    return figure
