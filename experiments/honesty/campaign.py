"""Runs of situations, in one floating-point precision or in both at a time."""

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from experiments.honesty.chance import too_many
from experiments.honesty.judge import MAX_FALSE_ALARMS, RIGHT_KINDS, Verdict, judge
from experiments.honesty.situations.base import Situation

Precision = Literal["32", "64", "both"]
LEAST = 2
"""Least number of draws of a situation that takes a fraction of them."""


@dataclasses.dataclass(frozen=True)
class Row:
    """Verdict on one situation in one precision, and the seconds that it took.

    `bits` is the precision: 32 or 64.
    """

    name: str
    kind: str
    bits: int
    seconds: float
    verdict: Verdict

    @property
    def passed(self) -> bool:
        """Whether the situation passes all checks."""
        return not self.verdict.faults

    def in_one_line(self) -> str:
        """Name, seconds and faults."""
        found = "; ".join(self.verdict.faults) or "ok"
        return f"float{self.bits}, {self.seconds:.0f} s: {self.name}: {found}"


def own_bits() -> int:
    """Number of bits of this process's floats, 32 or 64."""
    return 64 if jnp.result_type(float) == jnp.float64 else 32


def run_situation(situation: Situation, draws: int, seed: int) -> Row:
    """Run one situation; each draw has its own generator, independent of the others.

    **Arguments:** `draws`: number of draws of situations with `draw_fraction` 1.
    """
    began = time.perf_counter()
    count = max(round(draws * situation.draw_fraction), min(draws, LEAST))
    # `hash` of a text would differ from process to process.
    key = zlib.crc32(situation.name.encode())
    rngs = [np.random.default_rng((seed, key, draw)) for draw in range(count)]
    verdict = judge(
        situation.answer(rngs),
        situation.kind,
        situation.unidentifiable,
        situation.wide,
        situation.required_warning,
    )
    seconds = time.perf_counter() - began
    return Row(situation.name, situation.kind, own_bits(), seconds, verdict)


def pooled_faults(rows: Sequence[Row]) -> tuple[str, ...]:
    """A sentence for each precision with too many false alarms.

    All draws of right models count together.
    """
    sentences = []
    for bits in sorted({row.bits for row in rows}):
        alarms, draws = count_false_alarms(rows, bits)
        if draws and too_many(alarms, draws, MAX_FALSE_ALARMS):
            sentences.append(
                f"float{bits}: {alarms} false alarms in {draws} draws of right models"
            )
    return tuple(sentences)


def count_false_alarms(rows: Iterable[Row], bits: int) -> tuple[int, int]:
    """Number of false alarms, and of draws of right models, in one precision.

    Situations whose name begins with "maps" are left out: their draws are pixels, which
    would outnumber the others.
    """
    right = [
        row.verdict
        for row in rows
        if row.bits == bits
        and row.kind in RIGHT_KINDS
        and not row.name.startswith("maps")
    ]
    return sum(round(v.warned * v.draws) for v in right), sum(v.draws for v in right)


class OtherPrecision:
    """The campaign in the other precision, in another process.

    A context manager that ends the process.
    """

    def __init__(self, bits: int, only: Sequence[str], draws: int, seed: int):
        """Start the process, with these options of `python -m experiments.honesty`."""
        self._folder = tempfile.TemporaryDirectory()
        self._path = Path(self._folder.name) / "rows.json"
        command = [sys.executable, "-m", "experiments.honesty"]
        command += ["--precision", str(bits), "--json", str(self._path)]
        command += ["--draws", str(draws), "--seed", str(seed)]
        command += ["--only", *only] if only else []
        environment = os.environ | {"JAX_ENABLE_X64": "1" if bits == 64 else "0"}
        self._process = subprocess.Popen(
            command,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )

    def __enter__(self) -> "OtherPrecision":
        return self

    def __exit__(self, *exception: object) -> None:
        # Interrupting this process also ends the other one.
        if self._process.poll() is None:
            self._process.kill()
            self._process.communicate()
        self._folder.cleanup()

    def rows(self) -> list[Row]:
        """Wait for the process, and return its rows.

        **Raises:** `RuntimeError` with the end of its error output, if it failed.
        """
        _, errors = self._process.communicate()
        # Status 1: it ran, and a situation failed.
        if self._process.returncode not in (0, 1) or not self._path.exists():
            raise RuntimeError(f"the other precision failed:\n{errors[-2000:]}")
        numbers = json.loads(self._path.read_text(encoding="utf-8"))
        return [row_from_json(row) for row in numbers["rows"]]


def row_from_json(row: dict[str, Any]) -> Row:
    """A row from JSON, in which null stands for NaN and lists for tuples."""
    verdict = {name: _value(value) for name, value in row.pop("verdict").items()}
    return Row(**row, verdict=Verdict(**verdict))


def _value(value: Any) -> Any:
    """A value from JSON: NaN for null, a tuple for a list, others as they are."""
    if value is None:
        return np.nan
    return tuple(value) if isinstance(value, list) else value
