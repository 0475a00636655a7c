"""One-line messages on wrong options, from the parser's account of what is wrong."""

import dataclasses
import difflib
import re
import typing
from collections.abc import Callable, Collection
from typing import Any

# Not public, but with data in place of text in a box; other events keep tyro's words.
from tyro._errors import (
    BadValue,
    InstantiationFailure,
    InvalidChoice,
    MissingArgs,
    ParseErrorEvent,
    UnrecognizedArgs,
    on_parse_error as on_parse_error,
)

KINDS = {
    "|FLOAT could": "a number",
    "to float:": "a number",
    "|INT could": "a whole number",
    "int()": "a whole number",
}
"""Parts of the parser's messages, and plain words for the type that it expected."""


def options_of(kind: Callable[..., Any]) -> set[str]:
    """All options of a function, or of a dataclass and those within it."""
    names = set()
    for name, hint in typing.get_type_hints(kind).items():
        if dataclasses.is_dataclass(hint):
            names |= options_of(typing.cast(type, hint))
        elif name != "return":
            names.add("--" + name.replace("_", "-"))
    return names


def in_one_line(event: ParseErrorEvent, options: Collection[str]) -> str | None:
    """A message on wrong options; `None` for an event that tyro itself explains.

    **Arguments:** `options`: all known options, such as `--noise`, to suggest a correct
    spelling.
    """
    match event:
        # Unknown options come first: a missing option may just be misspelt.
        case (
            UnrecognizedArgs(tokens=[*words])
            | MissingArgs(unrecognized_tokens=[*words])
        ) if words:
            return _unknown(words, options)
        case MissingArgs(missing_arguments=missing):
            names = [_named(one.arg, with_value=True) for one in missing]
            return f"expected {' and '.join(names)}, got none"
        case BadValue(argument=argument):
            several = argument.lowered.nargs not in (None, 1)
            few = (
                f"{argument.lowered.metavar}, got fewer"
                if several
                else "a value, got none"
            )
            return f"{_named(argument)}: expected {few}"
        case InvalidChoice(argument=argument, value=got, choices=choices):
            known = [word for word in choices if word != "None"]
            # The parser's order of a choice that may be left out is arbitrary.
            known.sort(key=lambda word: (word.isdecimal() and int(word), word))
            words = f"{_named(argument)}: expected one of {', '.join(known)}, got"
            return f"{words} {got!r}{_hint(got, known)}"
        case InstantiationFailure(argument=argument, message=message) if argument:
            message = message.partition("Got errors")[0]
            got = " ".join(re.findall(r"'([^']*)'", message))
            plain = (words for part, words in KINDS.items() if part in message)
            wanted = next(plain, argument.lowered.metavar or "another value")
            return f"{_named(argument)}: expected {wanted}, got {got or 'none'}"
    return None


def _named(argument: Any, with_value: bool = False) -> str:
    metavar = argument.lowered.metavar
    if argument.is_positional():
        return metavar
    flags = argument.lowered.name_or_flags
    return f"{flags[0]} {metavar}" if with_value else flags[-1]


def _unknown(words: Collection[str], options: Collection[str]) -> str:
    name = next((word for word in words if word.startswith("-")), None)
    if name is None:
        return f"expected no more words, got {' '.join(words)}"
    return f"there is no option {name}{_hint(name.partition('=')[0], options)}"


def _hint(word: str, known: Collection[str]) -> str:
    near = difflib.get_close_matches(word, known, n=1)
    return f"; did you mean {near[0]}?" if near else ""
