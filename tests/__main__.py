"""`python -m tests [pytest's arguments]`: the suite in float32 and in float64.

What takes long and gains little runs in one of them only (see `conftest.py`), unless
`--both` is among the arguments. Two processes side by side, since the precision is
fixed when JAX starts. Most of their time is compilation of what runs once, so XLA
compiles in a hurry, unless `XLA_FLAGS` says otherwise; commands and experiments run as
users run them.
"""

import os
import subprocess
import sys
import tempfile

# Machine code as it comes. The others are of XLA's inner life, which not all have: what
# takes long to write, and products that round otherwise from one triangle to the next.
QUICK = (
    "--xla_backend_optimization_level=0",
    "--xla_cpu_use_fusion_emitters=false",
    "--xla_cpu_max_isa=AVX",
)


def main() -> int:
    """Both runs, the second one's output after the first's; 1 if one of them fails."""
    command = [sys.executable, "-m", "pytest", "-q", *sys.argv[1:]]
    environment = {"XLA_FLAGS": quick_flags()} | os.environ
    with tempfile.TemporaryFile("w+") as later:
        double = subprocess.Popen(
            [*command, "-p", "no:cacheprovider"],
            env=environment | {"JAX_ENABLE_X64": "1"},
            stdout=later,
            stderr=subprocess.STDOUT,
        )
        print("float32", flush=True)
        single = subprocess.run(command, env=environment | {"JAX_ENABLE_X64": "0"})
        status = double.wait()
        later.seek(0)
        print(f"\nfloat64\n{later.read()}", flush=True)
    return int(bool(single.returncode or status))


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
