"""`phongfit lab`: a page with sliders on this machine; see `phongfit/lab`."""

import dataclasses
import importlib.util
import os
import socket
import sys
import threading
import webbrowser
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from phongfit.codes import coded
from phongfit.commands.options import EncodingName, WhiteLevel, optional, refuse

MAX_RESOLUTION = 1024


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

    photographs: Annotated[Positional[Path | None], optional("PHOTOS")] = None
    """Photographs of a ball to begin with: one, a folder of them, or a data set. The
    page has a menu of them."""

    sphere: Annotated[tuple[float, float, float] | None, optional("X Y R")] = None
    """The ball in the photographs: x and y of its centre and its radius in pixels,
    from the upper left corner. Default: a circle is looked for."""

    lights: Annotated[Path | None, optional("FILE")] = None
    """Their lamps, as `phongfit calibrate` writes them, or an .lp. Default: those in
    the folder; else fits look for their directions."""

    encoding: EncodingName = None
    """What their numbers are, or the file of a response curve, as `phongfit response`
    writes it. Default: srgb for JPEG, and for one photograph of 8 bits."""

    white: WhiteLevel = None
    """The number in the files that is white, such as 4095 of 12 bits in PNGs of 16.
    Default: the largest of the format."""


def main(options: Options) -> None:
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
    if options.photographs is None:
        why = "is of photographs, and none are given"
        refuse(options, "sphere lights encoding white", why)
    _check_installed()
    # Imported here, since it may not be installed.
    from phongfit.lab.server import listening

    with listening(options.host, options.port) as listener:
        _serve(listener, options)
    leave_work_behind()


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


def _serve(listener: socket.socket, options: Options) -> None:
    # Imported here, since they take long to import and may not be installed.
    from phongfit.lab.given import open_given
    from phongfit.lab.guard import is_loopback
    from phongfit.lab.server import serve
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
    threading.Thread(target=session.warm_up, daemon=True).start()
    try:
        _announce(url, is_loopback(options.host), options.browser)
        serve(session, listener, options.host)
    except KeyboardInterrupt:
        # Ctrl-C is the usual way to stop the server.
        print("stopped", flush=True)


def _announce(url: str, only_here: bool, browser: bool) -> None:
    print(f"phongfit lab: {url} (Ctrl-C stops it)", flush=True)
    if not only_here:
        words = coded("open-to-others", "other machines can reach it")
        print(f"warning: {words}", file=sys.stderr)
    if browser:
        # In a thread, since a browser in the terminal would block.
        threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()


def _url(listener: socket.socket, host: str) -> str:
    shown = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, host)
    shown = f"[{shown}]" if ":" in shown and not shown.startswith("[") else shown
    return f"http://{shown}:{listener.getsockname()[1]}/"


def leave_work_behind() -> None:
    """End the process, even if threads are still working."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)
