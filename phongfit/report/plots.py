"""Figures of a fit, for `fit.plot()` and similar methods."""

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np
import scipy.stats
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from phongfit.fitting.problem.problem import evaluate
from phongfit.fitting.result import Fit
from phongfit.fitting.uncertainty.convergence import Convergence
from phongfit.report.pictures import Row, Title, comparison, draw_residual
from phongfit.report.style import (
    ACCENT,
    CHANNELS,
    INK,
    PALE,
    SIGNED,
    picture,
    quiet,
    say,
    scale,
    styled,
)
from phongfit.report.words import as_tuple

MOST_IMAGES = 4
MOST_UNKNOWNS = 24


def chosen(count: int, most: int = MOST_IMAGES) -> list[int]:
    """Indices of at most `most` images to show, evenly spaced from first to last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(int)).tolist()


def brightening(photographs: Iterable[np.ndarray]) -> float:
    """Factor that brings the brightest of dark photographs to white; never below 1."""
    used = (np.nan_to_num(image, nan=0.0) for image in photographs)
    brightest = max(float(np.quantile(image, 0.995)) for image in used)
    return 1.0 if brightest > 0.5 else min(1 / max(brightest, 1e-3), 1e3)


def names_of(fit: Fit, names: Sequence[Title]) -> list[str]:
    """A name for each image: those given, or a number.

    **Raises:** `ValueError` if there are names, but not one for each image.
    """
    names = list(names)
    if names and len(names) != fit.n_images:
        raise ValueError(
            f"names: expected {fit.n_images}, one an image, got {len(names)}"
        )
    if names:
        return [str(name) for name in names]
    return [""] if fit.n_images == 1 else [f"image {k}" for k in range(fit.n_images)]


def plot(fit: Fit, names: Sequence[Title] = (), most: int = MOST_IMAGES) -> Figure:
    """A figure of photograph, fit and residual of some images.

    **Arguments:**

    - `names`: of the images, shown above them; default their numbers.
    - `most`: maximum number of images, spread evenly over all.

    **Raises:** `ValueError` if there are names, but not one for each image.
    """
    return compared(rows_of(fit, names, most))


def rows_of(fit: Fit, names: Sequence[Title], most: int = MOST_IMAGES) -> list[Row]:
    """Some images of a fit; arguments and errors are those of [`plot`][]."""
    every = names_of(fit, names)
    target, fitted, left = map(as_tuple, (fit.photographs, fit.fitted, fit.residuals))
    images = chosen(fit.n_images, most)
    return [Row(target[k], fitted[k], left[k], every[k]) for k in images]


def compared(rows: Sequence[Row]) -> Figure:
    """A figure of photograph, fit and residual; dark photographs are brightened."""
    factor = brightening(row.target for row in rows)
    brighter = f"  (shown {factor:.2g} × brighter)" if factor > 1 else ""
    titled = [
        dataclasses.replace(row, title=f"{row.title}{brighter}".strip()) for row in rows
    ]
    return comparison(titled, ("photograph", "fit"), brighten=factor)


WIDEST = 5.0
"""Limits of histograms, in standard deviations."""
BANDS = 16
"""Number of bands of light, with equally many samples each."""


def residuals(
    fit: Fit,
) -> list[tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]]:
    """For each channel the light of the fit, and photograph − fit in units of σ.

    σ is that of each sample, from noise, rounding and its weight.
    """
    problem = fit.solution.problem
    found = evaluate(problem, fit.solution.y)
    used = np.asarray(problem.samples.weight) > 0
    light = np.asarray(found.difference) + np.asarray(problem.samples.target)
    in_sigma = -np.asarray(found.residual)
    return [
        (light[channel, mask], in_sigma[channel, mask])
        for channel, mask in enumerate(used)
    ]


def draw_histogram(axes: Axes, fit: Fit) -> None:
    """Draw a histogram of the residuals, with the normal curve of pure noise."""
    found = residuals(fit)
    edges = np.linspace(-WIDEST, WIDEST, 81)
    for (_, values), (name, colour) in zip(found, CHANNELS.items(), strict=True):
        if values.size:
            count, _ = np.histogram(values, edges)
            share = count / values.size / np.diff(edges)
            axes.stairs(share, edges, color=colour, label=name, linewidth=1.2)
    at = np.linspace(-WIDEST, WIDEST, 201)
    axes.plot(at, scipy.stats.norm.pdf(at), "--", color=INK, label="pure noise")
    every = np.concatenate([values for _, values in found])
    beyond = float(np.mean(np.abs(every) > WIDEST))
    axes.set_xlim(-WIDEST, WIDEST)
    axes.set_ylim(0)
    axes.set_xlabel("(photograph − fit) / σ")
    axes.set_ylabel("share of samples per σ")
    axes.set_title(f"{100 * beyond:.2g} % of samples lie beyond ±{WIDEST:g} σ")
    axes.legend(loc="upper right")


def draw_against_level(axes: Axes, fit: Fit) -> None:
    """Draw mean and spread of the residuals in bands of the light of the fit."""
    for (light, values), (name, colour) in zip(
        residuals(fit), CHANNELS.items(), strict=True
    ):
        if not light.size:
            continue
        # Uniform light gives a single band.
        edges = np.unique(np.quantile(light, np.linspace(0, 1, BANDS + 1)))[1:-1]
        band, bands = np.searchsorted(edges, light, "right"), len(edges) + 1
        count = np.bincount(band, minlength=bands)
        # The spread of very few samples is meaningless.
        full = count >= max(0.01 * light.size, 10)
        many = np.maximum(count, 1)
        at, mean, square = (
            np.bincount(band, numbers, bands) / many
            for numbers in (light, values, values**2)
        )
        spread = np.sqrt(np.maximum(square - mean**2, 0))
        axes.plot(at[full], mean[full], "o-", color=colour, markersize=3, label=name)
        for edge in (mean - spread, mean + spread):
            axes.plot(at[full], edge[full], ":", color=colour, linewidth=1)
    axes.axhline(0, color=INK, linewidth=0.8)
    for one in (-1, 1):
        axes.axhline(one, color=PALE, linewidth=0.8, linestyle="--")
    axes.set_xlabel("light of the fit (linear, white = 1)")
    axes.set_ylabel("(photograph − fit) / σ")
    axes.set_title("mean (solid), ± spread (dotted)")
    # Make room for the legend above the spread.
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.2 * (high - low))
    axes.legend(loc="upper center", ncols=3)


def draw_blocks(axes: Axes, fit: Fit, image: int) -> None:
    """Draw residuals of one image summed over blocks: large sums are not noise."""
    quiet(axes)
    misfit = fit.misfit
    if not misfit.maps:
        return say(axes, "nothing but rounding\nis left over")
    found = misfit.maps[image]
    # Scale of at least WIDEST, so that pure noise is pale.
    most = max(WIDEST, *(float(np.abs(one).max()) for one in misfit.maps))
    shown = axes.imshow(found, cmap=SIGNED, vmin=-most, vmax=most)
    axes.set_title(f"sums of {misfit.side} × {misfit.side} pixels")
    # A wider gap leaves no room for the pictures of six photographs.
    scale(axes, shown, "σ of independent noise", pad=0.02)


def plot_residuals(fit: Fit) -> Figure:
    """A figure of the residuals: histogram, mean by light, images, sums over blocks.

    In standard deviations of each sample; the images in linear light. Pure noise
    follows the dashed lines, and the object is then invisible in images and sums.
    """
    images = chosen(fit.n_images)
    left = as_tuple(fit.residuals)
    alone = len(images) == 1
    with styled():
        figure = picture(8.5, 6.4) if alone else picture(9.5, 8.4)
        rows, columns = (2, 2) if alone else (3, 12)
        grid = figure.add_gridspec(rows, columns, height_ratios=[1.3, 1, 1][:rows])
        half, width = (
            columns // 2,
            columns // (2 * len(images) if alone else len(images)),
        )
        draw_histogram(figure.add_subplot(grid[0, :half]), fit)
        draw_against_level(figure.add_subplot(grid[0, half:]), fit)
        for at, k in enumerate(images):
            column = slice(at * width, (at + 1) * width)
            of = "" if alone else f", image {k}"
            axes = figure.add_subplot(grid[1, column])
            draw_residual(axes, left[k])
            axes.set_title("photograph − fit" + of)
            quiet(axes)
            axes = figure.add_subplot(grid[1, 1] if alone else grid[2, column])
            draw_blocks(axes, fit, k)
    return figure


def shown_unknowns(fit: Fit) -> list[int]:
    """Indices of the unknowns with correlations; if many, those with the largest."""
    known = np.isfinite(np.diag(fit.covariance))
    free = np.flatnonzero(fit.identified & known & ~fit.tied)
    if len(free) <= MOST_UNKNOWNS:
        return free.tolist()
    matrix = np.abs(fit.correlation[np.ix_(free, free)])
    np.fill_diagonal(matrix, 0)
    largest = np.argsort(-np.nanmax(matrix, axis=0))[:MOST_UNKNOWNS]
    return free[np.sort(largest)].tolist()


def draw_correlations(axes: Axes, fit: Fit) -> None:
    """Draw the matrix of correlations, with numbers for at most 12 unknowns."""
    entries = shown_unknowns(fit)
    labels = [fit.labels[k] for k in entries]
    matrix = fit.correlation[np.ix_(entries, entries)]
    quiet(axes)
    if len(entries) < 2:
        words = "fewer than two unknowns are identified:\nthere is nothing to correlate"
        return say(axes, words)
    shown = axes.imshow(matrix, cmap=SIGNED, vmin=-1, vmax=1)
    axes.set_xticks(range(len(labels)), labels, rotation=90, fontsize=8)
    axes.set_yticks(range(len(labels)), labels, fontsize=8)
    axes.tick_params(length=0)
    scale(axes, shown, "correlation")
    if len(labels) <= 12:
        for (row, column), value in np.ndenumerate(matrix):
            colour = "white" if abs(value) > 0.6 else INK
            words = f"{value:.2f}".replace("0.", ".").replace("-", "−")
            words = "0" if words.strip("−") == ".00" else words
            words = "1" if row == column else words
            axes.text(
                column, row, words, ha="center", va="center", color=colour, fontsize=7
            )


def plot_correlations(fit: Fit) -> Figure:
    """A figure of the correlations: pairs near ±1 are determined only in combination.

    Unknowns at a bound, or not identified, have no correlations and are left out. If
    there are many, those with the largest correlations are shown.
    """
    side = 2.6 + 0.33 * max(len(shown_unknowns(fit)), 3)
    with styled():
        figure = picture(side + 0.6, side)
        draw_correlations(figure.subplots(), fit)
    return figure


def draw_convergence(axes: Axes, convergence: Convergence) -> None:
    """Draw the excess of each step's cost over the least cost."""
    least = min(convergence.least, float(np.nanmin(convergence.costs)))
    above = np.maximum(convergence.costs - least, 1e-3)
    axes.semilogy(range(len(above)), above, "o-", color=ACCENT, markersize=4)
    axes.axhline(1, color=INK, linewidth=0.8, linestyle="--")
    axes.text(
        0.99,
        1.15,
        "within about a standard error",
        transform=axes.get_yaxis_transform(),
        ha="right",
        va="bottom",
        fontsize=7.5,
    )
    axes.set_ylim(5e-4, max(float(np.nanmax(above)) * 3, 20))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("step of the solver, from the best of the scan")
    axes.set_ylabel("χ² above the least")
