"""Question: do the numbers hold, and is there a warning wherever they do not?

Many situations that users meet are drawn many times each: kinds of scenes, noise,
files, losses, unknowns, maps, with right and wrong models. For each one the experiment
counts how often 95 % intervals contain the truth. It also checks that there is a
warning whenever an answer misleads, and none if the model is right.
`experiments/honesty/judge.py` has the criteria.
"""

import contextlib
import dataclasses
import sys
from typing import Annotated

import jax
import tyro
from rich.console import Console
from rich.progress import track

from experiments.honesty.campaign import (
    OtherPrecision,
    Precision,
    Row,
    own_bits,
    pooled_faults,
    run_situation,
)
from experiments.honesty.situations import all_situations
from experiments.honesty.situations.base import Situation
from experiments.honesty.table import LEGEND, summary, table
from experiments.output import JsonFile, check_outputs, save_numbers
from phongfit.cli import run

# Number of draws with `--small`.
FEW = 20
# Letters in a line of the table, if it is not printed to a terminal.
WIDTH = 140


def main(
    small: bool = False,
    draws: int | None = None,
    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME…")] = (),
    precision: Precision = "both",
    seed: int = 0,
    json: JsonFile = None,
) -> int:
    """Do the numbers hold, and is there a warning wherever they do not?

    Runs many situations, draw by draw, in single and in double precision, and prints a
    table of stated errors and warnings next to the truth. Exit status 1 if a situation
    fails.

    Args:
        small: 20 draws: coarse.
        draws: Number of draws of each situation; default 100. A draw of maps has 100
            pixels.
        only: Situations with such a name, or whose names contain it; default all.
        precision: Bits of floating-point numbers: one of them, or both side by side.
        seed: Seed of the draws.
        json: File for the numbers.
    """
    count = (FEW if small else 100) if draws is None else draws
    if count < 1:
        raise ValueError("draws: expected a whole number ≥ 1")
    check_outputs(None, json)
    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDTH)
    own_precision = own_bits()
    wanted = (32, 64) if precision == "both" else (int(precision),)
    chosen = select(all_situations(), only)
    rows: list[Row] = []
    with contextlib.ExitStack() as stack:
        others = [
            stack.enter_context(OtherPrecision(bits, only, count, seed))
            for bits in wanted
            if bits != own_precision
        ]
        if own_precision in wanted:
            quiet = not console.is_terminal
            for situation in track(
                chosen, "situations", console=console, disable=quiet
            ):
                rows.append(run_situation(situation, count, seed))
                if quiet:
                    print(rows[-1].in_one_line(), file=sys.stderr, flush=True)
                # Compiled programs would add up to more memory maps than Linux allows.
                jax.clear_caches()
        for other in others:
            rows += other.rows()
    for bits in wanted:
        console.print(table(rows, bits))
    console.print(LEGEND, markup=False, highlight=False)
    for line in summary(rows):
        console.print(line, markup=False, highlight=False)
    save_numbers(
        json,
        {"draws": count, "seed": seed, "rows": list(map(dataclasses.asdict, rows))},
    )
    return 0 if all(row.passed for row in rows) and not pooled_faults(rows) else 1


def select(situations: list[Situation], only: tuple[str, ...]) -> list[Situation]:
    """Situations chosen by their names.

    **Arguments:** `only`: each entry chooses the situation of that name, or if there is
    none those whose names contain it. Empty: all.

    **Raises:** `ValueError` for an entry that no name contains.
    """
    if not only:
        return situations
    names = {situation.name for situation in situations}
    for part in only:
        if not any(part in name for name in names):
            raise ValueError(f"only: no situation's name holds {part!r}")
    return [
        situation
        for situation in situations
        if any(
            part == situation.name or (part not in names and part in situation.name)
            for part in only
        )
    ]


if __name__ == "__main__":
    raise SystemExit(run(main, prog="python -m experiments.honesty"))
