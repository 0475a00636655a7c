"""`phongfit lab`, up to the server."""

import importlib.util
import socket

import pytest
import uvicorn

from phongfit.cli import run
from phongfit.commands import lab
from phongfit.lab.server import listening
from phongfit.lab.session import Session
from tests.helpers import said


@pytest.mark.parametrize(
    "options, words",
    [
        (["--port", "70000"], "port: expected 0 … 65535"),
        (["--resolution", "4"], "resolution: expected ... got 4"),
        (["--host", "no.such.host.invalid"], "host, port: cannot listen at no.such"),
    ],
)
def test_bad_options(options, words, refused):
    assert said(words, refused("lab", "--no-browser", *options))


def test_a_port_that_is_taken(refused):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        told = refused("lab", "--no-browser", "--port", port)
    assert f"127.0.0.1, {port}" in told and "--port 0" in told


def test_what_it_needs_is_missing(monkeypatch, refused):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda n: None if n == "uvicorn" else find(n)
    )
    told = refused("lab", "--no-browser", "--port", 0)
    assert "uvicorn not installed: pip install 'phongfit[lab]'" in told


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_it_starts_and_stops(monkeypatch, capsys, host):
    """The page's address, a word if others can reach it, and no error in Ctrl-C."""
    opened = []

    def serve(server, sockets):
        assert not server.config.access_log
        opened.append(sockets[0].getsockname())
        raise KeyboardInterrupt

    monkeypatch.setattr(uvicorn.Server, "run", serve)
    monkeypatch.setattr(lab, "leave_work_behind", lambda: None)
    monkeypatch.setattr(Session, "warm_up", lambda session: None)
    options = ["--no-browser", "--port", "0", "--resolution", "64", "--host", host]
    assert run(lab.main, options) == 0
    printed = capsys.readouterr()
    ((address, port),) = opened
    assert address == host and f"http://127.0.0.1:{port}/" in printed.out
    assert printed.out.endswith("stopped\n")
    assert ("other machines" in printed.err) == (host == "0.0.0.0")


def test_help(capsys):
    assert run(lab.main, ["--help"], prog="phongfit lab") == 0
    text = capsys.readouterr().out
    assert "--host" in text and "this machine" in text


def test_only_this_machine_is_let_in():
    with listening("127.0.0.1", 0) as listener:
        assert listener.getsockname()[0] == "127.0.0.1"
        assert listener.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
