"""Outputs appear whole or not at all: they are made in a work folder, then moved.

The work folder is hidden, beside an output file or inside an output folder. Only one
run at a time uses it; the next run removes the remains of a killed one. Missing parent
folders are made, and removed again if the output fails.
"""

import contextlib
import errno
import itertools
import json
import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from phongfit.plain import plain

LINE_WIDTH = 88

WORK = ".unfinished"
"""Name, or end of the name, of the work folder."""

OVERWRITE = "expected a new one, or overwrite (--overwrite), which replaces a result"
"""Advice of an error if an older result exists."""

PATIENCE = 10.0
"""Time to wait for another run that is writing the same file, seconds."""


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary file to write to, which replaces `path` when the block succeeds.

    Other files that the block writes beside the temporary one move beside `path`. If
    the block ends early, even by an interrupt, the temporary files are removed and
    older files are unchanged. Links are followed. A pipe or a character device, such as
    `/dev/stdout`, is written to.

    **Arguments:** `path`: the file to make or to replace.

    **Returns:** a context manager for the temporary path; its last part is that of
    `path`, since many writers choose the format by the suffix.

    **Raises:** `OSError` that names `path`.
    """
    path = Path(path)
    check_file(path)
    with contextlib.ExitStack() as place:
        if _is_stream(path):
            work = Path(place.enter_context(tempfile.TemporaryDirectory()))
        else:
            target = Path(os.path.realpath(path))
            place.enter_context(_made(target.parent, path))
            work = place.enter_context(_workplace(_beside(target), path, PATIENCE))
        new = work / "new"
        with _blaming(path, new, path.parent):
            new.mkdir()
            yield new / path.name
            _put_all(new, path)


def _put_all(new: Path, path: Path) -> None:
    """Replace `path`, and files beside it, by those in the folder `new`."""
    others = sorted(file.name for file in new.iterdir() if file.name != path.name)
    if others and _is_stream(path):
        raise OSError(f"{path}: expected a file, since others go beside it")
    for name in others:
        check_file(path.parent / name)
    for name in (*others, path.name):
        _put(new / name, path.parent / name)


@contextlib.contextmanager
def replacing_folder(
    path: str | os.PathLike[str],
    may_replace: Callable[[str], bool] | None = None,
) -> Iterator[Path]:
    """An empty folder to fill, whose contents move into `path` when the block succeeds.

    If the block ends early, `path` is unchanged. Files that other programs put into
    `path` during the block stay there.

    **Arguments:**

    - `path`: the folder to make. An existing one must be empty.
    - `may_replace`: function of a name in an existing folder, true if it may be
        replaced; if it is true for all names, they are removed.

    **Returns:** a context manager for the folder to fill.

    **Raises:** `OSError` that names `path` and the obstacle: other files, or another
    run that writes there.
    """
    # A link is followed, and "." gets its name.
    path = Path(path).resolve()
    _check_folder(path)
    if path.is_dir() and not (path / WORK).exists():
        # Check early, before anything is created; repeated below under the lock.
        _check_replaceable(path, may_replace)
    with _made(path, path), _workplace(path / WORK, path) as work:
        new, ready, old = work / "new", work / "ready", work / "old"
        with _blaming(path, new):
            old.mkdir()
            if ready.is_dir():
                # Complete the move of a run that was killed during it.
                _place(ready, path, old)
                ready.rmdir()
            _check_replaceable(path, may_replace)
            new.mkdir()
            yield new
            _check_untaken(path, new, may_replace)
            os.replace(new, ready)
            for name in _names(path):
                if may_replace is not None and may_replace(name):
                    if not (ready / name).exists():
                        os.replace(path / name, old / name)
            _place(ready, path, old)


@contextlib.contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Keep other runs from writing into `folder` during the block.

    **Raises:** `OSError` that names the folder, if another run is writing there.
    """
    with _workplace(folder / WORK, folder):
        yield


def check_file(path: Path) -> None:
    """Check that a file can be written, before a long computation.

    **Raises:** `OSError` that names `path` and the reason.
    """
    if path.is_dir():
        raise OSError(f"{path}: is a folder, expected the name of a file")
    if path.exists():
        if not path.is_file() and not _is_stream(path):
            raise OSError(f"{path}: is a device or a socket, expected a file")
        if not os.access(path, os.W_OK):
            raise OSError(f"{path}: may not be written to")
    if not _is_stream(path):
        _check_parent(Path(os.path.realpath(path)), path)


def _check_folder(path: Path) -> None:
    if path.is_dir():
        if not os.access(path, os.W_OK | os.X_OK):
            raise OSError(f"{path}: the folder may not be written to")
    elif path.exists():
        raise OSError(f"{path}: is a file, expected a folder")
    else:
        _check_parent(path, path)


def _check_parent(target: Path, shown: Path) -> None:
    folder = next(above for above in target.parents if above.exists())
    if not folder.is_dir():
        raise OSError(f"{shown}: {folder} is a file, expected a folder")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OSError(f"{shown}: the folder {folder} may not be written to")


def _check_replaceable(path: Path, may_replace: Callable[[str], bool] | None) -> None:
    names = _names(path)
    if names and may_replace is None:
        raise OSError(f"{path}: the folder is not empty; {OVERWRITE}")
    for name in names:
        if may_replace is not None and not may_replace(name):
            raise OSError(f"{path}: is not replaced, since it holds {name}")


def _check_untaken(
    path: Path, new: Path, may_replace: Callable[[str], bool] | None
) -> None:
    """Raise if other programs put files of these names into `path` during the block.

    The new files are then kept in a folder inside `path`.
    """
    for name in _names(new):
        if (path / name).exists() and not (may_replace and may_replace(name)):
            others = (path / f"{path.name}-{k}" for k in itertools.count(2))
            kept = next(folder for folder in others if not folder.exists())
            os.replace(new, kept)
            raise OSError(
                f"{path}: {name} appeared there meanwhile, and stays; the results are "
                f"in {kept}"
            )


def _names(path: Path) -> list[str]:
    return sorted(entry.name for entry in path.iterdir() if entry.name != WORK)


def _is_stream(path: Path) -> bool:
    """True if `path` is a character device or a pipe, which cannot be replaced."""
    try:
        mode = path.stat().st_mode
    except OSError:
        return False
    return stat.S_ISCHR(mode) or stat.S_ISFIFO(mode)


def _beside(path: Path) -> Path:
    return path.with_name(f".{path.name}{WORK}")


@contextlib.contextmanager
def _made(folder: Path, path: Path) -> Iterator[None]:
    """Make a folder and its parents; remove those that are empty after the block."""
    missing = [place for place in (folder, *folder.parents) if not place.exists()]
    with _blaming(path, folder):
        folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            for place in missing:
                place.rmdir()


@contextlib.contextmanager
def _workplace(work: Path, path: Path, patience: float = 0.0) -> Iterator[Path]:
    """The empty folder `work`, locked for this run and removed afterwards.

    An existing `ready` is kept, since it holds files that are still to be moved.

    **Raises:** `OSError` that names `path`, if another run holds the lock.
    """
    lock = FileLock(work / "lock", timeout=patience, poll_interval=0.02)
    while True:
        _make_own(work, path)
        try:
            lock.acquire()
            break
        except FileNotFoundError:
            # The last owner has just removed the folder.
            continue
        except Timeout:
            raise OSError(f"{path}: another run is writing there") from None
    try:
        _clear(work)
        yield work
    finally:
        _clear(work)
        with contextlib.suppress(OSError):
            (work / "ready").rmdir()
        if not (work / "ready").exists():
            # Remove the lock last, since other runs create one if it is missing.
            with contextlib.suppress(OSError):
                (work / "lock").unlink()
                work.rmdir()
        lock.release()


def _make_own(work: Path, path: Path) -> None:
    """Make the folder `work`, or check that an existing one belongs to this user."""
    with _blaming(path, work), contextlib.suppress(FileExistsError):
        work.mkdir()
        return
    with contextlib.suppress(FileNotFoundError):
        found = work.lstat()
        user = getattr(os, "geteuid", lambda: found.st_uid)()
        if not stat.S_ISDIR(found.st_mode) or found.st_uid != user:
            raise OSError(f"{path}: {work} is in the way; remove it")


def _clear(work: Path) -> None:
    for entry in list(work.iterdir()):
        if entry.is_dir() and not entry.is_symlink():
            if entry.name != "ready":
                shutil.rmtree(entry, ignore_errors=True)
        elif entry.name != "lock":
            entry.unlink(missing_ok=True)


def _place(ready: Path, path: Path, old: Path) -> None:
    """Move all files in `ready` into `path`."""
    # Move .json files last, so that a record never refers to missing files.
    for new in sorted(ready.iterdir(), key=lambda p: (p.suffix == ".json", p.name)):
        place = path / new.name
        if place.is_dir() and not place.is_symlink():
            os.replace(place, old / new.name)
        os.replace(new, place)


def _put(temporary: Path, path: Path) -> None:
    """Replace `path` by the temporary file, or copy into it if it is a stream."""
    if _is_stream(path):
        _copy_into(temporary, path)
        return
    target = Path(os.path.realpath(path))
    if target.exists():
        shutil.copymode(target, temporary)
    try:
        os.replace(temporary, target)
    except OSError as error:
        # A file that is a mount point cannot be replaced.
        if error.errno not in (errno.EBUSY, errno.EXDEV):
            raise
        _copy_into(temporary, target)


def _copy_into(source: Path, path: Path) -> None:
    # Non-blocking, since a pipe may never get a reader.
    descriptor = os.open(path, os.O_WRONLY | getattr(os, "O_NONBLOCK", 0))
    with open(source, "rb") as read, open(descriptor, "wb") as written:
        os.set_blocking(descriptor, True)
        if stat.S_ISREG(os.fstat(descriptor).st_mode):
            written.truncate(0)
        shutil.copyfileobj(read, written)


@contextlib.contextmanager
def _blaming(path: Path, temporary: Path, place: Path | None = None) -> Iterator[None]:
    """Make errors name `path` in place of the temporary folder.

    **Arguments:** `place`: final place of the folder's files; default `path`.
    """
    try:
        yield
    except OSError as error:
        # Some errors of a full disk have no file name.
        named = "" if error.filename is None else os.fspath(error.filename)
        ours = not named or str(temporary) in str(named) or str(path) == str(named)
        if error.errno is not None and ours:
            raise OSError(f"{path}: cannot be written: {error.strerror}") from error
        if str(temporary) in str(error):
            # The error is of a file within the temporary folder.
            told = str(error).replace(str(temporary), str(place or path))
            raise OSError(told) from error
        raise


def write_json(path: str | os.PathLike[str], data: Any) -> None:
    """Write `data` as strict JSON, whole or not at all.

    Arrays and numbers are converted by [`plain`][]. Keys keep their order, and short
    lists stay on one line.

    **Arguments:** `path`; `data`: mappings, sequences, arrays, numbers, text, paths.

    **Raises:** `TypeError` for other data, `OSError` that names `path`.
    """
    text = _layout(plain(data), 0) + "\n"
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def _layout(value: Any, indent: int) -> str:
    line = json.dumps(value, ensure_ascii=False, allow_nan=False)
    if not value or not isinstance(value, dict | list):
        return line
    nested = isinstance(value, dict) or any(isinstance(item, dict) for item in value)
    if not nested and indent + len(line) <= LINE_WIDTH:
        return line
    if isinstance(value, dict):
        items = [
            f"{json.dumps(key, ensure_ascii=False)}: {_layout(item, indent + 2)}"
            for key, item in value.items()
        ]
    else:
        items = [_layout(item, indent + 2) for item in value]
    inner = "\n" + " " * (indent + 2)
    return f"{line[0]}{inner}{f',{inner}'.join(items)}\n{' ' * indent}{line[-1]}"
