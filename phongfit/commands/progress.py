"""A word on what takes long: how long it has taken so far."""

import contextlib
import sys
import threading
import time
from collections.abc import Iterator

EVERY = 30.0
"""Seconds between two lines, where there is no terminal that could show a clock."""


@contextlib.contextmanager
def stage(doing: str) -> Iterator[None]:
    """Show what the block is doing, and for how long; a line now and then in a log."""
    if not sys.stderr.isatty() or not sys.stdout.isatty():
        with _lines(doing):
            yield
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        progress.add_task(f"{doing} …", total=None)
        yield


@contextlib.contextmanager
def _lines(doing: str) -> Iterator[None]:
    done = threading.Event()
    stream, start = sys.stderr, time.monotonic()

    def tell() -> None:
        while not done.wait(EVERY):
            seconds = time.monotonic() - start
            with contextlib.suppress(OSError):
                print(f"{doing}: {seconds:.0f} s so far", file=stream, flush=True)

    thread = threading.Thread(target=tell, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
