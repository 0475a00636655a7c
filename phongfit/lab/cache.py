"""A bounded cache of objects that were loaded into the page."""

import secrets
import threading
from collections import OrderedDict
from typing import Generic, TypeVar

T = TypeVar("T")


class Cache(Generic[T]):
    """A cache of a few objects, each under an unguessable token.

    The least recently used one is dropped for a new one, so that memory stays bounded
    for any number of open pages.
    """

    def __init__(self, name: str, size: int = 8):
        """**Arguments:** `name` of the kind of objects, for messages; `size`: maximum
        number of objects."""
        self._name = name
        self._size = size
        self._held: OrderedDict[str, T] = OrderedDict()
        # Several threads answer requests.
        self._lock = threading.Lock()

    def put(self, thing: T) -> str:
        """Keep `thing`.

        **Returns:** the token for `get`.
        """
        token = secrets.token_urlsafe(16)
        with self._lock:
            self._held[token] = thing
            if len(self._held) > self._size:
                self._held.popitem(last=False)
        return token

    def get(self, token: str) -> T:
        """The object with this token.

        **Raises:** `ValueError` if it has been dropped, or never existed.
        """
        with self._lock:
            if token not in self._held:
                raise ValueError(f"{self._name}: is no longer held; load it again")
            self._held.move_to_end(token)
            return self._held[token]
