"""What a command says while it is at work."""

import io
import sys

import pytest

from phongfit.commands import progress
from phongfit.commands.progress import stage


class Terminal(io.StringIO):
    def isatty(self):
        return True


def written(stream):
    assert isinstance(stream, io.StringIO)
    return stream.getvalue()


@pytest.mark.parametrize("out, err", [(True, True), (True, False), (False, True)])
def test_a_word_where_both_are_a_terminal(monkeypatch, out, err):
    for name, wanted in (("stdout", out), ("stderr", err)):
        monkeypatch.setattr(sys, name, Terminal() if wanted else io.StringIO())
    with stage("Tracing"):
        pass
    assert ("Tracing …" in written(sys.stderr)) == (out and err)
    assert written(sys.stdout) == ""


def test_a_log_gets_a_line_now_and_then(monkeypatch):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    with stage("Tracing"):
        pass
    assert written(sys.stderr) == ""
    monkeypatch.setattr(progress, "EVERY", 1e-3)
    with stage("Tracing"):
        while "Tracing: 0 s so far\n" not in written(sys.stderr):
            pass
