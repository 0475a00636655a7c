"""The command `phongfit`: parse options, run a command, return its exit status."""

import _thread
import contextlib
import dataclasses
import difflib
import functools
import importlib.metadata
import inspect
import io
import os
import signal
import sys
import threading
import typing
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import tyro

from phongfit import commands
from phongfit.files import budget

COMMANDS = {
    "synth": "Render photographs of a ball of known material, to practise with.",
    "calibrate": "Find the lamps of a capture by spheres in its photographs.",
    "response": "Check a camera's response, and fit it where it is not sRGB.",
    "scene": "Write a scene file: surface, camera and lights, to render and to fit.",
    "render": "Render a scene with a material, as an image.",
    "fit": "Fit a material to photographs: values, errors, pictures, a report.",
    "maps": "Fit a material per pixel to photographs under many lights.",
    "relight": "Show a mapped object under other lights, a picture for each light.",
    "view": "Write a page on which the pointer moves a lamp over the mapped object.",
    "predict": "Predict standard errors before taking photographs.",
    "export": "Write a material for other programs: .mtl, glTF, OpenGL, JSON.",
    "lab": "Move the model's sliders in a browser, and fit a target with one press.",
}
"""Summaries of the commands, whose code is in `phongfit/commands/NAME.py`."""

ABOUT = """Fit the Phong illumination model to images, with honest error bars.

For example:
  phongfit synth out/brass --material preset:brass --noise 0.01
  phongfit fit out/brass -o out/fit
  phongfit export out/fit -o out/brass.glb
  phongfit fit --help

phongfit --version prints the version. phongfit --completion bash (or zsh) prints what
makes a shell complete commands and options: eval "$(phongfit --completion bash)".

Errors are reported in one line, with exit status 2; an interrupt with 130, SIGTERM
with 143. What was compiled is kept in $XDG_CACHE_HOME/phongfit (else
~/.cache/phongfit), which may be deleted at any time; PHONGFIT_CACHE=FOLDER puts it
elsewhere, PHONGFIT_CACHE=off nowhere. JAX_ENABLE_X64=1 computes in double precision.

No file may take more than 1 GB of memory when it is read, whatever it says that it
holds; --max-memory 4G, of any command, or PHONGFIT_MAX_MEMORY=4G allows more.
"""

COMPLETION = "--completion"
SHELLS = ("bash", "zsh")

Result = TypeVar("Result")

# Exit statuses; as in a shell, a signal's is 128 plus its number (SIGPIPE is 13).
BAD_INPUT = 2
PIPE_CLOSED = 128 + 13


def main(args: Sequence[str] | None = None) -> int:
    """Run a command of `phongfit`.

    **Arguments:** `args`: words of the command line; default `sys.argv[1:]`.

    **Returns:** the exit status: that of the command, 2 for bad input, 130 after
    Ctrl-C, 143 after SIGTERM, 141 if the reader of the output closed the pipe.
    """
    owns_process = (
        args is None and threading.current_thread() is threading.main_thread()
    )
    args = list(sys.argv[1:] if args is None else args)
    _escape_unprintable()
    with _repeated_interrupts(), _clean_up_on_signals(), warnings.catch_warnings():
        warnings.showwarning = _show_warning
        status = _guard(lambda: _run(args))
    if owns_process and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        # Ctrl-C while the interpreter shuts down ends the process without a traceback.
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    return status


def _run(args: list[str]) -> int | None:
    """Run a command and return its exit status; `None` stands for 0.

    `--max-memory` and `--version` are handled here.

    **Raises:** `ValueError` for no command or an unknown one, and for wrong options.
    """
    # This takes `--max-memory` out of `args`.
    with _memory(args):
        if args and args[0] in COMMANDS:
            command = _load(args[0])
            return _execute(_parse(command, args[1:], f"phongfit {args[0]}"))
        if args == ["--version"]:
            print(f"phongfit {importlib.metadata.version('phongfit')}")
            return 0
        return _overview(args)


@contextlib.contextmanager
def _memory(args: list[str]) -> Iterator[None]:
    """Remove `--max-memory SIZE` from `args`; the limit holds within the context.

    **Raises:** `ValueError` that names the option, if SIZE is not a size such as 4G.
    """
    before = os.environ.get(budget.SWITCH)
    for at, word in enumerate(args):
        name, equals, size = word.partition("=")
        if name == budget.OPTION:
            size = size if equals else "".join(args[at + 1 : at + 2])
            budget.parse_size(budget.OPTION.removeprefix("--"), size)
            os.environ[budget.SWITCH] = size
            del args[at : at + (1 if equals else 2)]
            break
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(budget.SWITCH, None)
        else:
            os.environ[budget.SWITCH] = before


@contextlib.contextmanager
def _repeated_interrupts() -> Iterator[None]:
    """Within the context, repeat a Ctrl-C that Python would otherwise swallow.

    The garbage collector calls functions of JAX. If Ctrl-C arrives there, Python prints
    the exception and goes on, so the command would not stop.
    """
    before = sys.unraisablehook

    def repeat(unraisable: Any) -> None:
        if not issubclass(unraisable.exc_type, KeyboardInterrupt):
            return before(unraisable)
        # Later, when the garbage collector has returned.
        threading.Timer(0.05, _thread.interrupt_main).start()

    sys.unraisablehook = repeat
    try:
        yield
    finally:
        sys.unraisablehook = before


class _Ended(KeyboardInterrupt):
    """A signal other than Ctrl-C that ends the process: `number` is the signal's.

    It is handled where `KeyboardInterrupt` is.
    """

    def __init__(self, number: int):
        super().__init__()
        self.number = number


@contextlib.contextmanager
def _clean_up_on_signals() -> Iterator[None]:
    """Within the context, SIGTERM and SIGHUP raise an exception, as Ctrl-C does.

    So commands clean up before the process ends. A signal that was ignored before, for
    example by `nohup`, stays ignored. Threads other than the main one cannot set
    handlers: there nothing changes.
    """

    def end(number: int, frame: Any) -> None:
        del frame
        raise _Ended(number)

    names = ("SIGTERM", "SIGHUP")
    ends = [getattr(signal, name) for name in names if hasattr(signal, name)]
    if threading.current_thread() is not threading.main_thread():
        ends = []
    ends = [number for number in ends if signal.getsignal(number) is signal.SIG_DFL]
    for number in ends:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number in ends:
            signal.signal(number, signal.SIG_DFL)


def _escape_unprintable() -> None:
    """Let output escape characters that its encoding lacks, instead of failing."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _load(name: str) -> Callable[..., int | None]:
    """Import a command's module; return the function that runs the command."""
    return getattr(commands, name).main


def _overview(args: Sequence[str]) -> None:
    """Print the help on all commands, or the script for `--completion`.

    **Raises:** `ValueError` for no command, or an unknown one.
    """
    if not args:
        raise ValueError(
            f"expected one of {', '.join(COMMANDS)}, got none (see --help)"
        )
    if args[0] == COMPLETION:
        return _complete(args[1:])
    if not args[0].startswith("-"):
        near = difflib.get_close_matches(args[0], COMMANDS, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"one of {', '.join(COMMANDS)}"
        raise ValueError(f"there is no command {args[0]!r}; {hint} (see --help)")

    # The parser makes the help from functions: one with a docstring for each command,
    # and one whose parameters are the options of all commands.
    def named(summary: str) -> Callable[[], None]:
        def command() -> None: ...

        command.__doc__ = summary
        return command

    def general(version: bool, completion: str, max_memory: str) -> None: ...

    summaries = {name: named(summary) for name, summary in COMMANDS.items()}
    _quietly(functools.partial(_subcommands, summaries), args, general)


def _subcommands(
    functions: dict[str, Callable[..., Any]], args: Sequence[str] | None
) -> Any:
    """Parse the name of a command and its options with tyro; return its result."""
    return tyro.extras.subcommand_cli_from_dict(
        functions, prog="phongfit", description=ABOUT, args=args
    )


def _complete(args: Sequence[str]) -> None:
    """Print the shell's script for completion of commands, options and file names."""
    if len(args) != 1 or args[0] not in SHELLS:
        got = " ".join(args) or "none"
        raise ValueError(
            f"{COMPLETION}: expected one of {', '.join(SHELLS)}, got {got}"
        )
    every = {name: _load(name) for name in COMMANDS}
    _subcommands(every, ["--tyro-print-completion", args[0]])


def _show_warning(message: Warning | str, *where: Any) -> None:
    """Print a warning on one line, without category and line of code."""
    del where
    print(f"warning: {_on_one_line(str(message))}", file=sys.stderr, flush=True)


def run(
    function: Callable[..., int | None],
    args: Sequence[str] | None = None,
    *,
    prog: str | None = None,
) -> int:
    """Call a typed function with options from the command line.

    Each parameter is an option; if there is only one, a dataclass, each of its fields.

    **Arguments:**

    - `function`: returns the exit status, `None` for 0; its docstring is the help
        text. `ValueError` and `OSError` mean wrong input and are reported in one line;
        all other exceptions are bugs of phongfit and keep their traceback.
    - `args`: default the arguments of the process.
    - `prog`: the command's name in help texts.

    **Returns:** the exit status: the function's, 2 for bad input, 130 if interrupted.
    """
    return _guard(lambda: _execute(_parse(function, args, prog)))


def _execute(call: Callable[[], int | None]) -> int | None:
    """Make a call; its compiled programs are cached for later processes."""
    from phongfit.cache import cache_programs

    cache_programs()
    return call()


def _guard(call: Callable[[], int | None]) -> int:
    """Make a call and return its exit status.

    `ValueError`, `OSError` and lack of memory are reported in one line with status 2;
    other exceptions are raised.
    """
    try:
        return call() or 0
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except KeyboardInterrupt as stop:
        ended = isinstance(stop, _Ended)
        number = stop.number if ended else signal.SIGINT
        word = f"ended by {signal.Signals(number).name}" if ended else "interrupted"
        return _stop("; ".join([word, *map(str, stop.args)]), 128 + number)
    except BrokenPipeError:
        # The reader of the output, such as `head`, closed the pipe.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return PIPE_CLOSED
    except MemoryError:
        return _stop("there is not enough memory for data of this size", BAD_INPUT)
    except OSError as error:
        return _stop(_explain(error), BAD_INPUT)
    except ValueError as error:
        return _stop(str(error), BAD_INPUT)


def _stop(message: str, status: int) -> int:
    """Print an error message, and return `status`."""
    print(f"error: {_on_one_line(message)}", file=sys.stderr, flush=True)
    return status


def _on_one_line(message: str) -> str:
    """A message on one line, with control characters escaped."""
    return "".join(
        letter if letter.isprintable() else letter.encode("unicode_escape").decode()
        for letter in " ".join(message.split())
    )


def _explain(error: OSError) -> str:
    """The message of an error: the file, and what the system reports of it."""
    if error.filename is None or error.strerror is None:
        return str(error)
    return f"{os.fsdecode(error.filename)}: {error.strerror}"


def _parse(
    function: Callable[..., int | None], args: Sequence[str] | None, prog: str | None
) -> Callable[[], int | None]:
    """Parse the options; returns the call of `function` with them, not yet made."""

    def parse(args: Sequence[str] | None) -> Callable[[], int | None]:
        return _call(function, functools.partial(tyro.cli, args=args, prog=prog))

    return _quietly(parse, args, _parsed(function))


def _quietly(
    parse: Callable[[Sequence[str] | None], Result],
    args: Sequence[str] | None,
    kind: Callable[..., Any],
) -> Result:
    """Return `parse(args)`; an error of the parser becomes a `ValueError`.

    **Arguments:** `kind`: the function or dataclass whose parameters are the options.
    """
    from phongfit.commands.complaints import in_one_line, on_parse_error, options_of

    error_output = io.StringIO()

    def complain(event: Any) -> None:
        words = in_one_line(event, options_of(kind))
        if words is not None:
            raise ValueError(f"{words} (see --help)")

    try:
        with on_parse_error(complain), contextlib.redirect_stderr(error_output):
            return parse(args)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise ValueError(f"{error_output.getvalue()} (see --help)") from None


def _call(
    function: Callable[..., int | None], parse: Callable[..., Any]
) -> Callable[[], int | None]:
    """The call of a command's function, not yet made, with the parsed options.

    **Arguments:** `parse`: `tyro.cli`, with the words of the command line bound.
    """
    about, kind = inspect.getdoc(function), _parsed(function)
    if kind is not function:
        # The dataclass itself is parsed: options are named --bits, not --options.bits.
        return functools.partial(function, parse(kind, description=about))

    # The call is deferred: the parser would report its errors as wrong options.
    @functools.wraps(function)
    def later(*args: Any, **kwargs: Any) -> Callable[[], int | None]:
        return functools.partial(function, *args, **kwargs)

    return parse(later, description=about)


def _parsed(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, or the single dataclass that it takes: fields become options."""
    hints = typing.get_type_hints(function)
    kinds = [hints.get(name) for name in inspect.signature(function).parameters]
    one = kinds[0] if len(kinds) == 1 else None
    return typing.cast(type, one) if dataclasses.is_dataclass(one) else function
