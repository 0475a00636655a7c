"""The pictures of the page, each with an alternative text."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from phongfit.fitting.result import Fit
from phongfit.fitting.uncertainty.convergence import Convergence
from phongfit.fitting.uncertainty.diagnostics import Diagnostics
from phongfit.report.html import panel
from phongfit.report.pictures import Row, displayed, draw_residual
from phongfit.report.plots import (
    brightening,
    draw_against_level,
    draw_blocks,
    draw_convergence,
    draw_correlations,
    draw_histogram,
    shown_unknowns,
)
from phongfit.report.profiles import difference_words, draw_profile
from phongfit.report.style import picture, quiet
from phongfit.report.words import listed

Panel = dict[str, Any]
"""A picture of the page: see [`panel`][]."""


def _drawn(
    draw: Callable[[Axes], None],
    alt: str,
    caption: str = "",
    size: tuple[float, float] = (4.4, 3.1),
    **more: Any,
) -> Panel:
    """Draw one picture of the page, small enough for readable labels on a phone."""
    figure = picture(*size)
    draw(figure.subplots())
    return panel(figure, alt, caption, **more)


def pictures(rows: Sequence[Row], of: int) -> dict[str, Any]:
    """Photograph, fit and residual of some of `of` images, and an explanation."""
    factor = brightening(row.target for row in rows)
    words = ["Photograph and fit as a screen shows them (sRGB)"]
    if factor > 1:
        words.append(f", {factor:.2g} times brighter than they are")
    words.append("; the residual in linear light, the channel that is furthest off. ")
    words.append("Where a sample was left out, the residual is 0.")
    if len(rows) < of:
        words.append(f" Shown are {len(rows)} of {of}.")
    images = [_trio(row, factor) for row in rows]
    return {"images": images, "about_pictures": "".join(words)}


def _trio(row: Row, factor: float) -> Panel:
    of, residual = f" of {row.title}" if row.title else "", row.residual

    def left(axes: Axes) -> None:
        draw_residual(axes, residual, below=True)
        quiet(axes)

    wide, tall = _size(residual)
    used = residual[residual != 0]
    spread = float(np.sqrt(np.mean(used**2))) if used.size else 0.0
    words = f"Photograph minus fit{of}: root mean square {spread:.2g} of white."
    parts = [
        _image(factor * row.target, f"Photograph{of}.", "photograph"),
        _image(factor * row.fitted, f"The fit{of}, rendered.", "fit"),
        _drawn(left, words, "photograph − fit", (wide, tall + 0.55)),
    ]
    return {"name": row.title, "pictures": parts}


def _size(image: np.ndarray) -> tuple[float, float]:
    """Inches of an image in a row of three."""
    height, width = image.shape[:2]
    return 3.4, float(np.clip(3.4 * height / width, 1.2, 6))


def _image(image: np.ndarray, alt: str, caption: str) -> Panel:
    """An image without margins."""
    figure = picture(*_size(image), layout=None)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.imshow(displayed(image))
    quiet(axes)
    return panel(figure, alt, caption)


def profiles(fit: Fit, found: Diagnostics | None) -> tuple[list[Panel], str]:
    """Pictures of the available profiles, and a sentence on the others."""
    if found is None:
        return [], "Profiles were not asked for."
    wanted, labels = found.chosen, [one.label for one in found.profiles]
    if not wanted or not fit.converged:
        why = "the solver did not converge" if wanted else "no unknown is identified"
        return [], f"There are none: {why}."
    shown = []
    for one in found.profiles:
        low, high = one.intervals[min(one.intervals)]
        alt = (
            f"Profile of {one.label}: it lies between {low:.4g} and {high:.4g} (68 %)."
        )
        words = difference_words(fit, one)
        shown.append(_drawn(lambda axes, p=one: draw_profile(axes, fit, p), alt, words))
    free = fit.problem.unknowns.free_labels
    others = [label for label in wanted if label not in labels]
    others += [x for x in free if free.count(x) == 1 and x not in labels]
    if not others:
        return shown, ""
    about = f'In Python, fit.plot_profile("{others[0]}") draws that of another unknown.'
    if len(labels) < len(wanted):
        about = (
            f"{len(labels)} of {len(wanted)} are drawn, to spare minutes: a profile "
            f"solves the fit of all {fit.n_samples:,} samples some twenty times more. "
            f"{about} Without a profile, errors rest on the curvature at the estimate "
            "alone."
        )
    return shown, about


def correlations(fit: Fit) -> tuple[Panel | None, str]:
    """A picture of the correlations, if there are any, and the strongest in words."""
    entries = shown_unknowns(fit)
    if len(entries) < 2:
        return None, "Here fewer than two unknowns are identified, so there are none."
    matrix = fit.correlation[np.ix_(entries, entries)]
    lower = np.tril(matrix, -1)
    i, j = np.unravel_index(int(np.nanargmax(np.abs(lower))), lower.shape)
    strongest = (
        f"The strongest is {lower[i, j]:+.2f}, between {fit.labels[entries[i]]} and "
        f"{fit.labels[entries[j]]}."
    ).replace("-", "−")
    left_out = [label for k, label in enumerate(fit.labels) if k not in set(entries)]
    if left_out:
        strongest += f" Left out: {listed(left_out)}."
    side = 2.6 + 0.33 * len(entries)
    alt = f"Matrix of correlations of {len(entries)} unknowns. {strongest}"
    size = (side + 0.6, side)
    draw = functools.partial(draw_correlations, fit=fit)
    return _drawn(draw, alt, size=size, inches=size[0]), strongest


def residuals(fit: Fit) -> list[Panel]:
    """Pictures of the residuals: histogram, against light, and sums over blocks."""
    return [
        _drawn(
            lambda axes: draw_histogram(axes, fit),
            "Histogram of the residuals in standard deviations, with the normal curve.",
        ),
        _drawn(
            lambda axes: draw_against_level(axes, fit),
            "Mean and spread of the residuals against the light of the fit.",
        ),
        _drawn(
            lambda axes: draw_blocks(axes, fit, fit.misfit.image),
            f"Residuals of image {fit.misfit.image}, summed over blocks of "
            f"{fit.misfit.side} × {fit.misfit.side} pixels, in standard deviations: "
            f"{fit.misfit.significance:.2g} σ.",
        ),
    ]


def convergence(fit: Fit, found: Diagnostics | None) -> tuple[Panel | None, str]:
    """A picture of the cost by step, if available, and the solver's end in words."""
    end = f"The fit took {fit.steps} steps: {fit.reason}."
    if found is None:
        return None, end
    if found.convergence is None:
        return None, f"{end} Its course is not drawn: of so many samples it takes long."
    course = found.convergence
    if not np.isfinite(course.costs).all():
        return None, f"{end} Costs are not finite."
    steps = len(course.costs) - 1
    words = (
        f"{end} Below, one way down on all samples, from the best of a scan over the "
        "exponent; the fit itself begins with a few samples."
    )
    if _misses(course):
        words += (
            " It ends higher than the fit, which tries several ways where the scene "
            "is unknown."
        )
    alt = f"Cost above the least, step by step: {steps} steps."
    return _drawn(lambda axes: draw_convergence(axes, course), alt), words


def _misses(convergence: Convergence) -> bool:
    return float(convergence.costs[-1]) > convergence.least + 1
