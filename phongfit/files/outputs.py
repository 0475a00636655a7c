"""Outputs appear whole or not at all: written under another name, then moved."""

import contextlib
import json
import os
import secrets
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from phongfit.plain import plain

LINE_WIDTH = 88


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A name in the same folder to write to; moved to `path` if all goes well.

    Whatever ends the block early, an interrupt too, removes what was written, and a
    file that stood at `path` before stays as it was.

    **Arguments:** `path`: the file to make or to replace.

    **Returns:** a context manager that gives the name; its suffix is that of `path`,
    since many writers choose the format by it.

    **Raises:** `OSError` that names `path`.
    """
    path = Path(path)
    check_file(path)
    temporary = _sibling(path)
    try:
        with _blaming(path, temporary):
            yield temporary
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def replacing_folder(
    path: str | os.PathLike[str],
    may_replace: Callable[[str], bool] | None = None,
) -> Iterator[Path]:
    """An empty folder to fill, which becomes `path` if all goes well.

    **Arguments:**

    - `path`: the folder to make. One that is there must be empty.
    - `may_replace`: tells of a name in a folder that is there whether it may be lost;
        if all of them may, the whole folder is replaced.

    **Returns:** a context manager that gives the folder to fill.

    **Raises:** `OSError` that names `path`, and what is in the way.
    """
    # A link is followed, and "." gets its name.
    path = Path(path).resolve()
    check_folder(path, may_replace)
    temporary = _sibling(path)
    try:
        with _blaming(path, temporary):
            temporary.mkdir()
            yield temporary
            _swap(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@contextlib.contextmanager
def replacing_files(path: str | os.PathLike[str]) -> Iterator[Path]:
    """An empty folder to fill; its files go beside `path` if all goes well.

    For a file that needs others beside it. What they replace stays until all of them
    are written.

    **Raises:** `OSError` that names `path`.
    """
    path = Path(path)
    check_file(path)
    temporary = _sibling(path)
    try:
        with _blaming(path, temporary):
            temporary.mkdir()
            yield temporary
            for file in sorted(temporary.iterdir()):
                os.replace(file, path.parent / file.name)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def check_file(path: Path) -> None:
    """Could a file be written here? Asked before what takes long.

    **Raises:** `OSError` that names `path`, and says why not.
    """
    _check_parent(path)
    if path.is_dir():
        raise OSError(f"{path}: is a folder, expected the name of a file")


def check_folder(path: Path, may_replace: Callable[[str], bool] | None) -> None:
    """The same of a folder; arguments are those of [`replacing_folder`][]."""
    _check_parent(path)
    _check_replaceable(path, may_replace)


def _check_parent(path: Path) -> None:
    folder = path.parent
    if not folder.is_dir():
        raise OSError(f"{path}: there is no folder {folder} to write it to")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OSError(f"{path}: the folder {folder} may not be written to")


def _check_replaceable(path: Path, may_replace: Callable[[str], bool] | None) -> None:
    if not path.exists():
        return
    if not path.is_dir():
        raise OSError(f"{path}: is a file, expected a folder")
    names = sorted(entry.name for entry in path.iterdir())
    if names and may_replace is None:
        raise OSError(f"{path}: the folder is not empty")
    for name in names:
        if may_replace is not None and not may_replace(name):
            raise OSError(f"{path}: is not replaced, since it holds {name}")


def _sibling(path: Path) -> Path:
    # Not `tempfile`, whose files only their owner may read.
    return path.with_name(f".{path.stem}-{secrets.token_hex(6)}{path.suffix}")


def _swap(new: Path, path: Path) -> None:
    if not path.exists():
        os.replace(new, path)
        return
    old = _sibling(path)
    os.replace(path, old)
    try:
        os.replace(new, path)
    except BaseException:
        os.replace(old, path)
        raise
    shutil.rmtree(old)


@contextlib.contextmanager
def _blaming(path: Path, temporary: Path) -> Iterator[None]:
    """A user knows `path`: errors should not speak of the temporary name."""
    try:
        yield
    except OSError as error:
        # Some errors of a full disk carry no name at all.
        named = "" if error.filename is None else os.fspath(error.filename)
        if error.errno is not None and (not named or str(temporary) in str(named)):
            raise OSError(f"{path}: cannot be written: {error.strerror}") from error
        if str(temporary) in str(error):
            # Of a file within a folder that is being filled.
            told = str(error).replace(str(temporary), str(path))
            raise OSError(told) from error
        raise


def write_json(path: str | os.PathLike[str], data: Any) -> None:
    """Write `data` as strict JSON, in one piece.

    Arrays and numbers become what [`plain`][] makes of them. Keys keep their order, and
    short lists stay on one line.

    **Arguments:** `path`; `data`: mappings, sequences, arrays, numbers, text, paths.

    **Raises:** `TypeError` for other data, `OSError` that names `path`.
    """
    text = _layout(plain(data), 0) + "\n"
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _layout(value: Any, indent: int) -> str:
    line = json.dumps(value, ensure_ascii=False, allow_nan=False)
    nested = isinstance(value, dict) or (
        isinstance(value, list) and any(isinstance(item, dict) for item in value)
    )
    if not value or not isinstance(value, dict | list):
        return line
    if not nested and indent + len(line) <= LINE_WIDTH:
        return line
    inner = " " * (indent + 2)
    if isinstance(value, dict):
        items = [
            f"{inner}{json.dumps(key, ensure_ascii=False)}: {_layout(item, indent + 2)}"
            for key, item in value.items()
        ]
        opening, closing = "{", "}"
    else:
        items = [inner + _layout(item, indent + 2) for item in value]
        opening, closing = "[", "]"
    return f"{opening}\n" + ",\n".join(items) + f"\n{' ' * indent}{closing}"
