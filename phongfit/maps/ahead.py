"""Reading ahead in threads, while the caller works on the last item."""

import collections
import concurrent.futures
import contextvars
from collections.abc import Callable, Iterator
from typing import TypeVar

T = TypeVar("T")


def ahead(
    read: Callable[[int], T], count: int, beside: int = 1
) -> Iterator[tuple[int, T]]:
    """Yield numbers from 0 on with `read(number)`, run in the caller's context.

    **Arguments:** `beside`: number of items that are read in parallel.
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
