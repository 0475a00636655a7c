"""Many, large, slow and broken requests: memory and time have a ceiling."""

import contextlib
import http.client
import json
import logging
import socket
import threading
import time
from typing import Any

import pytest

from phongfit.lab import intake
from phongfit.lab.uploads import MAX_BYTES
from tests.lab.conftest import serving

UPLOAD = "/api/photograph?name=a.png&encoding=srgb"


def _post(port, path, body: Any = b"", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    try:
        connection.request("POST", path, body, headers)
        response = connection.getresponse()
        return response.status, response.read()
    finally:
        connection.close()


def _begin(port, path, length) -> socket.socket:
    """A request that says that `length` bytes come, and sends two."""
    client = socket.create_connection(("127.0.0.1", port), timeout=30)
    head = f"POST {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n"
    client.sendall(f"{head}Content-Length: {length}\r\n\r\n{{}}".encode())
    return client


def _answer(client: socket.socket) -> str:
    """All of a refusal, in however many pieces it comes."""
    heard = b""
    while not heard.endswith(b"}") and (piece := client.recv(4096)):
        heard += piece
    return heard.decode()


@pytest.mark.parametrize(
    "path, limit", [("/api/picture", intake.MAX_WORDS), (UPLOAD, MAX_BYTES)]
)
def test_too_long_is_refused_before_it_comes(port, path, limit):
    with _begin(port, path, limit + 1) as client:
        answer = _answer(client)
    assert answer.startswith("HTTP/1.1 413")
    assert f"request: expected at most {limit} bytes, got {limit + 1}" in answer


def test_too_long_without_a_word_of_it(port):
    def pieces():
        for _ in range(3):
            yield b" " * (intake.MAX_WORDS // 2)

    status, answer = _post(port, "/api/picture", pieces())
    assert status == 413 and b"request: expected at most" in answer


def test_a_body_that_stops(port, monkeypatch):
    monkeypatch.setattr(intake, "PAUSE_SECONDS", 0.2)
    with _begin(port, "/api/picture", 100) as client:
        answer = _answer(client)
    assert "request: expected it whole, it stopped on its way" in answer


@pytest.mark.parametrize("sent", [b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: x"])
def test_a_head_that_stops(session, monkeypatch, sent):
    monkeypatch.setattr(intake, "HEAD_SECONDS", 0.2)
    with serving(session) as port:
        with socket.create_connection(("127.0.0.1", port), timeout=30) as client:
            client.sendall(sent)
            # The end, and no answer.
            assert client.recv(4096) == b""
        assert _post(port, "/api/picture", json.dumps({"settings": {}}))[0] == 200


def test_files_are_worked_on_one_after_the_other(session, port, monkeypatch):
    at_once, most, lock = 0, 0, threading.Lock()

    def add(name, content, encoding):
        nonlocal at_once, most
        with lock:
            at_once += 1
            most = max(most, at_once)
        time.sleep(0.02)
        with lock:
            at_once -= 1
        return {"name": name, "bytes": len(content), "encoding": encoding}

    monkeypatch.setattr(session, "add_photograph", add)
    answers = []
    clients = [
        threading.Thread(target=lambda: answers.append(_post(port, UPLOAD, b"x" * 99)))
        for _ in range(20)
    ]
    for client in clients:
        client.start()
    for client in clients:
        client.join()
    assert [status for status, _ in answers] == [200] * 20 and most == 1


def test_who_leaves_is_not_complained_about(port, caplog, capfd):
    with caplog.at_level(logging.WARNING):
        for path in ("/api/picture", UPLOAD):
            _begin(port, path, 100).close()
        assert _post(port, "/api/picture", json.dumps({"settings": {}}))[0] == 200
    assert not caplog.records and "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize("origin", ["", "Origin: null\r\n"])
def test_a_body_that_is_none(port, caplog, capfd, origin):
    head = f"POST /api/picture HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n{origin}"
    with caplog.at_level(logging.ERROR):
        with socket.create_connection(("127.0.0.1", port), timeout=30) as client:
            client.sendall(f"{head}Transfer-Encoding: chunked\r\n\r\nzz\r\n".encode())
            assert client.recv(4096).startswith(b"HTTP/1.1 4")
        assert _post(port, "/api/picture", json.dumps({"settings": {}}))[0] == 200
    assert not caplog.records and "Traceback" not in capfd.readouterr().err


def test_the_end_does_not_wait_for_work(session, monkeypatch, capfd):
    begun, let_go = threading.Event(), threading.Event()

    def fit(request):
        begun.set()
        let_go.wait(60)
        return {}

    def ask():
        # There is an answer, or none.
        with contextlib.suppress(OSError, http.client.HTTPException):
            _post(port, "/api/fit", json.dumps({"settings": {}, "target": "x"}))

    monkeypatch.setattr("phongfit.lab.server.PATIENCE", 0.1)
    monkeypatch.setattr(session, "fit", fit)
    asked = threading.Thread(target=ask)
    try:
        with serving(session) as port:
            asked.start()
            assert begun.wait(30)
        # The server has ended, and the work has not.
        assert not let_go.is_set()
    finally:
        let_go.set()
        asked.join()
    assert "Traceback" not in capfd.readouterr().err
