"""Figures of maps, with scales and standard errors."""

import itertools

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from phongfit.maps.pixel.flags import Flag
from phongfit.maps.result import Maps
from phongfit.report.scales import UNIDENTIFIED, draw_numbers
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
    styled,
)

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
