"""Reading ahead: the next are read while one is worked on."""

import collections
import concurrent.futures
import contextvars
from collections.abc import Callable, Iterator
from typing import TypeVar

T = TypeVar("T")


def ahead(
    read: Callable[[int], T], count: int, beside: int = 1
) -> Iterator[tuple[int, T]]:
    """Numbers from 0 on, and what is read for each, in the context of the caller.

    **Arguments:** `beside`: how many are read at a time.
    """
    coming: collections.deque[concurrent.futures.Future[T]] = collections.deque()
    with concurrent.futures.ThreadPoolExecutor(beside) as readers:

        def begin(number: int) -> None:
            if number < count:
                context = contextvars.copy_context()
                coming.append(readers.submit(context.run, read, number))

        for number in range(min(beside, count)):
            begin(number)
        try:
            for number in range(count):
                here = coming.popleft().result()
                begin(number + beside)
                yield number, here
        finally:
            for future in coming:
                future.cancel()
