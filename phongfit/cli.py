"""What all commands share: options in, one clear line and an exit status out."""

import contextlib
import dataclasses
import functools
import inspect
import io
import os
import re
import sys
import typing
from collections.abc import Callable, Sequence
from typing import Any

import tyro

BAD_INPUT = 2
INTERRUPTED = 130
PIPE_CLOSED = 141


def run(
    function: Callable[..., int | None],
    args: Sequence[str] | None = None,
    *,
    prog: str | None = None,
) -> int:
    """Call a typed function with options from the command line.

    Each parameter is an option; if there is only one, a dataclass, each of its fields.

    **Arguments:**

    - `function`: its docstring is the help text. What it returns is the exit status,
        where None is 0. `ValueError` and `OSError` mean that the user's input is at
        fault and are told in one line; all others are faults of ours and keep their
        traceback.
    - `args`: default what the process was started with.
    - `prog`: the command's name in help texts.

    **Returns:** the exit status: the function's, 2 for bad input, 130 if interrupted.
    """
    try:
        call = _parse(function, args, prog)
        return call() or 0
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except KeyboardInterrupt:
        return _stop("interrupted", INTERRUPTED)
    except BrokenPipeError:
        # Whoever read the output, such as `head`, has seen enough.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return PIPE_CLOSED
    except OSError as error:
        return _stop(_explain(error), BAD_INPUT)
    except ValueError as error:
        return _stop(str(error), BAD_INPUT)


def _stop(message: str, status: int) -> int:
    print(f"error: {' '.join(message.split())}", file=sys.stderr, flush=True)
    return status


def _explain(error: OSError) -> str:
    if error.filename is None or error.strerror is None:
        return str(error)
    return f"{os.fsdecode(error.filename)}: {error.strerror}"


def _parse(
    function: Callable[..., int | None], args: Sequence[str] | None, prog: str | None
) -> Callable[[], int | None]:
    """The call that the options ask for, not yet made."""

    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return _call(function, functools.partial(tyro.cli, args=args, prog=prog))
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise ValueError(f"{_first_words(complaint.getvalue())} (see --help)") from None


def _call(
    function: Callable[..., int | None], parse: Callable[..., Any]
) -> Callable[[], int | None]:
    about = inspect.getdoc(function)
    hints = typing.get_type_hints(function)
    kinds = [hints.get(name) for name in inspect.signature(function).parameters]
    if len(kinds) == 1 and dataclasses.is_dataclass(kinds[0]):
        # Asked for directly, so that options are named --bits, not --options.bits.
        return functools.partial(function, parse(kinds[0], description=about))

    # Put off, since the parser would report the function's own errors as its own.
    @functools.wraps(function)
    def later(*args: Any, **kwargs: Any) -> Callable[[], int | None]:
        return functools.partial(function, *args, **kwargs)

    return parse(later, description=about)


def _first_words(box: str) -> str:
    """What a message of the parser says before its first rule, without its frame."""
    words = []
    for line in re.sub(r"\x1b\[[0-9;]*m", "", box).splitlines():
        text = line.strip().strip("│").strip()
        if text.startswith("╭") or text.startswith("╰"):
            continue
        if words and (not text or set(text) == {"─"}):
            break
        words.append(text)
    return " ".join(words).removesuffix(".")
