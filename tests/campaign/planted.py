"""Faults that the judge must see: `python -m tests.campaign.planted` tells what it saw.

A process of its own, since a worker is forked from it and JAX must not have started.
"""

import json
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.campaign.cases import Case, Kind, Refused, Wrong, put
from tests.campaign.judge import judge


def _raising(error: BaseException) -> Callable[[Path], Any]:
    def act(folder: Path) -> None:
        del folder
        raise error

    return act


def _busy(folder: Path) -> None:
    del folder
    end = time.process_time() + 2
    while time.process_time() < end:
        pass


ACTS: dict[str, Callable[[Path], Any]] = {
    "taken": lambda folder: None,
    "refused": _raising(ValueError("file.txt: is no good")),
    "refused by a command": _raising(Refused("error: it is no good")),
    "written": lambda folder: (folder / "out.txt").write_text("as it should"),
    "no words": _raising(ValueError()),
    "traceback": _raising(AttributeError("it has none")),
    "wrong": _raising(Wrong("other pixels")),
    "memory": lambda folder: np.ones(2**29, np.uint8).sum(),
    "memory of the machine": lambda folder: np.ones(2**33, np.uint8),
    "time": _busy,
    "noise": lambda folder: os.write(2, b"a library complains"),
    "left": lambda folder: (folder / ".out-1234").write_text("half"),
    "changed": lambda folder: (folder / "file.txt").write_text("other"),
    "lost": lambda folder: (folder / "file.txt").unlink(),
    "outside": lambda folder: (folder.parent / "canary.txt").write_text("gone"),
    "killed": lambda folder: os.kill(os.getpid(), signal.SIGSEGV),
    "after a death": lambda folder: None,
}
LIMITS = Kind(lambda random, stock: case(0), seconds=1.0, megabytes=600.0)


def case(number: int) -> Case:
    name, act = list(ACTS.items())[number]
    return Case(name, put({"file.txt": b"input"}), act, ("out.txt",))


def main() -> int:
    """Print for each name whether it was taken, and the fault that was seen."""
    verdicts = judge(case, LIMITS, range(len(ACTS)))
    json.dump({v.name: [v.taken, v.fault] for v in verdicts}, sys.stdout)
    return 0


if __name__ == "__main__":
    sys.exit(main())
