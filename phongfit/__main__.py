"""`python -m phongfit`: the same as the command `phongfit`."""

from phongfit.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
