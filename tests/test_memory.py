import resource
from pathlib import Path

import numpy as np
import pytest

from phongfit import memory
from phongfit.memory import give_back

STATUS = Path("/proc/self/statm")


def held() -> int:
    """Bytes of the machine's memory."""
    return int(STATUS.read_text().split()[1]) * resource.getpagesize()


@pytest.mark.skipif(
    memory._trim() is None or not STATUS.exists(), reason="needs glibc on Linux"
)
def test_freed_memory_goes_back():
    # So small that they lie one beside the other, and the last one above all others.
    arrays = [np.ones(8_000) for _ in range(4_000)]
    last = arrays.pop()
    del arrays
    before = held()
    give_back()
    assert before - held() > 100e6
    assert last.all()


def test_other_libraries_are_let_alone(monkeypatch):
    monkeypatch.setattr(memory, "_trim", lambda: None)
    give_back()
