"""One-line messages on wrong options, from the parser's boxed output."""

import difflib
import re
from collections.abc import Collection, Iterator

OPTION = re.compile(r"(?<![\w-])--[a-z][\w-]*")

OPENINGS = (
    "Unrecognized options",
    "Missing from",
    "Missing value",
    "invalid choice",
    "Error parsing",
)
"""Beginnings of the parser's error messages."""

KINDS = {"FLOAT": "a number", "INT": "a whole number", "int()": "a whole number"}
"""The parser's names of types, and plain words for them."""


def in_one_line(box: str, options: Collection[str]) -> str:
    """An error message of tyro, without frame and without repeated help.

    **Arguments:**

    - `box`: tyro's output.
    - `options`: all known options, such as `--noise`, to suggest a correct spelling.
    """
    parts = list(_parts(box))
    # If frames are drawn with dashes, the title is a separate part.
    opening = (k for k, part in enumerate(parts) if part[0].startswith(OPENINGS))
    parts = parts[next(opening, 0) :]
    words = " ".join(parts[0]) if parts else ""
    for part in parts:
        # Unknown options come first: a missing option may just be misspelt.
        if part[0].startswith("Unrecognized options:"):
            return _unknown(" ".join(part).partition(":")[2], options)
    if words.startswith("Missing from"):
        return _missing(parts)
    if words.startswith("Missing value for argument"):
        return f"{_quoted(words)}: expected a value, got none"
    if words.startswith("invalid choice"):
        return _choice(words)
    if words.startswith("Error parsing"):
        return _value(words, parts)
    return words.removesuffix(".")


def _parts(box: str) -> Iterator[list[str]]:
    """Groups of lines between a box's horizontal rules, without its frame."""
    part: list[str] = []
    for line in re.sub(r"\x1b\[[0-9;]*m", "", box).splitlines():
        text = line.strip().strip("│|").strip()
        # Terminals without line-drawing characters get frames of dashes.
        if text.startswith(("╭", "╰")) or text.endswith(("───", "---")):
            if part:
                yield part
            part = []
        elif text:
            part.append(text)
    if part:
        yield part


def _unknown(words: str, options: Collection[str]) -> str:
    names = [word for word in re.split(r"[,\s]+", words) if word]
    name = next((word for word in names if word.startswith("-")), None)
    if name is None:
        return f"expected no more words, got {' '.join(names)}"
    near = difflib.get_close_matches(name.partition("=")[0], options, n=1)
    hint = f"; did you mean {near[0]}?" if near else ""
    return f"there is no option {name}{hint}"


def _missing(parts: list[list[str]]) -> str:
    """A message with the names of missing options, without their help."""
    # Positional arguments appear as a metavar in capitals; other lines are help.
    names = []
    for line in parts[0][1:]:
        if line.startswith("-"):
            names.append(line.partition(", --")[0])
        elif line.isupper():
            names.append(line)
    return f"expected {' and '.join(names)}, got none"


def _choice(words: str) -> str:
    got, option = re.findall(r"'([^']*)'", words)[:2]
    known = re.findall(r"'([^']*)'", words.partition("Expected one of")[2])
    known = [word for word in known if word != "None"]
    near = difflib.get_close_matches(got, known, n=1)
    hint = f"; did you mean {near[0]}?" if near else ""
    return f"{option}: expected one of {', '.join(known)}, got {got!r}{hint}"


def _value(words: str, parts: list[list[str]]) -> str:
    option, _, said = words.removeprefix("Error parsing ").partition(": ")
    got = re.findall(r"'([^']*)'", said.partition("Got errors")[0])
    metavar = parts[1][1].partition(" ")[2] if len(parts) > 1 else ""
    found = re.search(r"(?:\|(FLOAT|INT) could|(int\(\)))", said)
    wanted = KINDS[found[1] or found[2]] if found else metavar or "another value"
    return f"{option}: expected {wanted}, got {' '.join(got) or 'none'}"


def _quoted(words: str) -> str:
    """The long name of the option in quotation marks."""
    return words.split("'")[1].rpartition("/")[2]
