"""Profiles drawn: how much worse a fit is where an unknown, or two, are held."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.interpolate import PchipInterpolator

from phongfit.fitting.result import Fit
from phongfit.fitting.uncertainty.profile import Profile, ProfilePair
from phongfit.report.style import ACCENT, INK, PALE, picture, styled
from phongfit.report.words import unit


def draw_profile(axes: Axes, fit: Fit, found: Profile) -> None:
    """Δχ² against one unknown: its intervals, and the parabola of its error."""
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
    for (level, (low, high)), shade in zip(
        found.intervals.items(), (0.22, 0.13, 0.07), strict=False
    ):
        axes.axvspan(low, high, color=ACCENT, alpha=shade, linewidth=0)
        inside = min(high, float(found.values[-1]))
        axes.text(inside, top, f"{100 * level:.3g} %", ha="right", va="top", fontsize=7)
    axes.set_ylim(0, top)
    axes.set_xlim(found.values[0], found.values[-1])
    axes.set_xlabel(f"{found.label}  ({unit(found.label)})")
    axes.set_ylabel("Δχ²: how much worse the fit is")
    # Above, where neither curve nor chances are.
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, borderaxespad=0.2)


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
    """The profile of one unknown with its intervals, or the regions of a pair.

    The unknown is held at values around its estimate and all others are fitted again:
    see [`Fit`][]`.profile`. Where the curve leaves the dashed parabola, the standard
    error does not say all.

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
