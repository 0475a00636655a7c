"""The suite runs once in float32 and once in float64: see `python -m tests`."""

import collections
import gc
import shutil
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


@pytest.fixture(scope="module")
def browser():
    """Chromium, closed after each file: two of Playwright's loops cannot be open."""
    playwright = pytest.importorskip("playwright.sync_api")
    names = ("chromium", "chromium-browser", "google-chrome")
    found = [path for name in names if (path := shutil.which(name))]
    if not found:
        pytest.skip("there is no Chromium here")
    with playwright.sync_playwright() as started:
        chromium = started.chromium.launch(
            executable_path=found[0],
            args=[
                # Tests may run as root, in a container, and without a network.
                "--no-sandbox",
                "--disable-gpu",
                "--disable-dev-shm-usage",
                "--disable-background-networking",
            ],
        )
        yield chromium
        chromium.close()


# Of files and words, or of the precision that maps are made in: float32 alone, unless
# a mark says otherwise.
SINGLE = {"commands", "data_synth", "experiments", "files", "maps"}
# Whole fits and pictures, which take long to compile: every other one in float32, the
# rest in float64. The parts that fits are made of run in both.
ALTERNATE = {
    "geometry",
    "lab",
    "rendering",
    "report",
    "test_edges",
    "test_fit",
    "test_rejected",
    "test_identifiability",
    "test_implicit",
    "test_intervals",
    "test_jpeg",
    "test_meshes",
    "test_misfit",
    "test_outliers",
    "test_predict",
    "test_profile",
    "test_recovery",
    "test_robust",
    "test_scenes",
    "test_statistics",
    "test_warnings",
}


def pytest_addoption(parser):
    parser.addoption(
        "--both",
        action="store_true",
        help="run in both precisions what runs in one of them otherwise",
    )


def pytest_collection_modifyitems(config, items):
    """What need not run in both precisions runs in one."""
    double = jax.numpy.result_type(float) == jax.numpy.float64
    once = pytest.mark.skip(reason=f"runs in float{32 if double else 64} alone")
    numbers = collections.Counter()
    for item in items:
        numbers[item.path] += 1
        if item.get_closest_marker("float64"):
            home = True
        elif config.getoption("--both"):
            continue
        else:
            home = _home(item.path, numbers[item.path])
        if home not in (None, double):
            item.add_marker(once)


def _home(path: Path, number: int) -> bool | None:
    """Whether the test of this number in its file is for float64; `None`: for both."""
    folder = path.relative_to(Path(__file__).parent).parts[0]
    if path.parent.name == "pixel":
        # Of a pixel of maps alone.
        return None
    if not ALTERNATE.isdisjoint({folder, path.stem}):
        return number % 2 == 0
    return False if folder in SINGLE else None
