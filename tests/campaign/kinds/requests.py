"""Requests to the page's server: it answers or closes, and goes on."""

import contextlib
import functools
import http.client
import json
import logging
import select
import socket
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from tests.campaign.cases import Case, Kind, Wrong
from tests.campaign.damage import damaged
from tests.campaign.kinds import pictures, shapes
from tests.campaign.kinds.records import changed

SIZE = 16
PATIENCE = 120.0
"""Seconds that an answer may take, on a machine that has other work too."""

HEAD_SECONDS = 0.3

HELD = "held" * 5 + "!!"
"""Stands for a target that the server holds, and is as long as its name."""

SETTINGS = {"diffuse": [0.5, 0.4, 0.3], "light": "point", "shading": "phong", "turn": 9}
BODIES: dict[str, dict[str, Any]] = {
    "/api/picture": {"settings": SETTINGS, "target": None},
    "/api/target": {"settings": SETTINGS, "noise": 0.01, "seed": 3},
    "/api/fit": {
        "settings": {},
        "target": HELD,
        "options": {"loss": "huber", "rim": 0},
    },
    "/api/chosen": {"number": 0},
}
UPLOADS = ("/api/photograph?encoding=srgb&name=", f"/api/mask?target={HELD}&name=",
           "/api/mesh?name=")  # fmt: skip
PAGES = [
    "/",
    "/lab.js",
    "/api/settings",
    "/api/nothing",
    "/../etc/passwd",
    "/%00",
    "*",
    "http://other/",
    "//other/x",
    "/?" + "x" * 9000,
    "/é",
    "/%ff%fe",
    "/api/",
]
METHODS = ["GET", "POST", "PUT", "HEAD", "OPTIONS", "DELETE", "TRACE", "CONNECT", "get",
           "X" * 300, "G T", "", "POST\t"]  # fmt: skip
HEADERS = [
    "Content-Length: 99999999999999999999", "Content-Length: -1", "Content-Length: x",
    "Content-Length: 3", "Content-Length: 3\r\nContent-Length: 4",
    "Expect: 100-continue", "Transfer-Encoding: chunked",
    "Transfer-Encoding: gzip, x", "Connection: close",
    "Content-Type: multipart/form-data; boundary=x", "Upgrade: websocket", ": x", "x",
    "X: " + "y" * 9000, "X:\x00", "Content-Encoding: gzip", "Range: bytes=0-1,5-",
    "X-A: 1\r\n " + "folded", "Connection: Upgrade, HTTP2-Settings",
]  # fmt: skip
# Whose page it is that asks: none of these is ours.
STRANGERS = ["Host: other", "Host: 127.0.0.1.other:80", "Host: [::1", "Host:",
             "Origin: http://other", "Origin: null", "Sec-Fetch-Site: cross-site",
             "Sec-Fetch-Site: same-site"]  # fmt: skip
NAMES = [
    "a.png",
    "a.jpg",
    "a.stl",
    "a.obj",
    "a.glb",
    "a",
    "..%2f..%2fx.png",
    "%00.png",
    "a.eps",
    "x" * 4000 + ".png",
    "%1b[31m.png",
    "a.exr",
    "a.mtl",
    "a.json",
]


class _Log(logging.Handler):
    """Keeps what the server complains of."""

    def __init__(self):
        super().__init__(logging.ERROR)
        self.words: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.words.append(self.format(record))


@functools.cache
def _server() -> tuple[int, _Log]:
    """A server of this process, begun with its first case: its port, its complaints."""
    import uvicorn

    from phongfit.lab import intake
    from phongfit.lab.server import configuration, listening
    from phongfit.lab.session import Session

    intake.HEAD_SECONDS = intake.PAUSE_SECONDS = HEAD_SECONDS
    ready, ports = threading.Event(), []

    def serve() -> None:
        with listening("127.0.0.1", 0) as listener:
            server = uvicorn.Server(configuration(Session(SIZE), "127.0.0.1"))
            ports.append(listener.getsockname()[1])
            ready.set()
            server.run(sockets=[listener])

    threading.Thread(target=serve, daemon=True).start()
    ready.wait()
    log = _Log()
    for name in ("uvicorn", "uvicorn.error"):
        logger = logging.getLogger(name)
        # Requests that are none are told of in the terminal, which is as it should be.
        logger.handlers, logger.propagate = [log], False
    return ports[0], log


def _new_target(port: int) -> str:
    """The server lives: a target that it has just made."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE)
    with contextlib.closing(connection):
        connection.request("POST", "/api/target", json.dumps({"settings": {}}))
        response = connection.getresponse()
        words = response.read()
    if response.status != 200:
        raise Wrong(f"no target any more: {response.status} {words!r}")
    token = json.loads(words)["target"]
    if len(token) != len(HELD):
        raise Wrong(f"a target of another length than {HELD}: {token}")
    return token


def _asked(random: np.random.Generator, stock: Path) -> tuple[str, str, bytes]:
    """A method, a target, and a body."""
    match int(random.integers(4)):
        case 0:
            return (
                str(random.choice(METHODS)),
                str(random.choice([*PAGES, *BODIES, *UPLOADS])),
                random.bytes(int(random.choice([0, 3, 2000]))),
            )
        case 1:
            images = bool(random.random() < 0.6)
            whole = pictures.whole(stock) if images else shapes.whole()
            name = str(random.choice(sorted(whole)))
            _, data = damaged(random, whole[name])
            path = str(random.choice(UPLOADS[:2])) if images else UPLOADS[2]
            if random.random() < 0.1:
                path = str(random.choice(UPLOADS))
            named = f"a{Path(f'x{name}').suffix}"
            if random.random() < 0.2:
                named = str(random.choice(NAMES))
            return "POST", path + named, data
    path = str(random.choice(list(BODIES)))
    if random.random() < 0.2:
        return "POST", path, json.dumps(BODIES[path]).encode()
    return "POST", path, changed(random, BODIES[path])[1]


def make(random: np.random.Generator, stock: Path) -> Case:
    method, target, body = _asked(random, stock)
    headers, stranger = [f"Content-Length: {len(body)}"], None
    if random.random() < 0.3:
        more = str(random.choice(HEADERS))
        headers = [more] if more.startswith(("Content-L", "Tr")) else [*headers, more]
    if random.random() < 0.2:
        stranger = str(random.choice(STRANGERS))
    cut = float(random.random()) if random.random() < 0.2 else 1.0
    leaves = bool(random.random() < 0.3)

    def act(folder: Path) -> None:
        del folder
        port, log = _server()
        token = _new_target(port)
        log.words.clear()
        host = f"Host: 127.0.0.1:{port}"
        own = [stranger] if stranger and stranger.startswith("Host") else [host]
        own += [stranger] if stranger and not stranger.startswith("Host") else []
        lines = [f"{method} {target} HTTP/1.1", *own, *headers, "", ""]
        sent = "\r\n".join(lines).encode("utf-8", "replace") + body
        # A target that is there: as long, so that all lengths stay right.
        sent = sent.replace(HELD.encode(), token.encode())
        sent = sent[: round(len(sent) * cut)]
        with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE) as client:
            # Whoever refuses early closes early.
            with contextlib.suppress(ConnectionError):
                client.sendall(sent)
            heard = b"" if leaves else _heard(client)
        _new_target(port)
        _wait_for_work()
        if log.words:
            raise Wrong(f"the server complains: {log.words[0][-600:]}")
        if stranger and b" 200 " in heard[:20]:
            raise Wrong(f"a stranger was answered: {heard[:200]!r}")
        _judge(heard)

    what = stranger or (headers[-1][:30] if len(headers) > 1 else "")
    title = f"{method[:9]} {target[:30]} {body[:60]!r} {what!r}"
    title += f" cut at {cut:.2f}" * (cut < 1) + " and gone" * leaves
    return Case(title, lambda folder: None, act)


def _heard(client: socket.socket) -> bytes:
    """What comes until the server closes, or has said all: it may keep the line."""
    heard, end = b"", time.monotonic() + PATIENCE
    while time.monotonic() < end:
        if not select.select([client], [], [], 0.1)[0]:
            if _is_whole(heard):
                return heard
            continue
        try:
            piece = client.recv(2**16)
        except ConnectionError:
            return heard
        if not piece:
            return heard
        heard += piece
        if _is_whole(heard):
            return heard
    raise Wrong(f"neither an answer nor an end in {PATIENCE} s: {heard[:200]!r}")


def _wait_for_work() -> None:
    """Until what a client left behind is no longer worked on: nothing stays."""
    end = time.monotonic() + PATIENCE
    while any(Path(tempfile.gettempdir()).iterdir()) and time.monotonic() < end:
        time.sleep(0.02)


def _is_whole(heard: bytes) -> bool:
    head, found, body = heard.partition(b"\r\n\r\n")
    if not found or head.startswith(b"HTTP/1.1 1"):
        return False
    for line in head.lower().split(b"\r\n"):
        if line.startswith(b"content-length:"):
            return len(body) >= int(line.partition(b":")[2])
    return True


def _judge(heard: bytes) -> None:
    """An answer is a refusal in one line, or what was asked for."""
    if not heard:
        raise ValueError("the connection was closed")
    head, _, body = heard.partition(b"\r\n\r\n")
    if head.startswith(b"HTTP/1.1 100"):
        head, _, body = body.partition(b"\r\n\r\n")
    status = int(head.split(b" ")[1])
    if status >= 500:
        raise Wrong(f"status {status}: {body[:300]!r}")
    if status >= 400:
        if b"Traceback" in body or len(body.splitlines()) > 1 or len(body) > 9000:
            raise Wrong(f"not one line: {body[:300]!r}")
        if b"application/json" in head and body:
            (words,) = json.loads(body).values()
            if not words.isprintable():
                raise Wrong(f"words that steer a terminal: {words!r}")
        raise ValueError(body.decode(errors="replace") or f"status {status}")
    if b"application/json" in head and b"HEAD" not in head:
        json.loads(body or b"null")


def prepare(stock: Path) -> None:
    pictures.prepare(stock)


KIND = Kind(make, prepare, seconds=30.0, megabytes=2500.0, share=0.5)
