"""Conversion of numbers, arrays and text to JSON's types."""

import math
import os
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np


def plain(value: Any) -> Any:
    """Convert a value to JSON's types: lists, dictionaries, numbers, text.

    Arrays become lists of the shortest decimals that round to the same floats. Paths
    become text, and so do keys. NaN and infinity become `None`, since JSON does not
    have them.

    **Raises:** `TypeError` for types that JSON cannot hold, such as complex numbers.
    """
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        return _plain_array(np.asarray(value))
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")


def readable(name: str) -> str:
    """The name of a file as text; bytes that are not UTF-8 are written as escapes."""
    return name.encode("utf-8", "backslashreplace").decode("utf-8")


def _plain_array(array: np.ndarray) -> Any:
    """An array as nested lists; one of shape () as a number."""
    if array.ndim > 0:
        return [plain(item) for item in array]
    if array.dtype.kind != "f":
        return plain(array.item())
    # Through the shortest text: a float32 of 0.1 becomes 0.1, not 0.10000000149011612.
    return plain(float(str(array[()])))
