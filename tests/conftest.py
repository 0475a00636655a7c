"""The suite runs once in float32 and once in float64: see `python -m tests`."""

import gc
from pathlib import Path

import jax
import matplotlib
import pytest
from hypothesis import settings

matplotlib.use("agg")
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
# Compilation makes the first example slow, which says nothing about the code.
settings.register_profile("phongfit", deadline=None, derandomize=True)
settings.load_profile("phongfit")


@pytest.fixture(autouse=True, scope="module")
def _settled_memory():
    """What JAX has compiled stays: the collector need not look at it again.

    Until there is so much of it that the system runs out of places in memory.
    """
    yield
    if _places() > 35_000:
        jax.clear_caches()
        gc.unfreeze()
        gc.collect()
    gc.freeze()


def _places() -> int:
    """How many separate pieces of memory this process has; Linux allows 65 530."""
    maps = Path("/proc/self/maps")
    return len(maps.read_text().splitlines()) if maps.exists() else 0


# Of files and words, or of the precision that maps are made in: float32 alone, unless
# a mark says otherwise.
SINGLE = {"commands", "data_synth", "experiments", "files", "mapping"}


def pytest_collection_modifyitems(items):
    """What need not run in both precisions runs in one: `float64`, or `SINGLE`."""
    double = jax.numpy.result_type(float) == jax.numpy.float64
    once = pytest.mark.skip(reason=f"runs in float{32 if double else 64} alone")
    for item in items:
        marked = item.get_closest_marker("float64") is not None
        single = item.path.relative_to(Path(__file__).parent).parts[0] in SINGLE
        if (single and not marked) if double else marked:
            item.add_marker(once)
