"""How much memory what is read may take: asked before a header is believed.

A file of some kilobytes can promise arrays that fill any machine. So every reader asks
[`afford`][] for what a file says that it holds, and only then makes room for it.
"""

import os
import re

MAX_MEMORY = 2**30
"""Bytes that the contents of one file may take, unless told otherwise."""

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
    """Is there room for `size` bytes, as the contents of one file?

    **Arguments:** `what`: they are for, in words that end a sentence.

    **Raises:** `ValueError` that says how to make room.
    """
    limit = most()
    if size > limit:
        raise ValueError(
            f"expected what takes at most {in_words(limit)} of memory, got {what}, "
            f"which takes {in_words(size)} ({SWITCH}={_enough(size)}, or {OPTION} of a "
            "command, allows it)"
        )


def in_words(size: int) -> str:
    """Bytes as people read them."""
    for unit, name in ((2**40, "TB"), (2**30, "GB"), (2**20, "MB"), (2**10, "KB")):
        if size >= unit:
            return f"{size / unit:.3g} {name}"
    return f"{size} bytes"


def _enough(size: int) -> str:
    """A size to give, with some room."""
    return f"{-(-size // 2**30) + 1}G"
