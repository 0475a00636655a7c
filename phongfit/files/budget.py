"""Limit on the memory that one file's contents may take, checked before allocation.

The header of a small file can state arrays that fill any machine. So every reader calls
[`afford`][] with the stated size before it allocates memory.
"""

import os
import re

MAX_MEMORY = 2**30
"""Bytes that the contents of one file may take, by default."""

SWITCH = "PHONGFIT_MAX_MEMORY"
OPTION = "--max-memory"

_UNITS = {"": 1, "K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40}


def parse_size(name: str, text: str) -> int:
    """Bytes from text such as `4G`, `512M` or `1000000`.

    **Raises:** `ValueError` that names `name`.
    """
    found = re.fullmatch(
        r"(\d{1,12}|\d{1,6}\.\d{1,6})([KMGT]?)B?", text.strip().upper()
    )
    size = int(float(found[1]) * _UNITS[found[2]]) if found else 0
    if size < 1:
        raise ValueError(f"{name}: expected a size such as 4G or 512M, got {text!r}")
    return size


def most() -> int:
    """Bytes that the contents of one file may take.

    **Raises:** `ValueError` that names the environment's variable.
    """
    text = os.environ.get(SWITCH)
    return parse_size(SWITCH, text) if text else MAX_MEMORY


def afford(size: int, what: str) -> None:
    """Check that `size` bytes are within the limit for the contents of one file.

    **Arguments:** `what`: name of the contents, for the message.

    **Raises:** `ValueError` with the setting that would allow this size.
    """
    limit = most()
    if size > limit:
        raise ValueError(
            f"expected what takes at most {in_words(limit)} of memory, got {what}, "
            f"which takes {in_words(size)} ({SWITCH}={_enough(size)}, or {OPTION} of a "
            "command, allows it)"
        )


def in_words(size: int) -> str:
    """A number of bytes as text, such as `1.5 GB`."""
    for unit, name in ((2**40, "TB"), (2**30, "GB"), (2**20, "MB"), (2**10, "KB")):
        if size >= unit:
            return f"{size / unit:.3g} {name}"
    return f"{size} bytes"


def _enough(size: int) -> str:
    """A limit that is large enough, in whole GB, as text."""
    return f"{-(-size // 2**30) + 1}G"
