"""`python -m phongfit.lab`."""

from phongfit.cli import run
from phongfit.lab.command import lab

if __name__ == "__main__":
    raise SystemExit(run(lab, prog="python -m phongfit.lab"))
