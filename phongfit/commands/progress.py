"""Progress of long computations: their elapsed time."""

import contextlib
import sys
import threading
import time
from collections.abc import Iterator

EVERY = 30.0
"""Seconds between two lines, if the output is not a terminal."""


@contextlib.contextmanager
def stage(doing: str) -> Iterator[None]:
    """Show the block's name and elapsed time; in a log, as a line now and then."""
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
