"""Photographs and their lamps, matched by the names of their files."""

import re
from collections.abc import Sequence
from pathlib import PurePosixPath, PureWindowsPath
from typing import NamedTuple


class Match(NamedTuple):
    """Result of matching some names with another list.

    - `places`: for each name the index of its partner in the other list, or `None`.
    - `note`: a sentence on the method of matching; empty if the names agree.
    """

    places: list[int | None]
    note: str = ""


def base_name(name: str) -> str:
    """A file's name without its folder, in POSIX or Windows notation."""
    return PureWindowsPath(PurePosixPath(name).name).name


def match_names(names: Sequence[str], others: Sequence[str]) -> Match:
    """Match the names of photographs with a list of other names.

    Names are compared without folders and case. If none agrees, as with a list for
    photographs of another object, the last numbers in the names are compared. If these
    differ too, photographs are matched by order, provided that the counts agree.
    """
    wanted, there = ([base_name(name) for name in some] for some in (names, others))
    exact = {name: k for k, name in enumerate(there)}
    lower = {name.lower(): k for k, name in enumerate(there)}
    places = [exact.get(name, lower.get(name.lower())) for name in wanted]
    if not wanted or any(place is not None for place in places):
        return Match(places)
    numbers, listed = _numbers(wanted), _numbers(there)
    if numbers and listed and set(numbers) <= set(listed):
        at = {number: k for k, number in enumerate(listed)}
        return Match([at[number] for number in numbers], _note("number", wanted, there))
    if len(wanted) == len(there):
        return Match([*range(len(there))], _note("order", wanted, there))
    return Match(places)


def _numbers(names: Sequence[str]) -> list[int] | None:
    """The last number in each name; `None` if one is missing or repeated."""
    found = [re.findall(r"\d+", PurePosixPath(name).stem) for name in names]
    if not all(found):
        return None
    numbers = [int(each[-1]) for each in found]
    return numbers if len(set(numbers)) == len(numbers) else None


def _note(how: str, wanted: Sequence[str], there: Sequence[str]) -> str:
    return (
        f"lamps are matched to photographs by {how}, since the list has other names "
        f"({there[0]} … for {wanted[0]} …)"
    )
