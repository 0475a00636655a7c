"""What was loaded into the page, kept until newer things need the room."""

import secrets
import threading
from collections import OrderedDict
from typing import Generic, TypeVar

T = TypeVar("T")


class Cache(Generic[T]):
    """A few things, each under a name that nobody can guess.

    The one used longest ago makes room for a new one, so memory stays bounded however
    many pages are open.
    """

    def __init__(self, name: str, size: int = 8):
        """**Arguments:** `name` of what it holds, for messages; `size`: how many."""
        self._name = name
        self._size = size
        self._held: OrderedDict[str, T] = OrderedDict()
        # Requests are answered by several threads.
        self._lock = threading.Lock()

    def put(self, thing: T) -> str:
        """Keep `thing`.

        **Returns:** the name to ask for it by.
        """
        token = secrets.token_urlsafe(16)
        with self._lock:
            self._held[token] = thing
            if len(self._held) > self._size:
                self._held.popitem(last=False)
        return token

    def get(self, token: str) -> T:
        """What was put there.

        **Raises:** `ValueError` if it is no longer there, or never was.
        """
        with self._lock:
            if token not in self._held:
                raise ValueError(f"{self._name}: is no longer held; load it again")
            self._held.move_to_end(token)
            return self._held[token]
