"""Figures of parameters by pixel or texel: colours, scales and standard errors."""

import itertools
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import LogNorm, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from phongfit.maps.pixel.settings import Flag
from phongfit.maps.result import Maps
from phongfit.report.pictures import displayed
from phongfit.report.style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    PALE,
    SKY,
    VERMILION,
    picture,
    quiet,
    say,
    scale,
    styled,
)

TITLES = {
    "ambient": "ambient ρ_a",
    "diffuse": "diffuse ρ_d",
    "specular": "specular ρ_s",
    "shininess": "exponent f",
}
UNIDENTIFIED = "0.85"
"""Grey level of unidentified places."""


def draw_numbers(
    name: str,
    values: np.ndarray,
    errors: np.ndarray,
    inside: np.ndarray,
    places: str = "pixels",
) -> Figure:
    """A figure of a parameter: its colours, numbers with a scale, and standard errors.

    Numbers are means over the channels, errors root mean squares. Unidentified places
    and those outside are grey, since their values are arbitrary.

    **Arguments:** `values` and `errors`, (H, W, 1 or 3); `inside`, (H, W); `places`,
    the plural name of a place.
    """
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
            _draw_colours(axes[0], values, errors, identified)
        exponents = name == "shininess"
        title = "exponent, logarithmic scale" if exponents else "mean of the channels"
        draw_scale(axes[-2], values.mean(axis=-1), identified, title, exponents)
        unidentified = int(np.sum(inside & ~identified))
        title = "standard error" + (
            f", {unidentified:,} {places} not identified" if unidentified else ""
        )
        draw_scale(axes[-1], spread, identified, title)
        figure.suptitle(TITLES[name], fontsize=11)
    return figure


def _draw_colours(
    axes: Axes, values: np.ndarray, errors: np.ndarray, identified: np.ndarray
) -> None:
    factor = 1.0
    # Do not brighten a parameter that is 0 within its noise.
    seen = identified & (values > 3 * errors).any(axis=-1)
    if seen.sum() > 0.02 * identified.sum():
        brightest = float(np.quantile(values[seen], 0.995))
        factor = 1 / brightest if brightest < 0.5 else 1.0
    shown = displayed(factor * values)
    axes.imshow(np.where(identified[..., None], shown, float(UNIDENTIFIED)))
    axes.set_title("colour" + (f", {factor:.2g} × brighter" if factor > 1 else ""))
    quiet(axes)


def draw_scale(
    axes: Axes,
    numbers: np.ndarray,
    identified: np.ndarray,
    title: str,
    logarithmic: bool = False,
) -> None:
    """Draw numbers with their scale.

    **Arguments:** `identified`: mask; places outside are grey.
    """
    quiet(axes)
    axes.set_title(title)
    shown = np.where(identified & np.isfinite(numbers), numbers, np.nan)
    if np.isnan(shown).all():
        axes.imshow(np.full((*numbers.shape, 3), float(UNIDENTIFIED)))
        return say(axes, "no pixel identifies it")
    low, high = np.nanquantile(shown, [0.005, 0.995])
    options: dict[str, Any] = {"vmin": low, "vmax": max(high, low + 1e-12)}
    if low > 0 and (logarithmic or high > 20 * low):
        options = {"norm": LogNorm(low, max(high, 1.01 * low))}
    axes.set_facecolor(UNIDENTIFIED)
    drawn = axes.imshow(shown, cmap="viridis", interpolation="nearest", **options)
    bar = scale(axes, drawn)
    bar.ax.tick_params(which="both", labelsize=7)
    if "norm" in options:
        _plain_ticks(bar.ax.yaxis, few=bool(high < 100 * low))


def _plain_ticks(axis: Axis, few: bool) -> None:
    """Format ticks as 20 instead of 2 × 10¹."""
    between = LogLocator(subs=(2, 5)) if few else NullLocator()
    axis.set_minor_locator(between)
    axis.set_major_formatter(FuncFormatter(lambda value, place: f"{value:g}"))
    axis.set_minor_formatter(FuncFormatter(lambda value, place: f"{value:g}"))


PALETTE = (ORANGE, SKY, GREEN, VERMILION, BLUE, "#cc79a7", "#f0e442", BLACK)


def draw_parameter(maps: Maps, name: str) -> Figure:
    """A figure of a map: its colours, its numbers with a scale, its standard errors."""
    values = np.asarray(getattr(maps, name), float)
    errors = np.asarray(getattr(maps.stderr, name), float)
    return draw_numbers(name, values, errors, ~maps.flagged(Flag.OUTSIDE))


def draw_flags(maps: Maps) -> Figure:
    """A figure of the pixels' flags, a colour for each reason.

    A pixel with several flags has the colour of its rarest flag.
    """
    inside = ~maps.flagged(Flag.OUTSIDE)
    raised = {f: maps.flagged(f) & inside for f in Flag if f != Flag.OUTSIDE}
    raised = {flag: marked for flag, marked in raised.items() if marked.any()}
    shown = np.where(inside, 1.0, float(UNIDENTIFIED))[..., None] * np.ones(3)
    colours = dict(zip(raised, itertools.cycle(PALETTE), strict=False))
    for flag in sorted(raised, key=lambda flag: -int(raised[flag].sum())):
        shown[raised[flag]] = to_rgb(colours[flag])
    height, width = inside.shape
    with styled():
        side = float(np.clip(3.2 * width / height, 2.4, 6))
        figure = picture(side + 2.6, 3.5)
        axes = figure.subplots()
        axes.imshow(shown, interpolation="nearest")
        quiet(axes)
        axes.set_title("what to know of the pixels")
        free = int((inside & (maps.flags == 0)).sum())
        entries = [("white", f"identified, no flag: {free:,}")]
        entries += [
            (colours[flag], f"{_words(flag)}: {int(marked.sum()):,}")
            for flag, marked in raised.items()
        ]
        if not inside.all():
            entries.append((UNIDENTIFIED, f"outside: {int((~inside).sum()):,}"))
        patches = [
            Patch(facecolor=colour, edgecolor=PALE, linewidth=0.5, label=label)
            for colour, label in entries
        ]
        figure.legend(handles=patches, loc="outside right center")
    return figure


def _words(flag: Flag) -> str:
    return str(flag.name).lower().replace("_", " ")
