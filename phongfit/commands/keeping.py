"""What was computed is kept, whatever becomes of its pictures."""

import contextlib
from collections.abc import Iterator
from pathlib import Path


class Kept:
    """What an output folder got, and what went wrong when pictures were drawn."""

    def __init__(self, out: Path):
        """**Arguments:** `out`: the folder, as the user calls it."""
        self._out = out
        self.names: list[str] = []
        self.failure: BaseException | None = None

    def tell(self) -> None:
        """Print what is in the folder; then raise what went wrong, if anything did."""
        with contextlib.suppress(BrokenPipeError):
            print(f"\n{self._out}: {', '.join(self.names)}", flush=True)
        if self.failure is not None:
            raise self.failure


@contextlib.contextmanager
def keeping(out: Path, folder: Path) -> Iterator[Kept]:
    """Put off what goes wrong in the block, an interrupt too.

    What was written to `folder` before can so become `out`; then comes
    [`Kept.tell`][].

    **Arguments:** `out`, as the user calls it; `folder`, which is to become it.
    """
    kept = Kept(out)
    try:
        yield kept
    except BaseException as error:
        kept.failure = error
    kept.names = sorted(path.name for path in folder.iterdir())
