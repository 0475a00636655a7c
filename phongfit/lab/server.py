"""The page's server: routes, and conversion of errors."""

import contextlib
import functools
import socket
from collections.abc import Awaitable, Callable, Iterator
from importlib.resources import files
from typing import Any, TypeVar

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from phongfit.files.records import AbstractRecord, parse_record
from phongfit.lab.guard import Guard
from phongfit.lab.intake import MAX_CONNECTIONS, Hurried, Intake, TooLarge
from phongfit.lab.session import Session
from phongfit.lab.settings import (
    ChosenRequest,
    FitRequest,
    PictureRequest,
    TargetRequest,
    describe_settings,
)
from phongfit.lab.uploads import MAX_BYTES

PATIENCE = 3
"""Time to wait for unfinished work at the end, seconds."""

ASSETS = {
    "/": ("index.html", "text/html"),
    "/lab.css": ("lab.css", "text/css"),
    "/lab.js": ("lab.js", "text/javascript"),
    "/controls.js": ("controls.js", "text/javascript"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
}

Endpoint = Callable[[Request], Awaitable[Response]]
Record = TypeVar("Record", bound=AbstractRecord)


@contextlib.contextmanager
def listening(host: str, port: int) -> Iterator[socket.socket]:
    """A socket that listens only at `host` and `port`; closed after the block.

    **Raises:** `ValueError` with the reason of a failure.
    """
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        listener = socket.create_server((host, port), family=family)
    except OSError as error:
        words = error.strerror or str(error)
        raise ValueError(
            f"host, port: cannot listen at {host}, {port}: {words} (--port 0 takes any "
            "that is free)"
        ) from error
    with listener:
        # Connections inherit this option. Without it the kernel delays a picture by up
        # to 40 ms, until the browser has acknowledged earlier data.
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        yield listener


def configuration(session: Session, host: str) -> uvicorn.Config:
    """Configuration of the page's server."""
    return uvicorn.Config(
        make_app(session, host),
        http=Hurried,
        ws="none",
        lifespan="off",
        limit_concurrency=MAX_CONNECTIONS,
        log_level="warning",
        access_log=False,
        timeout_graceful_shutdown=PATIENCE,
    )


def serve(session: Session, listener: socket.socket, host: str) -> None:
    """Serve the page until the process is interrupted."""
    uvicorn.Server(configuration(session, host)).run(sockets=[listener])


def make_app(session: Session, host: str = "127.0.0.1") -> Starlette:
    """The application that serves the page and answers its requests.

    An invalid request gets a one-line message: `{"error": …}`, status 400.

    **Arguments:** `host`: address at which the server listens.
    """
    intake = Intake()
    given = () if session.given is None else session.given.names
    about = describe_settings() | {"max_bytes": MAX_BYTES, "photographs": given}

    def describe(request: Request) -> Response:
        del request
        return JSONResponse(about)

    def picture(request: PictureRequest) -> Response:
        return Response(session.picture(request), media_type="image/png")

    posts = {
        "/api/picture": _asked(intake, PictureRequest, picture),
        "/api/outline": _asked(intake, PictureRequest, session.outline),
        "/api/target": _asked(intake, TargetRequest, session.make_target),
        "/api/fit": _asked(intake, FitRequest, session.fit, heavy=True),
        "/api/chosen": _asked(intake, ChosenRequest, session.choose),
        "/api/mesh": _uploaded(intake, session, "add_mesh"),
        "/api/photograph": _uploaded(intake, session, "add_photograph", "encoding"),
        "/api/mask": _uploaded(intake, session, "add_mask", "target"),
    }
    return Starlette(
        routes=[
            *(Route(path, _asset(*asset)) for path, asset in ASSETS.items()),
            Route("/api/settings", describe),
            *(Route(path, end, methods=["POST"]) for path, end in posts.items()),
        ],
        middleware=[Middleware(Guard, host=host)],
        exception_handlers={
            TooLarge: functools.partial(_tell, status=413),
            ValueError: _tell,
            ClientDisconnect: _left,
            Exception: _fault,
        },
    )


def _asset(name: str, media_type: str) -> Callable[[Request], Response]:
    content = (files("phongfit.lab") / "page" / name).read_bytes()

    def answer(request: Request) -> Response:
        del request
        return Response(content, media_type=media_type)

    return answer


def _asked(
    intake: Intake,
    kind: type[Record],
    work: Callable[[Record], Any],
    *,
    heavy: bool = False,
) -> Endpoint:
    """An endpoint that applies `work` to a record in JSON."""

    async def answer(request: Request) -> Response:
        text = await intake.words(request)
        call = functools.partial(parse_record, text, kind)
        return await intake.do(lambda: _sent(work(call())), heavy=heavy)

    return answer


def _uploaded(intake: Intake, session: Session, method: str, *more: str) -> Endpoint:
    """An endpoint that calls a method with an uploaded file, its name and `more`."""

    async def answer(request: Request) -> Response:
        def work(content: bytes) -> Response:
            given = {name: _query(request, name) for name in ("name", *more)}
            return _sent(getattr(session, method)(content=content, **given))

        return await intake.file(request, MAX_BYTES, work)

    return answer


def _sent(answer: Any) -> Response:
    return answer if isinstance(answer, Response) else JSONResponse(answer)


def _query(request: Request, name: str) -> str:
    value = request.query_params.get(name)
    if value is None:
        raise ValueError(f"{name}: is missing")
    return value


def _tell(request: Request, error: Exception, status: int = 400) -> Response:
    """The answer to invalid input."""
    del request
    return JSONResponse({"error": " ".join(str(error).split())}, status_code=status)


def _left(request: Request, error: Exception) -> Response:
    """The answer to a disconnected client, which is never sent."""
    del request, error
    return Response(status_code=400)


def _fault(request: Request, error: Exception) -> Response:
    """The answer after an internal error, whose traceback the server prints."""
    del request
    words = f"the server failed ({type(error).__name__}); its terminal says more"
    return JSONResponse({"error": words}, status_code=500)
