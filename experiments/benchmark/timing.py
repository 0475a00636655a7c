"""How long work takes: medians."""

import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np

# Work of seconds is not timed as often as work of milliseconds.
FEWEST, ENOUGH = 3, 5.0
# OpenBLAS's threads go on spinning for a tenth of a second after work such as the QR
# factorisation of a stock solver, and slow down whatever follows.
SETTLED = 0.2


def seconds(work: Callable[[], object], runs: int = 3) -> float:
    """The median of some runs, after one that compiles; arrays are waited for."""
    work()
    return float(np.median([_timed(work)[0] for _ in range(runs)]))


def medians(
    ways: dict[str, Callable[[], Any]], runs: int
) -> dict[str, tuple[float, Any]]:
    """Median time and last result of each way, all taking turns after two warm runs.

    Of a turn the run is timed that ends after 0.2 seconds: by then what the way before
    has left behind is over. A way that has taken five seconds in all is left alone
    after its third turn.
    """
    for way in ways.values():
        for _ in range(2):
            way()
    times: dict[str, list[float]] = {key: [] for key in ways}
    results = {}
    for _ in range(runs):
        for key, way in ways.items():
            if len(times[key]) >= FEWEST and sum(times[key]) > ENOUGH:
                continue
            taken, results[key] = _turn(way)
            times[key].append(taken)
    return {key: (float(np.median(times[key])), results[key]) for key in ways}


def _turn(work: Callable[[], Any]) -> tuple[float, Any]:
    begin = time.perf_counter()
    while True:
        timed = _timed(work)
        if time.perf_counter() - begin > SETTLED:
            return timed


def _timed(work: Callable[[], Any]) -> tuple[float, Any]:
    begin = time.perf_counter()
    result = work()
    jax.block_until_ready(eqx.filter(result, eqx.is_array))
    return time.perf_counter() - begin, result
