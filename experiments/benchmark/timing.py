"""Median wall-clock times of functions whose results are JAX arrays."""

import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np

# A function has at least `FEWEST` turns, and no more after `ENOUGH` seconds in all.
FEWEST, ENOUGH = 3, 5.0
# Seconds of a turn before the run that counts: OpenBLAS's threads go on spinning for a
# tenth of a second after work such as the QR factorisation of a stock solver, and slow
# down the next function.
SETTLED = 0.2


def seconds(work: Callable[[], object], runs: int = 3) -> float:
    """Median seconds of `runs` runs, after one that compiles.

    A run ends when its arrays are computed: JAX returns before that.
    """
    work()
    return float(np.median([_timed(work)[0] for _ in range(runs)]))


def medians(
    functions: dict[str, Callable[[], Any]], runs: int
) -> dict[str, tuple[float, Any]]:
    """Median seconds and last result of each function; the functions take turns.

    Before that each is run twice, to compile.

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
    """Run a function for `SETTLED` seconds; seconds and result of the last run."""
    begin = time.perf_counter()
    while True:
        timed = _timed(work)
        if time.perf_counter() - begin > SETTLED:
            return timed


def _timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of one run, until its arrays are computed, and its result."""
    begin = time.perf_counter()
    result = work()
    jax.block_until_ready(eqx.filter(result, eqx.is_array))
    return time.perf_counter() - begin, result
