"""Keep computed results even if drawing their pictures fails."""

import contextlib
from collections.abc import Iterator
from pathlib import Path


class Kept:
    """Names of the files in an output folder, and the error of drawing, if any."""

    def __init__(self, out: Path):
        """**Arguments:** `out`: the folder, as given by the user."""
        self._out = out
        self.names: list[str] = []
        self.failure: BaseException | None = None

    def tell(self) -> None:
        """Print the names of the files; then raise the error of the block, if any."""
        with contextlib.suppress(BrokenPipeError):
            print(f"\n{self._out}: {', '.join(self.names)}", flush=True)
        if self.failure is not None:
            raise self.failure


@contextlib.contextmanager
def keeping(out: Path, folder: Path) -> Iterator[Kept]:
    """Defer errors of the block, including interrupts, to [`Kept.tell`][].

    So the files that were written to `folder` before can become `out` first.

    **Arguments:** `out`, as given by the user; `folder`, which will become it.
    """
    kept = Kept(out)
    try:
        yield kept
    except BaseException as error:
        kept.failure = error
    kept.names = sorted(path.name for path in folder.iterdir())
