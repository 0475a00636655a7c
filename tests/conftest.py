"""The suite runs once in float32 and once in float64: see `python -m tests`.

Some tests run in one of the two, unless `--both` is asked for: those with the mark
`float64`; those of the folders in `SINGLE`, in float32; and those in `ALTERNATE`, where
a checksum of a test's name chooses, whatever stands before it. Its parameters have no
part in that: they share what is compiled.
"""

import gc
import shutil
import threading
import zlib
from pathlib import Path

import jax
import matplotlib
import pytest
from hypothesis import settings
from jax._src.interpreters import mlir
from jaxlib.mlir import ir

from phongfit.programs import MOST_PIECES, pieces_of_memory

ROOT = Path(__file__).parent

matplotlib.use("agg")
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
# Compilation makes the first example slow, which says nothing about the code.
settings.register_profile("phongfit", deadline=None, derandomize=True)
settings.load_profile("phongfit")
# JAX makes objects by the million while it traces, nearly all of which stay: to look
# through them every 700 takes a tenth of the time of all tests.
gc.set_threshold(100_000, 10, 10)
# Nobody reads which line an instruction came from: a seventh of tracing and lowering.
jax.config.update("jax_traceback_in_locations_limit", 0)


def _shared_contexts(make):
    """MLIR's contexts, each for a few hundred programs of a thread in place of one.

    To make one and to fill it anew is a quarter of a small program's time, and each
    program keeps its own: half of the memory of all tests. What is lowered while
    something else is, as solvers of lineax have it, does need its own.
    """
    here = threading.local()

    def context():
        if ir.Context.current is not None:
            return make()
        here.count = getattr(here, "count", -1) + 1
        if here.count % 200 == 0:
            here.shared = make()
        return here.shared

    return context


mlir.make_ir_context = _shared_contexts(mlir.make_ir_context)


@pytest.fixture(autouse=True, scope="module")
def _settled_memory():
    """What JAX has compiled stays: the collector need not look at it again.

    Until there is so much of it that the system runs out of pieces of memory: what is
    frozen would not go by itself.
    """
    yield
    if pieces_of_memory() > MOST_PIECES:
        jax.clear_caches()
        gc.unfreeze()
        gc.collect()
    gc.freeze()


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


# Of files and words, or as commands and experiments are run, or of the precision that
# maps are made in: float32 alone. The arithmetic of a map's pixel runs in both.
SINGLE = {"campaign", "commands", "data_synth", "experiments", "files", "maps"}
# Whole fits and pictures, which take long to compile: about a third of them in float32,
# where all of `SINGLE` runs, the others in float64. The parts of a fit run in both.
ALTERNATE = {
    # Computed by NumPy, in double precision.
    "calibration",
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
    "test_microfacets",
    "test_misfit",
    "test_outliers",
    "test_poses",
    "test_predict",
    "test_profile",
    "test_recovery",
    "test_robust",
    "test_scenes",
    "test_shapes",
    "test_statistics",
    "test_surroundings",
    "test_texture_fit",
    "test_warnings",
}


def pytest_addoption(parser):
    parser.addoption(
        "--both",
        action="store_true",
        help="run in both precisions what runs in one of them otherwise",
    )


def pytest_ignore_collect(collection_path, config):
    """What float64 has no part in need not even be imported there."""
    if _double() and not config.getoption("--both") and collection_path.is_file():
        return _is_single(collection_path) or None
    return None


def pytest_collection_modifyitems(config, items):
    """What need not run in both precisions runs in one."""
    double = _double()
    once = pytest.mark.skip(reason=f"runs in float{32 if double else 64} alone")
    for item in items:
        if item.get_closest_marker("float64"):
            if _is_single(item.path):
                raise pytest.UsageError(f"{item.nodeid}: float64 is not run there")
            home = True
        elif config.getoption("--both"):
            continue
        else:
            home = _home(item.path, getattr(item, "originalname", item.name))
        if home not in (None, double):
            item.add_marker(once)


def _double() -> bool:
    return jax.numpy.result_type(float) == jax.numpy.float64


def _folder(path: Path) -> str:
    """The folder or file of `tests` that a path is or lies in."""
    return path.relative_to(ROOT).parts[0] if path != ROOT else ""


def _is_single(path: Path) -> bool:
    return _folder(path) in SINGLE and path.parent.name != "pixel"


def _home(path: Path, name: str) -> bool | None:
    """Whether the test of this name in a file is for float64; `None`: for both."""
    if _is_single(path):
        return False
    if ALTERNATE.isdisjoint({_folder(path), path.stem}):
        return None
    return zlib.crc32(f"{path.stem}.{name}".encode()) % 3 != 0
