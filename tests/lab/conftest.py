"""One server for all tests of the page, with small pictures."""

import contextlib
import threading
from collections.abc import Iterator

import pytest
import uvicorn

from phongfit.lab.server import configuration, listening
from phongfit.lab.session import Session

SIZE = 64


@pytest.fixture(scope="session")
def session() -> Session:
    return Session(SIZE)


@contextlib.contextmanager
def serving(session: Session) -> Iterator[int]:
    """A server as the command starts it; gives the port that it listens at."""
    with listening("127.0.0.1", 0) as listener:
        server = uvicorn.Server(configuration(session, "127.0.0.1"))
        thread = threading.Thread(target=server.run, args=([listener],))
        thread.start()
        try:
            yield listener.getsockname()[1]
        finally:
            server.should_exit = True
            thread.join()


@pytest.fixture(scope="session")
def port(session) -> Iterator[int]:
    with serving(session) as port:
        yield port
