"""Tables and summaries of the verdicts on situations."""

from collections.abc import Sequence

import numpy as np
from rich.markup import escape
from rich.table import Table

from experiments.honesty.campaign import Row, count_false_alarms, pooled_faults
from experiments.honesty.judge import Verdict

# Without titles: the name, its kind, and the verdict.
COLUMNS = (
    "",
    "",
    "coverage",
    "at bounds",
    "beside",
    "worst",
    "pulls",
    "warned",
    "> 5 σ",
    "silently",
    "open",
    "",
)
LEGEND = """\
coverage: fraction of 95 % intervals that contain the truth, in draws without a warning
about the fit; at bounds: of parameters at a bound; beside: of the other parameters of
such draws; worst: of the parameter with the lowest. pulls: RMS of (estimate − truth) /
error. warned: draws with a warning about the fit. > 5 σ: draws with an estimate that
far off; silently: those without a warning. open: parameters with an infinite error."""


def table(rows: Sequence[Row], bits: int) -> Table:
    """A table of the rows of one precision, 32 or 64 bits."""
    result = Table(title=f"float{bits}", title_justify="left")
    for at, column in enumerate(COLUMNS):
        last = at == len(COLUMNS) - 1
        result.add_column(column, justify="left" if at < 2 or last else "right")
    for row in rows:
        if row.bits == bits:
            style = None if row.passed else "red"
            result.add_row(*map(escape, cells(row)), style=style)
    return result


def cells(row: Row) -> tuple[str, ...]:
    """The cells of a row, in the order of `COLUMNS`."""
    v = row.verdict
    return (
        row.name,
        row.kind,
        percent(v.coverage, 1),
        percent(v.at_bound, 1),
        percent(v.beside_bound, 1),
        percent(v.worst),
        "–" if np.isnan(v.pulls) else f"{v.pulls:.2f}",
        percent(v.warned),
        percent(v.far),
        percent(v.misled),
        percent(v.infinite),
        verdict_word(v),
    )


def verdict_word(verdict: Verdict) -> str:
    """The verdict in a word: RED for a fault, otherwise its notes, or ok."""
    return "RED" if verdict.faults else ", ".join(verdict.notes) or "ok"


def percent(fraction: float, digits: int = 0) -> str:
    """A fraction in per cent, without the sign; a dash for NaN, 0 without digits."""
    if np.isnan(fraction):
        return "–"
    return f"{100 * fraction:.{digits}f}" if fraction else "0"


def summary(rows: Sequence[Row]) -> list[str]:
    """Lines with the faults of each row, and the rate of false alarms."""
    lines = []
    for row in rows:
        for fault in row.verdict.faults:
            lines.append(f"  ! float{row.bits}, {row.name}: {fault}")
    lines += [f"  ! {fault}" for fault in pooled_faults(rows)]
    for bits in sorted({row.bits for row in rows}):
        alarms, draws = count_false_alarms(rows, bits)
        chosen = [row for row in rows if row.bits == bits]
        red = sum(not row.passed for row in chosen)
        seconds = sum(row.seconds for row in chosen)
        lines.append(
            f"float{bits}: {len(chosen)} situations in {seconds:.0f} s, {red} red; "
            f"{alarms} false alarms in {draws} draws of right models"
        )
    return lines
