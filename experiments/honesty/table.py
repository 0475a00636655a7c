"""Rows as a table, and in words."""

from collections.abc import Sequence

import numpy as np
from rich.markup import escape
from rich.table import Table

from experiments.honesty.campaign import Row, alarms_of, pooled_faults
from experiments.honesty.judge import Verdict

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
coverage: share of 95 % intervals that hold the truth, in draws without a warning about
the fit: of all numbers, of those at a bound, and of those beside them; worst: of one
parameter. pulls: RMS of (estimate − truth) / error. warned: draws with such a warning.
> 5 σ: draws with an estimate that far off; silently: without a warning. open: numbers
with an infinite error."""


def table(rows: Sequence[Row], bits: int) -> Table:
    """A table of the rows of one precision."""
    made = Table(title=f"float{bits}", title_justify="left")
    for at, column in enumerate(COLUMNS):
        last = at == len(COLUMNS) - 1
        made.add_column(column, justify="left" if at < 2 or last else "right")
    for row in rows:
        if row.bits == bits:
            style = None if row.fine else "red"
            made.add_row(*map(escape, cells(row)), style=style)
    return made


def cells(row: Row) -> tuple[str, ...]:
    """The cells of a row of the table."""
    v = row.verdict
    return (
        row.name,
        row.kind,
        percent(v.coverage, 1),
        percent(v.at_bound, 1),
        percent(v.beside, 1),
        percent(v.worst),
        "–" if np.isnan(v.pulls) else f"{v.pulls:.2f}",
        percent(v.doubted),
        percent(v.far),
        percent(v.misled),
        percent(v.silent),
        mark(v),
    )


def mark(verdict: Verdict) -> str:
    """The verdict in a word."""
    return "RED" if verdict.faults else ", ".join(verdict.notes) or "ok"


def percent(share: float, digits: int = 0) -> str:
    """A fraction in per cent; a dash for NaN."""
    if np.isnan(share):
        return "–"
    return f"{100 * share:.{digits}f}" if share else "0"


def summary(rows: Sequence[Row]) -> list[str]:
    """Lines with the faults of each row, and the rate of false alarms."""
    lines = []
    for row in rows:
        for fault in row.verdict.faults:
            lines.append(f"  ! float{row.bits}, {row.name}: {fault}")
    lines += [f"  ! {fault}" for fault in pooled_faults(rows)]
    for bits in sorted({row.bits for row in rows}):
        alarms, draws = alarms_of(rows, bits)
        own = [row for row in rows if row.bits == bits]
        red = sum(not row.fine for row in own)
        took = sum(row.seconds for row in own)
        lines.append(
            f"float{bits}: {len(own)} situations in {took:.0f} s, {red} red; "
            f"{alarms} false alarms in {draws} draws of right models"
        )
    return lines
