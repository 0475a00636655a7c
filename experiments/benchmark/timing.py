"""Median times of functions."""

import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np

# A function is run at least `FEWEST` times, and not again after `ENOUGH` seconds.
FEWEST, ENOUGH = 3, 5.0
# OpenBLAS's threads go on spinning for a tenth of a second after work such as the QR
# factorisation of a stock solver, and slow down whatever follows.
SETTLED = 0.2


def seconds(work: Callable[[], object], runs: int = 3) -> float:
    """Median seconds of `runs` runs, after one that compiles, until results exist."""
    work()
    return float(np.median([_timed(work)[0] for _ in range(runs)]))


def medians(
    functions: dict[str, Callable[[], Any]], runs: int
) -> dict[str, tuple[float, Any]]:
    """Median time and last result of each function, taking turns after two runs each.

    In its turn a function is run for 0.2 seconds, and only its last run counts: until
    then threads of the previous function may be busy. A function that has taken five
    seconds in all has no more turns after its third.
    """
    for function in functions.values():
        for _ in range(2):
            function()
    times: dict[str, list[float]] = {key: [] for key in functions}
    results = {}
    for _ in range(runs):
        for key, function in functions.items():
            if len(times[key]) >= FEWEST and sum(times[key]) > ENOUGH:
                continue
            taken, results[key] = _turn(function)
            times[key].append(taken)
    return {key: (float(np.median(times[key])), results[key]) for key in functions}


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
