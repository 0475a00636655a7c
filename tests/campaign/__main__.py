"""`python -m tests.campaign --cases N [--seed S] [--only KIND …] [--case K]`.

Prints how many cases of each kind were taken and refused, and every fault with the
command that repeats it. Exit status 1 if there is one.
"""

import argparse
import collections
import concurrent.futures
import datetime
import importlib
import multiprocessing
import os
import pkgutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import phongfit as pf
from tests.campaign import kinds
from tests.campaign.cases import Kind
from tests.campaign.judge import Verdict, judge, numbered

CHUNK = 500
"""Cases of one worker: starting JAX in it takes as long as a hundred of them."""


def load_kinds() -> dict[str, Kind]:
    """Every kind by the name of its module; what they call is imported once for all."""
    for name in dir(pf):
        getattr(pf, name)
    names = sorted(module.name for module in pkgutil.iter_modules(kinds.__path__))
    modules = {n: importlib.import_module(f"{kinds.__name__}.{n}") for n in names}
    return {name: m.KIND for name, m in modules.items() if hasattr(m, "KIND")}


def chunks(
    chosen: dict[str, Kind], cases: int, case: int | None, workers: int
) -> Iterator[tuple[str, range]]:
    """Numbers of the cases of each kind, in portions."""
    whole = sum(kind.share for kind in chosen.values())
    for name, kind in chosen.items():
        if case is not None:
            yield name, range(case, case + 1)
            continue
        count = max(round(cases * kind.share / whole), 1)
        chunk = max(min(CHUNK, -(-count // workers)), 1)
        for start in range(0, count, chunk):
            yield name, range(start, min(start + chunk, count))


def run(
    chosen: dict[str, Kind],
    cases: int,
    seed: int,
    case: int | None = None,
    workers: int = 1,
    slowest: bool = False,
) -> int:
    """Judge cases and print what came of them; how many faults there are."""
    with tempfile.TemporaryDirectory(prefix="campaign-stock-") as stock:
        _prepare(chosen, Path(stock))
        found: dict[str, list[Verdict]] = {name: [] for name in chosen}
        context = multiprocessing.get_context("fork")
        with concurrent.futures.ProcessPoolExecutor(workers, context) as pool:
            portions = {
                pool.submit(_portion, name, chosen[name], seed, numbers, stock): name
                for name, numbers in chunks(chosen, cases, case, workers)
            }
            for portion in concurrent.futures.as_completed(portions):
                found[portions[portion]] += portion.result()
    for name, verdicts in found.items():
        _print_counts(name, verdicts, slowest)
    faults = [(n, v) for n, verdicts in found.items() for v in verdicts if v.fault]
    _print_faults(faults, seed)
    return len(faults)


def _portion(
    name: str, kind: Kind, seed: int, numbers: range, stock: str
) -> list[Verdict]:
    return list(judge(numbered(name, kind, seed, Path(stock)), kind, numbers))


def _prepare(chosen: dict[str, Kind], stock: Path) -> None:
    """Let kinds fill the stock, in a process that takes JAX with it when it ends."""
    os.environ["PHONGFIT_CACHE"] = str(stock / "compiled")
    os.environ["MPLCONFIGDIR"] = str(stock / "matplotlib")
    context = multiprocessing.get_context("fork")
    wanted = [kind.prepare for kind in chosen.values() if kind.prepare is not None]
    if wanted:
        with concurrent.futures.ProcessPoolExecutor(1, context) as pool:
            pool.submit(_fill, wanted, stock).result()


def _fill(wanted: list, stock: Path) -> None:
    for prepare in wanted:
        prepare(stock)


def _print_counts(name: str, verdicts: list[Verdict], slowest: bool) -> None:
    taken = sum(verdict.taken for verdict in verdicts)
    faults = sum(verdict.fault is not None for verdict in verdicts)
    seconds = max(verdict.seconds for verdict in verdicts)
    megabytes = max(verdict.megabytes for verdict in verdicts)
    print(
        f"{name:<16}{len(verdicts):>8} cases{taken:>8} taken"
        f"{len(verdicts) - taken - faults:>8} refused{faults:>6} faults"
        f"   ≤ {seconds:.1f} s, {megabytes:.0f} MB"
    )
    if slowest:
        for verdict in sorted(verdicts, key=lambda v: -v.seconds)[:5]:
            print(f"  {verdict.seconds:6.2f} s  {verdict.number}: {verdict.name}")
        for verdict in sorted(verdicts, key=lambda v: -v.megabytes)[:5]:
            print(f"  {verdict.megabytes:6.0f} MB {verdict.number}: {verdict.name}")


def _print_faults(faults: list[tuple[str, Verdict]], seed: int) -> None:
    """Each sort of fault once, with how often it came and how to see it again."""
    sorts = collections.defaultdict(list)
    for name, verdict in faults:
        sorts[name, str(verdict.fault)[:40]].append(verdict)
    for (name, _), verdicts in sorts.items():
        first = verdicts[0]
        print(f"\n{len(verdicts)} × {name}: {first.name}\n  {str(first.fault)[:600]}")
        print(
            f"  python -m tests.campaign --only {name} --seed {seed} "
            f"--case {first.number}"
        )


def main() -> int:
    known = load_kinds()
    parser = argparse.ArgumentParser(prog="python -m tests.campaign")
    parser.add_argument("--cases", type=int, default=2000, help="how many in all")
    parser.add_argument("--seed", type=int, help="default: another one each day")
    parser.add_argument("--only", nargs="+", choices=sorted(known), metavar="KIND")
    parser.add_argument("--case", type=int, help="this one alone of each kind")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--slowest", action="store_true", help="show costly cases")
    options = parser.parse_args()
    chosen = {name: known[name] for name in options.only or known}
    seed = options.seed
    if seed is None:
        seed = datetime.date.today().toordinal()
    print(f"seed {seed}, {', '.join(chosen)}", flush=True)
    numbers = options.cases, seed, options.case, options.workers
    return int(run(chosen, *numbers, options.slowest) > 0)


if __name__ == "__main__":
    sys.exit(main())
