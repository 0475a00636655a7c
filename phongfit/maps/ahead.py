"""Reading ahead: the next is read while one is worked on."""

import concurrent.futures
import contextvars
from collections.abc import Callable, Iterator
from typing import TypeVar

T = TypeVar("T")


def ahead(read: Callable[[int], T], count: int) -> Iterator[tuple[int, T]]:
    """Numbers from 0 on, and what is read for each, in the context of the caller."""
    with concurrent.futures.ThreadPoolExecutor(1) as reader:

        def begin(number: int) -> concurrent.futures.Future[T]:
            return reader.submit(contextvars.copy_context().run, read, number)

        coming = begin(0) if count else None
        for number in range(count):
            assert coming is not None
            here = coming.result()
            if number + 1 < count:
                coming = begin(number + 1)
            yield number, here
