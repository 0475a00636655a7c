"""Precision, compilation and shared fixtures of the tests.

Each test runs in one precision: float32, the default of users, where files, commands,
pages and maps are the subject, float64 everywhere else. A test that uses the fixture
`precision` runs in both. Modules that several test files import hold no JAX arrays at
module level, since their precision would be that of the first importer.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import jax
import matplotlib
import pytest
from hypothesis import settings

# Most programs run once: unoptimised, they compile in a third of the time. Without
# AVX2 there are no fused multiplications, which round differently at this level from
# one triangle to the next. XLA reads the flags at its first computation, and stops the
# process at one that it does not know: hence the trial, once for all workers.
FLAGS = (
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false "
    "--xla_cpu_max_isa=AVX"
)
if "XLA_FLAGS" not in os.environ:
    trial = subprocess.run(
        [sys.executable, "-c", "import jax; jax.devices()"],
        env=os.environ | {"XLA_FLAGS": FLAGS},
        stderr=subprocess.DEVNULL,
    )
    os.environ["XLA_FLAGS"] = FLAGS if trial.returncode == 0 else ""

ROOT = Path(__file__).parent
# What the last run compiled; kept out of the user's own cache.
COMPILED = ROOT.parent / ".pytest_cache" / "compiled"
MOST_BYTES = 2**30
SINGLE = {
    "campaign",
    "commands",
    "data_synth",
    "experiments",
    "files",
    "lab",
    "maps",
    "report",
    "test_cache.py",
    "test_cli.py",
    "test_documentation.py",
    "test_documents.py",
    "test_programs.py",
    "test_site.py",
}

matplotlib.use("agg")
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    jax.config.update("jax_compilation_cache_dir", str(COMPILED))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
# The first example includes compilation, so a deadline would be arbitrary.
settings.register_profile("phongfit", deadline=None, derandomize=True)
settings.load_profile("phongfit")


def pytest_configure(config: pytest.Config) -> None:
    """Delete compiled programs once they take more than a gigabyte."""
    is_worker = hasattr(config, "workerinput")
    if not is_worker and COMPILED.is_dir():
        size = sum(path.stat().st_size for path in COMPILED.iterdir())
        if size > MOST_BYTES:
            shutil.rmtree(COMPILED)


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector):
    """Import a test module in the precision that its tests run in."""
    path = getattr(collector, "path", ROOT)
    with in_precision(precision_of(path)):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item):
    """Run a test, its fixtures included, in its precision."""
    asked = getattr(item, "callspec", None)
    name = asked.params.get("precision") if asked is not None else None
    with in_precision(name or precision_of(item.path)):
        return (yield)


def precision_of(path: Path) -> str:
    """The precision that the tests of a file run in."""
    inside = path.relative_to(ROOT).parts if path.is_relative_to(ROOT) else ()
    folder = inside[0] if inside else ""
    return "float32" if folder in SINGLE and "pixel" not in inside else "float64"


@contextmanager
def in_precision(name: str) -> Iterator[None]:
    """Set JAX's precision, in all threads, and restore it afterwards."""
    before = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    jax.config.update("jax_enable_x64", name == "float64")
    try:
        yield
    finally:
        jax.config.update("jax_enable_x64", before)


@pytest.fixture(params=["float32", "float64"])
def precision(request: pytest.FixtureRequest) -> str:
    """Run the test in both precisions."""
    return request.param


@pytest.fixture(autouse=True, scope="module")
def room_for_programs() -> Iterator[None]:
    """Drop compiled programs before XLA has used all memory maps of the process.

    Linux allows 65 530; XLA takes dozens for each program, and fails without a message
    where there are no more.
    """
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > 40_000:
        jax.clear_caches()


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
