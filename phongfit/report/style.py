"""Common style of all figures: colours for colour-blind readers, readable labels.

??? cite "Source"
    Okabe and Ito, *Color universal design*, 2008: the colours.
"""

import functools
import io
from pathlib import Path
from typing import Any, Literal

import matplotlib
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure

INK, PALE, GRID = "#1b1f24", "#66707a", "#d8dde2"
BLACK, ORANGE, SKY, GREEN = "#000000", "#e69f00", "#56b4e9", "#009e73"
BLUE, VERMILION = "#0072b2", "#d55e00"
ACCENT = BLUE
CHANNELS = {"red": VERMILION, "green": GREEN, "blue": BLUE}
# Diverging blue and red, which colour-blind readers can distinguish.
SIGNED = "RdBu_r"

STYLE = Path(__file__).with_name("templates") / "figure.mplstyle"


class Picture(Figure):
    """A figure that notebooks display without pyplot."""

    def _repr_png_(self) -> bytes:
        return png(self, 110)


def picture(
    width: float, height: float, layout: Literal["constrained"] | None = "constrained"
) -> Picture:
    """An empty figure, `width` × `height` inches, to be filled inside [`styled`][].

    **Arguments:** `layout`: `None` if axes are placed by hand.
    """
    return Picture(figsize=(width, height), layout=layout)


def styled() -> Any:
    """A context that applies the style to figures, and then restores settings."""
    return matplotlib.rc_context(settings())


@functools.cache
def settings() -> matplotlib.RcParams:
    """The settings of the style alone: all others stay the user's."""
    return matplotlib.rc_params_from_file(STYLE, use_default_template=False)


def png(figure: Figure, dpi: float) -> bytes:
    """A figure as the bytes of a PNG file."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=dpi)
    return stream.getvalue()


def scale(
    axes: Axes,
    shown: ScalarMappable,
    label: str = "",
    pad: float = 0.03,
    **place: Any,
) -> Colorbar:
    """The scale of colours beside a picture."""
    figure = axes.get_figure(root=True)
    assert figure is not None
    bar = figure.colorbar(shown, ax=axes, fraction=0.046, pad=pad, **place)
    bar.set_label(label)
    bar.ax.grid(False)
    return bar


def say(axes: Axes, words: str) -> None:
    """Write words in the middle of axes, in place of a picture."""
    axes.text(0.5, 0.5, words, ha="center", va="center", transform=axes.transAxes)


def quiet(axes: Any) -> None:
    """Remove frame, ticks and grid from axes of a picture."""
    axes.set_xticks([])
    axes.set_yticks([])
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set_visible(False)
