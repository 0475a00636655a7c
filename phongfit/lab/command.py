"""`phongfit lab`: the page on this machine."""

import contextlib
import dataclasses
import importlib.util
import math
import os
import socket
import sys
import threading
import time
import webbrowser
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from phongfit.codes import coded

if TYPE_CHECKING:
    import uvicorn

    from phongfit.lab.session import Session

MAX_RESOLUTION = 1024

PATIENCE = 3.0
"""Time to wait for unfinished work at the end, seconds."""


def _optional(metavar: str) -> Any:
    """An option whose help text describes its default."""
    return arg(metavar=metavar, help_behavior_hint="")


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of `phongfit lab`."""

    host: str = "127.0.0.1"
    """Address to listen at; 0.0.0.0 lets other machines in."""

    port: int = 8060
    """Port to listen at; 0 takes any that is free."""

    resolution: int = 256
    """Width and height of the pictures, pixels."""

    browser: bool = True
    """Open the page in a browser."""

    photographs: Annotated[Positional[Path | None], _optional("PHOTOS")] = None
    """Photographs of a ball to begin with: one, a folder of them, or a data set. The
    page has a menu of them."""

    sphere: Annotated[tuple[float, float, float] | None, _optional("X Y R")] = None
    """The ball in the photographs: x and y of its centre and its radius in pixels,
    from the upper left corner. Default: a circle is looked for."""

    lights: Annotated[Path | None, _optional("FILE")] = None
    """Their lamps, as `phongfit calibrate` writes them, or an .lp. Default: those in
    the folder; else fits look for their directions."""

    encoding: Annotated[str | None, _optional("linear|srgb|FILE")] = None
    """What their numbers are, or the file of a response curve, as `phongfit response`
    writes it. Default: srgb for JPEG, and for one photograph of 8 bits."""

    white: Annotated[int | None, _optional("LEVEL")] = None
    """The number in the files that is white, such as 4095 of 12 bits in PNGs of 16.
    Default: the largest of the format."""


def lab(options: Options) -> None:
    """Move the model's sliders in a browser, and fit a target with one press.

    The page is served on this machine, and to this machine only unless --host says
    otherwise. Everybody who reaches it can load files into it. Ctrl-C stops it.

    For example:
      phongfit lab
      phongfit lab --port 0 --no-browser
      phongfit lab ball.png
      phongfit lab photos --sphere 179 155 81 --encoding srgb
    """
    if not 0 <= options.port < 2**16:
        raise ValueError(f"port: expected 0 … {2**16 - 1}, got {options.port}")
    if not 16 <= options.resolution <= MAX_RESOLUTION:
        raise ValueError(
            f"resolution: expected 16 … {MAX_RESOLUTION}, got {options.resolution}"
        )
    _check_installed()
    for name in ("sphere", "lights", "encoding", "white"):
        if options.photographs is None and getattr(options, name) is not None:
            raise ValueError(f"{name}: is of photographs, and none are given")
    with listening(options.host, options.port) as listener:
        _serve(listener, options)


def leave_work_behind() -> None:
    """End the process after a short wait, even if threads are still working."""
    others = [one for one in threading.enumerate() if not one.daemon]
    others.remove(threading.main_thread())
    end = time.monotonic() + PATIENCE
    for thread in others:
        thread.join(max(end - time.monotonic(), 0))
    if any(thread.is_alive() for thread in others):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)


def _check_installed() -> None:
    missing = [
        name
        for name in ("starlette", "uvicorn")
        if importlib.util.find_spec(name) is None
    ]
    if missing:
        raise ValueError(
            f"{' and '.join(missing)} not installed: pip install 'phongfit[lab]'"
        )


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


def _serve(listener: socket.socket, options: Options) -> None:
    # Imported here, since they take long to import and may not be installed.
    import uvicorn

    from phongfit.lab.given import open_given
    from phongfit.lab.guard import is_loopback
    from phongfit.lab.session import Session
    from phongfit.lab.settings import PictureRequest, Settings

    given = None
    if options.photographs is not None:
        path = options.photographs
        given = open_given(
            path, options.sphere, options.lights, options.encoding, options.white
        )
        for note in given.notes:
            print(f"assumed: {note}", flush=True)
    session = Session(options.resolution, given)
    # Compile for the first picture before the page is announced.
    session.picture(PictureRequest(settings=Settings()))
    url = _url(listener, options.host)
    try:
        with _warming_up(session):
            _announce(url, is_loopback(options.host), options.browser)
            server = uvicorn.Server(configuration(session, options.host))
            server.run(sockets=[listener])
    except KeyboardInterrupt:
        # Ctrl-C is the usual way to stop the server.
        print("stopped", flush=True)


def configuration(session: "Session", host: str) -> "uvicorn.Config":
    """Configuration of the page's server."""
    import uvicorn

    from phongfit.lab.intake import MAX_CONNECTIONS, Hurried
    from phongfit.lab.server import make_app

    return uvicorn.Config(
        make_app(session, host),
        http=Hurried,
        ws="none",
        lifespan="off",
        limit_concurrency=MAX_CONNECTIONS,
        log_level="warning",
        access_log=False,
        timeout_graceful_shutdown=math.ceil(PATIENCE),
    )


def _announce(url: str, only_here: bool, browser: bool) -> None:
    print(f"phongfit lab: {url} (Ctrl-C stops it)", flush=True)
    if not only_here:
        words = coded("open-to-others", "other machines can reach it")
        print(f"warning: {words}", file=sys.stderr)
    if browser:
        # In a thread, since a browser in the terminal would block.
        threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()


@contextlib.contextmanager
def _warming_up(session: "Session") -> Iterator[None]:
    """Compile in a thread during the block, and stop with it."""
    stop = threading.Event()
    thread = threading.Thread(target=session.warm_up, args=(stop,))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        # The current compilation may take some more seconds.
        thread.join(PATIENCE)


def _url(listener: socket.socket, host: str) -> str:
    shown = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, host)
    shown = f"[{shown}]" if ":" in shown and not shown.startswith("[") else shown
    return f"http://{shown}:{listener.getsockname()[1]}/"
