"""What a campaign is made of: cases, and the kinds that make them."""

import contextlib
import dataclasses
import io
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from phongfit.cli import BAD_INPUT, main

ASIDE = re.compile(r"warning: |[\w ]+: \d+ s so far$")
"""What a command says besides: warnings, and that it is still at work."""


class Wrong(Exception):
    """A case came out otherwise than it must."""


class Refused(Exception):
    """A command refused its input as it should."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One input, and what is done with it.

    - `name`: what is special about it, for people.
    - `arrange`: puts its files into an empty folder.
    - `act`: does what is judged. It ends (the input was taken), or raises `ValueError`,
        `OSError` or [`Refused`][] (it was refused). [`Wrong`][] and everything else is
        a fault.
    - `outputs`: what names in the folder are like that may be written if the input is
        taken, as shells match them; a folder's with all in it.
    - `anyway`: likewise, whether it is taken or not.
    """

    name: str
    arrange: Callable[[Path], None]
    act: Callable[[Path], Any]
    outputs: tuple[str, ...] = ()
    anyway: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Kind:
    """Cases of one sort.

    - `make`: a case from random numbers and the stock's folder.
    - `prepare`: puts into the stock's folder what takes long to make, once a campaign.
    - `seconds`: of one core that a case may take; `megabytes`: of memory, in all.
    - `share`: how many cases of it, relative to the other kinds.
    """

    make: Callable[[np.random.Generator, Path], Case]
    prepare: Callable[[Path], None] | None = None
    seconds: float = 10.0
    megabytes: float = 1500.0
    share: float = 1.0


def files(**named: bytes) -> Callable[[Path], None]:
    """Puts files of these names (`a__png` for `a.png`) into a folder."""
    return put({name.replace("__", "."): data for name, data in named.items()})


def put(contents: dict[str, bytes]) -> Callable[[Path], None]:
    """Puts files of these names, folders included, into a folder."""

    def arrange(folder: Path) -> None:
        for name, data in contents.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)

    return arrange


@contextlib.contextmanager
def blaming(name: str) -> Iterator[None]:
    """A refusal within must be one line of print, and name the file that is at fault.

    **Arguments:** `name`: of the file, or a part of its name.
    """
    try:
        yield
    except ValueError as error:
        words = str(error)
        if name not in words:
            raise Wrong(f"a refusal that does not name {name}: {words}") from error
        if len(words) > 2000:
            raise Wrong(f"a refusal of {len(words)} characters") from error
        raise


def command(*args: Any) -> str:
    """Run a command as `phongfit ARGS` does, in this process.

    **Returns:** what it printed to its standard output.

    **Raises:** `Refused` with its one line; `Wrong` for another status or other words.
    """
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main([str(arg) for arg in args])
    lines = err.getvalue().splitlines()
    said = [line for line in lines if not ASIDE.match(line)]
    if any(not character.isprintable() for line in lines for character in line):
        raise Wrong(f"words that steer a terminal: {err.getvalue()!r}")
    if status == BAD_INPUT:
        if len(said) != 1 or not said[0].startswith("error: ") or len(said[0]) < 12:
            raise Wrong(f"not one line of an error: {err.getvalue()!r}")
        raise Refused(said[0])
    # 1 is the answer of a fit that does not converge.
    if status not in (0, 1) or said:
        raise Wrong(f"status {status}: {err.getvalue()!r}")
    return out.getvalue()
