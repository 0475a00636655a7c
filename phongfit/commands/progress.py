"""A word on what takes long, where there is a terminal to show it."""

import contextlib
import sys
from collections.abc import Iterator


@contextlib.contextmanager
def stage(doing: str) -> Iterator[None]:
    """Show what the block is doing, while it does; nothing if no terminal is there."""
    if not sys.stderr.isatty() or not sys.stdout.isatty():
        yield
        return
    from rich.console import Console

    with Console(stderr=True).status(f"{doing} …"):
        yield
