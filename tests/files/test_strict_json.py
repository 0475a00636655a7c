"""JSON from outside: in linear time, and nothing odd."""

import pytest

from phongfit.files.strict_json import MAX_KEYS, _unique_keys, parse_json, shorten


class Counted(str):
    """A key that counts how often it is compared."""

    compared = 0

    def __eq__(self, other):
        Counted.compared += 1
        return str(self) == str(other)

    __hash__ = str.__hash__


@pytest.mark.parametrize(
    "text, told",
    [
        ('{"a": 1, "b": 2, "a": 3}', 'each key once in an object, got "a" twice'),
        ("NaN", "finite numbers, got NaN"),
        ("9" * 500, "finite numbers, got 999"),
        ("[" * 200 + "]" * 200, "nested too deeply"),
        ("[" * 10**6, "nested too deeply"),
        ("{", "is no JSON"),
        (b"\xff", "is no JSON"),
        ("{},".join("[") + "{}," * 10**6 + "1]", "at most .* of memory"),
    ],
    ids=["twice", "nan", "digits", "deep", "deeper", "cut", "bytes", "many objects"],
)
def test_what_is_refused(text, told):
    with pytest.raises(ValueError, match=told):
        parse_json(text)


def test_a_key_twice_among_many_is_found_in_linear_time():
    pairs: list[tuple[str, int]] = [(Counted(k), 0) for k in [*range(3000), 2999]]
    with pytest.raises(ValueError, match='"2999" twice'):
        _unique_keys(pairs)
    # Quadratic are four million.
    assert Counted.compared < 10 * len(pairs)


def test_too_many_keys():
    with pytest.raises(ValueError, match=f"at most {MAX_KEYS} keys"):
        _unique_keys([(str(k), 0) for k in range(MAX_KEYS + 1)])


def test_what_is_taken():
    assert parse_json('{"a": [1, 2.5, null, {"b": "c"}]}') == {
        "a": [1, 2.5, None, {"b": "c"}]
    }
    assert shorten("x" * 100) == '"' + "x" * 56 + "…"
