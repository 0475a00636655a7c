"""`phongfit synth`: data sets of `data_synth`, if that is installed."""

import importlib.util
from collections.abc import Callable

PACKAGE = "data_synth"


def absent() -> int:
    """Make a data set with known truth. (Not here: data_synth is not installed.)"""
    raise ValueError(
        f"{PACKAGE} is not installed here; it comes with phongfit: pip install phongfit"
    )


def command() -> Callable[..., int]:
    """The function that makes data sets, from the optional package `data_synth`."""
    if importlib.util.find_spec(PACKAGE) is None:
        return absent
    from data_synth.__main__ import main

    return main


main = command()
