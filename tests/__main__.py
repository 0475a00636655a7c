"""`python -m tests [pytest's arguments]`: the suite in float32 and in float64.

What takes long and gains little runs in one of them only (see `conftest.py`), unless
`--both` is among the arguments. Parts are processes of their own, two of them side by
side, since the precision is fixed when JAX starts.

Most of their time is compilation of what runs once, so XLA compiles in a hurry, unless
`XLA_FLAGS` says otherwise, and what it has compiled is kept for the next run: below
`JAX_COMPILATION_CACHE_DIR`, or else in `~/.cache/phongfit/tests`, which may be deleted
at any time. Commands and experiments run as users run them.
"""

import functools
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor, as_completed
from importlib.metadata import version
from pathlib import Path

# Machine code as it comes, by one thread: two processes are at work already. The others
# are of XLA's inner life, which not all have: what takes long to write, and products
# that round otherwise from one triangle to the next.
QUICK = (
    "--xla_backend_optimization_level=0",
    "--xla_cpu_parallel_codegen_split_count=1",
    "--xla_cpu_use_fusion_emitters=false",
    "--xla_cpu_max_isa=AVX",
)
# Bytes of compiled programs, above which all are compiled anew: a run leaves a quarter
# of it, and what changes in the code adds to it.
MOST = 2**29
# Folders that make the second part in float32.
LATE = ("calibration", "lab", "maps", "rendering", "report")


def main() -> int:
    """All parts, each one's output when it is through; 1 if one of them fails."""
    asked = sys.argv[1:]
    parts = in_parts() if not asked else [("float64", asked), ("float32", asked)]
    environment = {"XLA_FLAGS": quick_flags()} | os.environ
    with ThreadPoolExecutor(2) as pool:
        running = [pool.submit(run, *part, environment) for part in parts]
        for done in as_completed(running):
            print(done.result().stdout, flush=True)
    return int(any(done.result().returncode for done in running))


def run(
    name: str, part: list[str], environment: dict[str, str]
) -> subprocess.CompletedProcess[str]:
    """One part, and all that it says."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *part]
    print(f"{name} begins", flush=True)
    done = subprocess.run(
        command,
        env=environment | precision(name),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    done.stdout = f"\n{name}\n{done.stdout}"
    return done


def in_parts() -> list[tuple[str, list[str]]]:
    """All tests; in float32 what is annotated is checked while they run.

    The longest come first.
    """
    late = [f"tests/{name}" for name in LATE]
    typed = ["-p", "tests.annotations"]
    return [
        ("float64", []),
        ("float32", [*typed, *(f"--ignore={path}" for path in late)]),
        ("float32, second part", [*typed, *late]),
    ]


def precision(name: str) -> dict[str, str]:
    """Environment of a part, which shares its compiled programs with its precision's.

    Another part may look at one that is half written: it is compiled there, too.
    """
    chosen = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    folder = Path(chosen) if chosen else Path.home() / ".cache" / "phongfit" / "tests"
    bits, *_ = name.split(",")
    return {
        "JAX_ENABLE_X64": "1" if bits == "float64" else "0",
        "JAX_COMPILATION_CACHE_DIR": str(compiled_before(folder / bits)),
        # Small ones too: there are thousands of them.
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }


def compiled(folder: Path) -> Path:
    """A folder in it for programs of this JAX; those of others, and too many, go."""
    ours = folder / f"jax-{version('jax')}-jaxlib-{version('jaxlib')}"
    for other in folder.glob("jax-*"):
        size = sum(path.stat().st_size for path in other.iterdir())
        if other != ours or size > MOST:
            shutil.rmtree(other)
    # Programs are run as they are found: nobody else may put any there.
    ours.mkdir(mode=0o700, parents=True, exist_ok=True)
    return ours


# Once for the parts of a precision, the first of which may be at work.
compiled_before = functools.cache(compiled)


def quick_flags() -> str:
    """Those of `QUICK` that this XLA knows: it stops at others."""
    every = " ".join(QUICK)
    asked = subprocess.run(
        [sys.executable, "-c", "import jax; jax.devices()"],
        env=os.environ | {"XLA_FLAGS": every},
        stderr=subprocess.DEVNULL,
    )
    return every if asked.returncode == 0 else QUICK[0]


if __name__ == "__main__":
    raise SystemExit(main())
