"""Untrusted JSON, parsed in linear time and within limits."""

import collections
import json
import math
from typing import Any

from phongfit.files.budget import afford

MAX_DEPTH = 100
"""Maximum nesting of objects and arrays; phongfit's files have about ten levels."""

MAX_DIGITS = 400
"""Maximum number of digits of a whole number: more than any finite float has."""

MAX_KEYS = 100_000
"""Maximum number of keys in one object."""


def parse_json(text: str | bytes) -> Any:
    """Parse a JSON text.

    **Raises:** `ValueError` that describes the error: invalid JSON, NaN or infinity,
    whole numbers too large for floating point, a repeated key, too deep nesting.
    """
    afford(_memory(text), "JSON")
    try:
        data = json.loads(
            text,
            object_pairs_hook=_unique_keys,
            parse_constant=_refuse_constant,
            parse_int=_integer,
        )
        _check_depth(data)
    except RecursionError:
        raise ValueError(
            f"is nested too deeply, expected at most {MAX_DEPTH} levels"
        ) from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"is no JSON: {error}") from None
    return data


def _memory(text: str | bytes) -> int:
    """Generous estimate of the bytes that a text takes when it is parsed and checked.

    A parsed object takes up to 1000 bytes.
    """
    count = text.count if isinstance(text, str) else lambda c: text.count(c.encode())
    return 2 * len(text) + 1000 * count("{") + 100 * (count("[") + count(","))


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    record = dict(pairs)
    if len(pairs) > MAX_KEYS:
        raise ValueError(f"expected at most {MAX_KEYS} keys, got {len(pairs)}")
    if len(record) != len(pairs):
        counts = collections.Counter(key for key, _ in pairs)
        (key, _), *_ = counts.most_common(1)
        raise ValueError(
            f"expected each key once in an object, got {shorten(key)} twice"
        )
    return record


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"expected finite numbers, got {name}")


def _integer(digits: str) -> int:
    if len(digits) > MAX_DIGITS or not math.isfinite(float(digits)):
        raise ValueError(f"expected finite numbers, got {_cut(digits)}")
    return int(digits)


def _check_depth(data: Any) -> None:
    """Raise `RecursionError` for data of more than `MAX_DEPTH` levels."""
    level = [data]
    for _ in range(MAX_DEPTH):
        level = [
            item
            for holder in level
            if isinstance(holder, list | dict)
            for item in (holder.values() if isinstance(holder, dict) else holder)
            if isinstance(item, list | dict)
        ]
        if not level:
            return
    raise RecursionError


def shorten(value: Any) -> str:
    """`value` as JSON, cut to 60 characters for a message."""
    return _cut(json.dumps(value, ensure_ascii=False, default=repr))


def unexpected(name: str, wanted: str, value: Any) -> ValueError:
    """An error that names the key of a value, what was expected and the value."""
    return ValueError(f"{name}: expected {wanted}, got {shorten(value)}")


def _cut(text: str) -> str:
    return text if len(text) <= 60 else text[:57] + "…"
