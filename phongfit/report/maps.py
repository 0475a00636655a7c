"""Pictures of maps: each with its scale, and beside it that of its errors."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from phongfit.maps.pixel.flags import Flag
from phongfit.maps.result import Maps
from phongfit.report.pictures import displayed
from phongfit.report.style import picture, quiet, styled

TITLES = {
    "ambient": "ambient ρ_a",
    "diffuse": "diffuse ρ_d",
    "specular": "specular ρ_s",
    "shininess": "exponent f",
}
UNIDENTIFIED = "0.85"
"""Grey where there is nothing to be shown."""


def draw_parameter(maps: Maps, name: str) -> Figure:
    """A map as it looks, its numbers with their scale, and its standard errors.

    Numbers are means over the channels, errors root mean squares. Pixels that cannot
    tell are grey, as are those outside: what number they have is chance.
    """
    values = np.asarray(getattr(maps, name), float)
    errors = np.asarray(getattr(maps.stderr, name), float)
    inside = ~maps.flagged(Flag.OUTSIDE)
    identified = inside & np.isfinite(errors).all(axis=-1)
    with np.errstate(invalid="ignore"):
        spread = np.sqrt(np.mean(errors**2, axis=-1))
    height, width = inside.shape
    coloured = values.shape[-1] == 3
    columns = 3 if coloured else 2
    with styled():
        side = float(np.clip(3.2 * width / height, 2.4, 6))
        figure = picture(columns * (side + 0.6), 3.5)
        axes = figure.subplots(1, columns, squeeze=False)[0]
        if coloured:
            _draw_colours(axes[0], values, identified)
        _draw_scale(axes[-2], values.mean(axis=-1), identified, _numbers_title(name))
        unidentified = int(np.sum(inside & ~identified))
        title = "standard error" + (
            f", {unidentified:,} pixels not identified" if unidentified else ""
        )
        _draw_scale(axes[-1], spread, identified, title)
        figure.suptitle(TITLES[name], fontsize=11)
    return figure


def _numbers_title(name: str) -> str:
    return "exponent" if name == "shininess" else "mean of the channels"


def _draw_colours(axes: Axes, values: np.ndarray, identified: np.ndarray) -> None:
    brightest = (
        float(np.quantile(values[identified], 0.995)) if identified.any() else 1.0
    )
    factor = 1 / max(brightest, 1e-6) if brightest < 0.5 else 1.0
    shown = displayed(factor * values)
    axes.imshow(np.where(identified[..., None], shown, float(UNIDENTIFIED)))
    axes.set_title("colour" + (f", {factor:.2g} × brighter" if factor > 1 else ""))
    quiet(axes)


def _draw_scale(
    axes: Axes, numbers: np.ndarray, identified: np.ndarray, title: str
) -> None:
    quiet(axes)
    axes.set_title(title)
    shown = np.where(identified & np.isfinite(numbers), numbers, np.nan)
    if np.isnan(shown).all():
        axes.imshow(np.full((*numbers.shape, 3), float(UNIDENTIFIED)))
        words = "no pixel identifies it"
        axes.text(0.5, 0.5, words, ha="center", va="center", transform=axes.transAxes)
        return
    low, high = np.nanquantile(shown, [0.005, 0.995])
    options: dict[str, Any] = {"vmin": low, "vmax": max(high, low + 1e-12)}
    if low > 0 and high > 20 * low:
        options = {"norm": LogNorm(low, high)}
    axes.set_facecolor(UNIDENTIFIED)
    drawn = axes.imshow(shown, cmap="viridis", interpolation="nearest", **options)
    figure = axes.get_figure(root=True)
    assert figure is not None
    bar = figure.colorbar(drawn, ax=axes, fraction=0.046, pad=0.03)
    bar.ax.tick_params(labelsize=7)
    bar.ax.grid(False)


def draw_flags(maps: Maps) -> Figure:
    """Pixels not identified, or only with care, and why: a map for each reason."""
    raised = [f for f in Flag if f != Flag.OUTSIDE and maps.flagged(f).any()]
    height, width = maps.flags.shape
    with styled():
        side = float(np.clip(2.6 * width / height, 2.0, 5))
        count = max(len(raised), 1)
        figure = picture(side * min(count, 4) + 0.3, 3.1 * -(-count // 4))
        axes = figure.subplots(-(-count // 4), min(count, 4), squeeze=False).ravel()
        for axis in axes[len(raised) :]:
            axis.set_axis_off()
        if not raised:
            words = "no pixel has a flag:\nall are identified"
            axes[0].text(0.5, 0.5, words, ha="center", va="center")
        inside = ~maps.flagged(Flag.OUTSIDE)
        for axis, flag in zip(axes, raised, strict=False):
            shown = np.where(inside, 1.0, float(UNIDENTIFIED))
            marked = maps.flagged(flag)
            axis.imshow(np.where(marked, 0.0, shown), cmap="gray", vmin=0, vmax=1)
            name = str(flag.name).lower().replace("_", " ")
            axis.set_title(f"{name}: {int(marked.sum()):,} pixels")
            quiet(axis)
    return figure
