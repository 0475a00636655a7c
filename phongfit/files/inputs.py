"""Input files, read within limits of size and only from inside their folder."""

import contextlib
import contextvars
import hashlib
import io
import os
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np
from jaxtyping import Float

from phongfit.files.budget import afford

Note = Callable[[str], None]
"""Function that receives a sentence on an unused part of a file."""

LISTED = 20
"""Maximum number of unused parts that a warning names; others are counted."""

DEEPEST = 64
"""Maximum number of parts at the end of a file's name that are tried."""

_checksums: contextvars.ContextVar[dict[Path, str] | None]
_checksums = contextvars.ContextVar("checksums", default=None)


@contextlib.contextmanager
def recording() -> Iterator[dict[Path, str]]:
    """Collect the SHA-256 of every file that the block reads, by its path.

    A file that is read again must be unchanged, so that a result depends only on the
    recorded inputs.

    **Raises:** `ValueError` that names a file that has changed.
    """
    found: dict[Path, str] = {}
    outer = _checksums.get()
    token = _checksums.set(found)
    try:
        yield found
    finally:
        _checksums.reset(token)
        if outer is not None:
            outer.update(found)


def _record(path: Path, data: bytes) -> None:
    checksums = _checksums.get()
    if checksums is None:
        return
    digest = hashlib.sha256(data).hexdigest()
    if checksums.setdefault(path, digest) != digest:
        raise ValueError(f"{path}: has changed since it was read before")


_spared: contextvars.ContextVar[Path | None]
_spared = contextvars.ContextVar("spared", default=None)


@contextlib.contextmanager
def sparing(out: Path | None) -> Iterator[None]:
    """Refuse an output file that is also an input of the block.

    Inputs are files that the block reads, or that its records name.

    **Raises:** `OSError` that names `out`, before it is read.
    """
    token = _spared.set(out)
    try:
        yield
    finally:
        _spared.reset(token)


def check_spared(path: Path) -> None:
    """Raise `OSError` if an input is the output of [`sparing`][]."""
    out = _spared.get()
    if out is not None and out.exists() and path.exists() and path.samefile(out):
        raise OSError(f"{out}: is an input, expected another file to write to")


def read_bytes(path: Path, limit: int | None = None) -> bytes:
    """All bytes of a file.

    **Raises:** `ValueError` that names the file: it is missing, not a regular file, not
    readable, or larger than `limit` bytes or than the general limit of
    [`phongfit.files.budget`][].
    """
    check_spared(path)
    try:
        # A device or a pipe might never end.
        if path.exists() and not path.is_file():
            raise ValueError(f"{path}: is not a file")
        size = path.stat().st_size
        if limit is not None and size > limit:
            raise ValueError(f"{path}: expected at most {limit} bytes, got {size}")
        with naming(str(path)):
            afford(size, "a file")
        data = path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    _record(path, data)
    return data


def read_text(path: Path, limit: int | None = 2**24) -> str:
    """The text of a file in UTF-8; raises as [`read_bytes`][] does."""
    try:
        return read_bytes(path, limit).decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: is no text in UTF-8") from error


def joined_lines(data: bytes) -> Iterator[tuple[int, str]]:
    """Numbered lines of a text file with any line ends, continued lines joined.

    The text is UTF-8 with or without a byte order mark, or else Latin-1. A line that
    ends with a backslash continues on the next one.
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    lines = enumerate(io.StringIO(text, newline=None), start=1)
    for number, line in lines:
        if not line.endswith("\\\n"):
            yield number, line
            continue
        pieces = [line]
        while pieces[-1].endswith("\\\n"):
            pieces[-1] = pieces[-1][:-2]
            pieces.append(next(lines, (0, ""))[1])
        yield number, " ".join(pieces)


def floats(words: Sequence[str]) -> list[float]:
    """Words as numbers; an empty list if one of them is no number."""
    try:
        return [float(word) for word in words]
    except ValueError:
        return []


def uncommented(words: list[str]) -> list[str]:
    """The words before one that starts with #."""
    for k, word in enumerate(words):
        if word.startswith("#"):
            return words[:k]
    return words


def read_table(path: Path, columns: int) -> Float[np.ndarray, "rows columns"]:
    """A table of finite numbers, `columns` in each line, separated by white space.

    **Raises:** `ValueError` that names the file and the line.
    """
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip():
            continue
        with naming(f"{path}: line {number}"):
            row = [float(word) for word in line.split()]
            if len(row) != columns or not np.isfinite(row).all():
                raise ValueError(f"expected {columns} finite numbers, got {line!r}")
            rows.append(row)
    return np.array(rows).reshape(-1, columns)


def inside(folder: Path, name: str) -> Path:
    """The file called `name` in `folder`, or below it.

    Data sets may come from untrusted sources, so they must not name files elsewhere.

    **Raises:** `ValueError` for an absolute name, one with `..`, or a symbolic link
    that leads out of the folder.
    """
    parts = PurePosixPath(name).parts
    # Reject names that are absolute on Windows on all systems, for portability.
    anchored = PurePosixPath(name).anchor or PureWindowsPath(name).anchor
    if not parts or anchored or ".." in parts or "\\" in name or "\0" in name:
        raise ValueError(f"expected the name of a file in this folder, got {name!r}")
    path = folder / name
    try:
        resolved = path.resolve()
    except (OSError, RuntimeError) as error:
        raise ValueError(f"{name!r}: is a link that leads nowhere") from error
    if not resolved.is_relative_to(folder.resolve()):
        raise ValueError(f"{name!r}: is a link that leads out of this folder")
    return path


def beside(folder: Path, name: str) -> Path | None:
    """The file in `folder`, or below it, for a name that another computer wrote.

    The name may have quotes, backslashes, and letters of the other case. If its folders
    do not exist here, the longest end of it that exists is used.

    **Returns:** `None` if there is no such file.
    """
    parts = name.strip(" \t\"'").replace("\\", "/").split("/")
    parts = [part for part in parts if part not in ("", ".", "..")][-DEEPEST:]
    for start in range(len(parts)):
        for find in (inside, _in_any_case):
            # Invalid names, such as too long ones, raise these.
            with contextlib.suppress(ValueError, OSError):
                path = find(folder, "/".join(parts[start:]))
                if path.is_file():
                    return path
    return None


def _in_any_case(folder: Path, name: str) -> Path:
    """The path of [`inside`][], ignoring the case of letters in `name`."""
    found = folder
    for part in name.split("/"):
        same = (k for k in sorted(os.listdir(found)) if k.lower() == part.lower())
        found = found / next(same, part)
    return inside(folder, str(found.relative_to(folder)))


@contextlib.contextmanager
def naming(prefix: str) -> Iterator[None]:
    """Put `prefix` before the message of a `ValueError` from the block."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{prefix}: {error}") from error


def reason(error: Exception) -> str:
    """A library's error message, on one readable line."""
    # Remove memory addresses, which differ in each run.
    text = re.sub(r" ?<[^<>]* at 0x[0-9a-f]+>", "", str(error))
    return shortened(" ".join(text.split())) or type(error).__name__


def listed(names: Sequence[str], most: int = LISTED, rest: str = "others") -> str:
    """Up to `most` names in one line, and the number of the remaining ones."""
    more = f" and {len(names) - most} {rest}" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def shortened(text: str) -> str:
    """A text, cut to 300 characters."""
    return text if len(text) <= 300 else text[:299] + "…"


@contextlib.contextmanager
def naming_field(record: str) -> Iterator[None]:
    """Put `record.` before a `ValueError` that begins with the name of a field."""
    try:
        yield
    except ValueError as error:
        # Arrays are printed on several lines; a message has one.
        raise ValueError(f"{record}.{' '.join(str(error).split())}") from error
