"""Plots of a fit's residuals, for comparison with pure noise."""

import numpy as np
import scipy.stats
from jaxtyping import Float
from matplotlib.axes import Axes

from phongfit.fitting.problem.problem import evaluate
from phongfit.fitting.result import Fit
from phongfit.report.style import CHANNELS, INK, PALE, SIGNED, quiet, say, scale

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
    scale(axes, shown, "σ of independent noise")
