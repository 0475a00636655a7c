"""`python -m tests [pytest's arguments]`: the suite in float32, then in float64."""

import os
import subprocess
import sys


def main() -> int:
    """Both runs, each in a process of its own; 1 if one of them fails."""
    status = 0
    for x64 in ("0", "1"):
        print(f"\nfloat{'64' if x64 == '1' else '32'}", flush=True)
        command = [sys.executable, "-m", "pytest", "-q", *sys.argv[1:]]
        run = subprocess.run(command, env=os.environ | {"JAX_ENABLE_X64": x64})
        status = status or run.returncode
    return status


if __name__ == "__main__":
    raise SystemExit(main())
