"""Pictures of fits: target, fit and residual side by side."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from phongfit.rendering.film import encode

INCHES = 2.1


@dataclasses.dataclass(frozen=True)
class Row:
    """One image and its fit: linear light (H, W, 3), and a line of text."""

    target: Any
    fitted: Any
    residual: Any
    title: str


def displayed(image: Any) -> np.ndarray:
    """Linear light as a screen wants it: clamped to [0, 1] and sRGB-encoded."""
    return np.asarray(encode(np.clip(np.asarray(image), 0, 1), "srgb"))


def comparison(
    rows: Sequence[Row],
    names: tuple[str, str] = ("target", "fit"),
    *,
    brighten: float = 1.0,
    blocks: int = 1,
) -> Figure:
    """A row for each image: target, fit, and a map of the residual with its scale.

    **Arguments:**

    - `rows`: what to show.
    - `names`: of the first two columns; the third is their difference.
    - `brighten`: factor on the light that is shown, for dark photographs.
    - `blocks`: how many rows stand side by side.
    """
    lines = -(-len(rows) // blocks)
    figure, axes = plt.subplots(
        lines,
        3 * blocks,
        figsize=(3.6 * INCHES * blocks, (INCHES + 0.42) * lines + 0.3),
        squeeze=False,
        layout="constrained",
    )
    blocked = axes.reshape(lines * blocks, 3)
    for axis in blocked[len(rows) :].ravel():
        axis.set_axis_off()
    for line, row in zip(blocked, rows, strict=False):
        line[0].imshow(displayed(brighten * np.asarray(row.target)))
        line[1].imshow(displayed(brighten * np.asarray(row.fitted)))
        # One number a pixel: the channel that is furthest off, with its sign.
        residual = np.asarray(row.residual)
        furthest = np.argmax(np.abs(residual), axis=-1)[..., None]
        signed = np.take_along_axis(residual, furthest, axis=-1)[..., 0]
        scale = max(float(np.quantile(np.abs(signed), 0.995)), 1e-6)
        shown = line[2].imshow(signed, cmap="RdBu_r", vmin=-scale, vmax=scale)
        bar = figure.colorbar(shown, ax=line[2], fraction=0.046, pad=0.03)
        bar.ax.tick_params(labelsize=7)
        line[0].set_title(row.title, fontsize=9, loc="left")
        for axis in line:
            axis.set_xticks([])
            axis.set_yticks([])
    columns = (*names, f"{names[0]} − {names[1]} (linear light)")
    for axis, name in zip(axes[-1], columns * blocks, strict=True):
        axis.set_xlabel(name, fontsize=9)
    return figure
