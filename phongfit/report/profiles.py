"""Figures of profiles: Δχ² of a fit against one fixed unknown, or two."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from scipy.interpolate import PchipInterpolator

from phongfit.fitting.result import Fit
from phongfit.fitting.uncertainty.numbers import number_with_error
from phongfit.fitting.uncertainty.profile import Profile, ProfilePair
from phongfit.fitting.uncertainty.quantiles import student_reach
from phongfit.report.style import ACCENT, INK, PALE, picture, styled
from phongfit.report.words import unit

SHADE = 0.13
"""Opacity of an interval; narrower ones are drawn over wider ones."""

DIFFER = 0.3
"""Smallest difference of a profile's interval and a standard error that is reported, as
a fraction of the error on that side."""


def draw_profile(axes: Axes, fit: Fit, found: Profile) -> None:
    """Draw Δχ² against one unknown, its intervals, and the parabola of its error."""
    value, error = fit[found.label][:2]
    fine = np.linspace(found.values[0], found.values[-1], 200)
    best = int(np.argmin(found.rise))
    roots = np.sqrt(found.rise) * np.where(np.arange(len(found.rise)) < best, -1, 1)
    _, first = np.unique(found.values, return_index=True)
    if len(first) > 1:
        curve = PchipInterpolator(found.values[first], roots[first])(fine) ** 2
        axes.plot(fine, curve, color=ACCENT, label="profile")
    axes.plot(found.values, found.rise, "o", color=ACCENT, markersize=3)
    top = min(float(found.rise.max()) * 1.05 + 1e-3, 12.0)
    if np.isfinite(error) and error > 0:
        parabola = ((fine - float(value)) / float(error)) ** 2
        axes.plot(fine, parabola, "--", color=PALE, label="standard error")
    for low, high in found.intervals.values():
        axes.axvspan(low, high, color=ACCENT, alpha=SHADE, linewidth=0)
    axes.set_ylim(0, top)
    axes.set_xlim(found.values[0], found.values[-1])
    axes.set_xlabel(f"{found.label}  ({unit(found.label)})")
    axes.set_ylabel("Δχ²: how much worse the fit is")
    lines, words = axes.get_legend_handles_labels()
    shades, chances = _shades(list(found.intervals))
    # The legend is above the axes: labels inside would overlap.
    axes.legend(
        [*lines, *shades],
        [*words, *chances],
        loc="lower left",
        bbox_to_anchor=(0, 1),
        ncols=3,
        borderaxespad=0.2,
    )


def _shades(levels: Sequence[float]) -> tuple[list[Patch], list[str]]:
    """Patches for the legend, with the opacity of overlaid intervals, and labels."""
    layers = range(len(levels), 0, -1)
    opacity = [1 - (1 - SHADE) ** count for count in layers]
    shades = [Patch(color=ACCENT, alpha=alpha, linewidth=0) for alpha in opacity]
    return shades, [f"{100 * level:.3g} %" for level in levels]


def difference_words(fit: Fit, found: Profile) -> str:
    """Advice to quote the profile's interval or the standard error, if they differ.

    A skewed or wide profile is quoted, since the standard error assumes a parabola. A
    profile that is narrower on both sides is not: standard errors contain
    contributions that no profile has, such as those of other specular models.

    **Returns:** a sentence on the lowest level at which the two differ by more than
    `DIFFER`; `""` if there is none.
    """
    value, error = (float(number) for number in fit[found.label][:2])
    if not np.isfinite(error) or error <= 0:
        return ""
    for level, (low, high) in sorted(found.intervals.items()):
        reach = student_reach(level, fit.degrees_of_freedom) * error
        widths = np.array([value - low, high - value]) / reach
        difference = float(np.abs(widths - 1).max())
        if difference > DIFFER:
            wider = "±" if widths.max() < 1 else "the profile's interval"
            start, middle, end = (
                number_with_error(number, error) for number in (low, value, high)
            )
            return (
                f"The profile's interval, {start} … {end} ({100 * level:.3g} %), and "
                f"{middle} ± {reach:.2g} differ by up to {100 * difference:.0f} %. "
                f"Quote {wider}."
            )
    return ""


def _draw_pair(axes: Axes, found: ProfilePair) -> None:
    levels = sorted(found.thresholds.items(), key=lambda item: item[1])
    heights = [0.0, *(height for _, height in levels)]
    x, y = found.values
    shades = [ACCENT, "#5aa5d1", "#b4d6ea"][: len(levels)]
    axes.contourf(x, y, found.rise.T, heights, colors=shades)
    lines = axes.contour(x, y, found.rise.T, heights[1:], colors=INK, linewidths=0.8)
    words = {h: f"{100 * level:.3g} %" for level, h in levels}
    axes.clabel(lines, fmt=words, fontsize=7)
    row, column = np.unravel_index(np.argmin(found.rise), found.rise.shape)
    axes.plot(x[row], y[column], "+", color="white", markersize=9)
    axes.set_xlabel(f"{found.labels[0]}  ({unit(found.labels[0])})")
    axes.set_ylabel(f"{found.labels[1]}  ({unit(found.labels[1])})")
    axes.set_title("where the truth lies, with which chance")


def plot_profile(fit: Fit, name: str, other: str | None = None) -> Figure:
    """A figure of the profile of one unknown with its intervals, or of a pair.

    The unknown is fixed at values around its estimate and all others are fitted again:
    see [`Fit`][]`.profile`. If the curve differs from the dashed parabola, the standard
    error is a poor description of the uncertainty.

    **Raises:** `ValueError` for a name that was not free.
    """
    found = fit.profile(name, other)
    with styled():
        figure = picture(4.8, 3.4 if other is None else 4.2)
        axes = figure.subplots()
        if other is None:
            draw_profile(axes, fit, found)
        else:
            _draw_pair(axes, found)
    return figure
