"""What a command says while it is at work."""

import io
import sys

import pytest

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
