"""The shell around all commands."""

import warnings
from dataclasses import dataclass

import pytest

from phongfit import cli
from phongfit.cli import _show_warning, run
from phongfit.files.budget import SWITCH, most


@dataclass(frozen=True)
class Options:
    count: int
    """How many."""

    name: str = "ball"
    """Of what."""


def command(options: Options) -> int:
    """Answer how many there are."""
    return options.count


def test_exit_status_is_the_functions():
    assert run(command, ["--count", "1"]) == 1
    assert run(lambda: None, []) == 0


def test_functions_without_a_dataclass():
    def add(first: int, second: int = 2) -> int:
        return first + second

    assert run(add, ["--first", "3"]) == 5


def test_help(capsys):
    assert run(command, ["--help"], prog="count") == 0
    text = capsys.readouterr().out
    assert "Answer how many there are." in text
    assert "How many." in text and "usage: count" in text


@pytest.mark.parametrize(
    "args, words",
    [
        (["--count", "many"], "--count: expected a whole number, got many"),
        (["--cuont", "1"], "there is no option --cuont; did you mean --count?"),
        (["--count", "1", "--zz"], "there is no option --zz (see"),
        (["--count", "1", "2"], "expected no more words, got 2"),
        ([], "expected --count INT, got none (see --help)"),
        (["--count"], "--count: expected a value, got none"),
    ],
)
def test_bad_options(args, words, capsys):
    assert run(command, args) == 2
    _check_error(capsys, words)


@pytest.mark.parametrize(
    "line, words",
    [
        ("fit x --nose 0.01", "there is no option --nose; did you mean --noise?"),
        ("fit", "expected DATASET and -o OUT, got none"),
        ("fit x -o y --sphere 1 2", "--sphere: expected X Y R, got 1 2"),
        ("scene --light 1 2", "--light: expected X Y Z, got fewer"),
        ("fit x -o y --noise a", "--noise: expected a number, got a"),
        ("fit x -o y --loss tuky", "tukey, got 'tuky'; did you mean tukey?"),
        ("export a -o b --to x", "--to: expected one of"),
        ("", "expected one of synth, calibrate, response, scene, "),
        ("ft", "there is no command 'ft'; did you mean 'fit'? (see --help)"),
        ("zzz", "there is no command 'zzz'; one of synth, calibrate"),
        ("--vrsion", "there is no option --vrsion; did you mean --version?"),
        ("--completion fish", "--completion: expected one of bash, zsh, got fish"),
    ],
)
def test_one_short_line_for_bad_options(line, words, capsys):
    assert cli.main(line.split()) == 2
    _check_error(capsys, words)


@pytest.mark.parametrize(
    "error, status, message",
    [
        (ValueError("mask:\n  leaves nothing"), 2, "error: mask: leaves nothing"),
        (OSError("out: is full"), 2, "error: out: is full"),
        (FileNotFoundError(2, "No such file", "a.png"), 2, "a.png: No such file"),
        (KeyboardInterrupt(), 130, "error: interrupted"),
    ],
)
def test_bad_input(error, status, message, capsys):
    def fail() -> None:
        raise error

    assert run(fail, []) == status
    _check_error(capsys, message)


def test_our_own_bugs_stay_visible():
    def fail() -> None:
        raise TypeError("a bug")

    with pytest.raises(TypeError, match="a bug"):
        run(fail, [])


def _check_error(capsys, words) -> None:
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err.startswith("error: ") and words in output.err
    assert output.err.endswith("\n") and output.err.count("\n") == 1


def test_what_steers_a_terminal_is_shown_as_text(capsys):
    def colourful() -> None:
        warnings.warn("a\x1b[31m.png", stacklevel=1)
        raise ValueError("b\x1b]0;title\x07\n.png: is missing")

    with warnings.catch_warnings():
        warnings.showwarning = _show_warning
        warnings.simplefilter("always")
        assert run(colourful, []) == 2
    told = capsys.readouterr().err
    assert told == (
        "warning: a\\x1b[31m.png\nerror: b\\x1b]0;title\\x07 .png: is missing\n"
    )


@pytest.mark.parametrize("words", [["--max-memory", "2G"], ["--max-memory=2G"]])
def test_the_limit_of_memory_is_an_option_of_all_commands(words, monkeypatch):
    seen = []
    monkeypatch.setattr(cli, "_overview", lambda args: seen.append((args, most())))
    monkeypatch.setenv(SWITCH, "5M")
    assert cli.main([*words, "--help"]) == 0
    assert seen == [(["--help"], 2**31)]
    assert most() == 5 * 2**20


@pytest.mark.parametrize("wrong", ["", "-1G", "much", "0"])
def test_a_limit_of_memory_that_is_none(wrong, capsys):
    assert cli.main(["--max-memory", wrong]) == 2
    _check_error(capsys, "max-memory: expected a size such as 4G")
