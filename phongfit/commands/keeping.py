"""Fill an output folder, and keep its results even if drawing their pictures fails."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

from phongfit.files.outputs import replacing_folder

Drawing = Callable[[], contextlib.AbstractContextManager[None]]
"""Makes a context for what may fail: see [`keeping`][]."""


@contextlib.contextmanager
def keeping(
    out: Path, may_replace: Callable[[str], bool] | None = None
) -> Iterator[tuple[Path, Drawing]]:
    """A folder to fill, and a function that makes a context whose errors are deferred.

    When the block succeeds, the folder becomes `out`, and the names of its files are
    printed. Only then is an error raised that the context deferred, also an interrupt:
    the files that were written before are kept.

    **Arguments:** `out`, as given by the user; `may_replace`: as in
    [`replacing_folder`][].
    """
    failures: list[BaseException] = []

    @contextlib.contextmanager
    def drawing() -> Iterator[None]:
        try:
            yield
        except BaseException as error:
            failures.append(error)

    with replacing_folder(out, may_replace) as folder:
        yield folder, drawing
        names = sorted(path.name for path in folder.iterdir())
    with contextlib.suppress(BrokenPipeError):
        print(f"\n{out}: {', '.join(names)}", flush=True)
    if failures:
        raise failures[0]
