"""Receive requests within limits of size and time, and schedule their work."""

import asyncio
from collections.abc import Callable
from typing import TypeVar

import anyio.to_thread
from anyio import CapacityLimiter
from starlette.exceptions import HTTPException
from starlette.requests import Request
from uvicorn.protocols.http.h11_impl import H11Protocol

T = TypeVar("T")

MAX_WORDS = 2**16
"""Maximum number of bytes of a record: settings have a few hundred."""

MAX_AT_ONCE = 4
"""Maximum number of files received at a time; others wait."""

MAX_CONNECTIONS = 64
"""Maximum number of connections; others get the answer that the server is busy."""

HEAD_SECONDS = 10
"""Time limit for the head of a request, seconds."""

PAUSE_SECONDS = 10
"""Time limit for a pause in the body of a request, seconds."""

BODY_SECONDS = 60
"""Time limit for the whole body of a request, seconds."""


class TooLarge(ValueError):
    """A request has more bytes than the limit."""


class Intake:
    """Receives bodies of requests, and runs their work outside the event loop.

    Light work, such as a picture, runs in a few threads; heavy work, a fit or a file,
    runs one at a time, so that memory is bounded for any number of requests.
    """

    def __init__(self) -> None:
        self._receiving = asyncio.Semaphore(MAX_AT_ONCE)
        self._light = CapacityLimiter(4)
        self._heavy = CapacityLimiter(1)

    async def words(self, request: Request) -> str:
        """The text of a record.

        **Raises:** `ValueError` if it is too long or too slow.
        """
        return (await _body(request, MAX_WORDS)).decode(errors="replace")

    async def file(self, request: Request, limit: int, work: Callable[[bytes], T]) -> T:
        """Apply `work` to a file of at most `limit` bytes; raises as `words` does."""
        async with self._receiving:
            content = await _body(request, limit)
            return await self.do(lambda: work(content), heavy=True)

    async def do(self, work: Callable[[], T], *, heavy: bool) -> T:
        """Run `work` in a thread, which is abandoned when the server ends."""
        limiter = self._heavy if heavy else self._light
        try:
            return await anyio.to_thread.run_sync(
                work, abandon_on_cancel=True, limiter=limiter
            )
        except asyncio.CancelledError as end:
            raise HTTPException(503, "the server has ended") from end


async def _body(request: Request, limit: int) -> bytes:
    length = request.headers.get("content-length", "0")
    # Refuse a large body before it is sent.
    _check_size(int(length) if length.isdecimal() else 0, limit)
    pieces, size = [], 0
    stream = request.stream()
    try:
        async with asyncio.timeout(BODY_SECONDS):
            while piece := await asyncio.wait_for(anext(stream, b""), PAUSE_SECONDS):
                size += len(piece)
                _check_size(size, limit)
                pieces.append(piece)
    except TimeoutError:
        raise ValueError("request: expected it whole, it stopped on its way") from None
    return b"".join(pieces)


def _check_size(size: int, limit: int) -> None:
    if size > limit:
        raise TooLarge(f"request: expected at most {limit} bytes, got {size}")


class Hurried(H11Protocol):
    """Connections that are closed if no complete head of a request arrives in time.

    The base class waits for the head of a request without limit.
    """

    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # pyright: ignore
        super().connection_made(transport)
        self._watch()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        self._rest()
        super().connection_lost(exc)

    def send_400_response(self, msg: str) -> None:
        """Answer an invalid request; within a body, cancel the request's own answer.

        The base class sends both answers, and fails with the second.
        """
        cycle, begun = self.cycle, False
        if cycle is not None:
            cycle.disconnected, begun = True, cycle.response_started
            cycle.message_event.set()
        if begun:
            self.transport.close()
        else:
            super().send_400_response(msg)

    def _watch(self) -> None:
        if self.cycle is not None and not self.cycle.response_complete:
            self._rest()
        elif self._deadline is None:
            self._deadline = self.loop.call_later(HEAD_SECONDS, self.transport.close)

    def _rest(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None
