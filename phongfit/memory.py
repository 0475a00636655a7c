"""Memory that the allocator keeps after it was freed: how to give it back."""

import ctypes
import functools
from collections.abc import Callable


def give_back() -> None:
    """Give freed memory back to the system, where the C library keeps it.

    glibc does not return freed arrays of some megabytes that lie below others that are
    in use: where photographs are traced again and again it came to hold twice as much
    as is used. It takes some milliseconds, and another C library needs none of it.
    """
    trim = _trim()
    if trim is not None:
        trim(0)


@functools.cache
def _trim() -> Callable[[int], int] | None:
    try:
        return ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):
        return None
