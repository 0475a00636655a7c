"""Photographs and their lamps, matched by the names of their files."""

import re
from collections.abc import Sequence
from pathlib import PurePosixPath, PureWindowsPath
from typing import NamedTuple


class Match(NamedTuple):
    """Partners of some names in another list.

    - `places`: for each name the place of its partner in the other list, or `None`.
    - `note`: how they were matched, in a sentence; empty where the names agree.
    """

    places: list[int | None]
    note: str = ""


def base_name(name: str) -> str:
    """A file's name without its folder, of any system."""
    return PureWindowsPath(PurePosixPath(name).name).name


def match_names(names: Sequence[str], others: Sequence[str]) -> Match:
    """Partners of photographs in a list of other names.

    By base name, whatever the case of its letters. Where no name at all is in the list,
    by the last number in each name, and where that fails, by order if the counts agree:
    a list of lamps often comes with another object's photographs.
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
    """The last number in each name; `None` unless each has one of its own."""
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
