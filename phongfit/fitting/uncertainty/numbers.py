"""Numbers with their errors, as text."""

import numpy as np


def parameter_rows(
    labels: tuple[str, ...],
    values: np.ndarray,
    errors: np.ndarray,
    at_bound: np.ndarray,
    unidentified: np.ndarray,
) -> list[str]:
    """A heading, and a line for each parameter."""
    width = max(len(label) for label in labels)
    rows = [f"  {'':<{width}}  {'value':>12}  {'std. error':>12}  {'%':>8}"]
    for label, value, error, bound, open_ in zip(
        labels, values, errors, at_bound, unidentified, strict=True
    ):
        row = f"  {label:<{width}}  {number_with_error(value, error):>12}"
        if open_:
            row += "   ± ∞  not identifiable"
        else:
            share = f"{100 * error / abs(value):8.2g}" if value else f"{'–':>8}"
            row += f"  ±{error:>11.2g}  {share}"
            row += "  at its bound" if bound else ""
        rows.append(row)
    return rows


def number_with_error(value: float, error: float) -> str:
    """`value`, rounded to the second significant digit of its error."""
    if not np.isfinite(error) or error <= 0:
        return f"{value:.5g}"
    digits = int(np.clip(1 - np.floor(np.log10(error)), 0, 9))
    return f"{value:.{digits}f}"
