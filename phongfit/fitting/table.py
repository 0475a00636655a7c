"""A fit as text, as users of lmfit like it."""

import textwrap
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from phongfit.fitting.result import Fit


def fit_table(fit: "Fit", least_correlation: float = 0.1, most: int = 10) -> str:
    """Value ± standard error, correlations and warnings, for a fixed-width font."""
    rows = parameter_rows(fit.labels, fit.values, fit.errors, fit.at_bound, fit.untold)
    for k, words in lopsided(fit).items():
        rows[k + 1] += f"  {words}"
    lines = [*_head(fit), "", *rows]
    correlations = _correlations(fit, least_correlation, most)
    if correlations:
        title = f"correlations (of those ≥ {least_correlation:g}, the largest {most})"
        lines += ["", title, *correlations]
    if fit.warnings:
        lines += ["", "warnings"]
        for warning in fit.warnings:
            lines += textwrap.wrap(
                warning, 86, initial_indent="  ! ", subsequent_indent="    "
            )
    return "\n".join(lines)


def lopsided(fit: "Fit") -> dict[int, str]:
    """Errors up and down in words, where one is more than a fifth larger."""
    told = np.flatnonzero(~fit.untold & ~fit.at_bound)
    sides = fit.sides[told]
    return {
        int(k): f"+{up:.2g} −{down:.2g}"
        for k, (down, up) in zip(told, sides, strict=True)
        if max(down, up) > 1.2 * min(down, up)
    }


def _head(fit: "Fit") -> list[str]:
    images = f"{fit.images} image" + ("s" if fit.images > 1 else "")
    noise, size = "estimated", fit.misfit.over_repeatability
    judged = f", residuals {size:.3g} × repeatability" if size == size else ""
    if fit.noise_given:
        noise, judged = "given", f", reduced χ² {fit.reduced_chi_squared:.4g}"
    if fit.misfit.noise_differs:
        noise += ", not the same everywhere"
    state = "converged" if fit.converged else "NOT CONVERGED"
    return [
        f"phongfit: {images}, {fit.samples:,} samples, {fit.model}, {fit.film}",
        f"  {state} after {fit.steps} steps: {fit.reason}",
        f"  loss {fit.loss}, noise {fit.noise:.3g} ({noise}){judged}",
    ]


def parameter_rows(
    labels: tuple[str, ...],
    values: np.ndarray,
    errors: np.ndarray,
    at_bound: np.ndarray,
    untold: np.ndarray,
) -> list[str]:
    """A heading, and a line for each parameter."""
    width = max(len(label) for label in labels)
    rows = [f"  {'':<{width}}  {'value':>12}  {'std. error':>12}  {'%':>8}"]
    for label, value, error, bound, open_ in zip(
        labels, values, errors, at_bound, untold, strict=True
    ):
        row = f"  {label:<{width}}  {number_with_error(value, error):>12}"
        if open_:
            row += "   ± ∞  cannot be told"
        else:
            share = f"{100 * error / abs(value):8.2g}" if value else f"{'–':>8}"
            row += f"  ±{error:>11.2g}  {share}"
            row += "  at its bound" if bound else ""
        rows.append(row)
    return rows


def number_with_error(value: float, error: float) -> str:
    """`value` to the digit where its error begins, and one more."""
    if not np.isfinite(error) or error <= 0:
        return f"{value:.5g}"
    digits = int(np.clip(1 - np.floor(np.log10(error)), 0, 9))
    return f"{value:.{digits}f}"


def _correlations(fit: "Fit", least: float, most: int) -> list[str]:
    matrix = fit.correlation
    pairs = [
        (matrix[i, j], fit.labels[i], fit.labels[j])
        for i in range(len(fit.labels))
        for j in range(i)
        if abs(matrix[i, j]) >= least and not (fit.tied[i] or fit.tied[j])
    ]
    pairs.sort(key=lambda pair: -abs(pair[0]))
    width = max(len(label) for label in fit.labels)
    return [f"  {a:<{width}}  {b:<{width}}  {c:+.3f}" for c, a, b in pairs[:most]]
