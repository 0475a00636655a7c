"""Checks of the arguments of public functions, by their annotations.

An argument of a wrong kind raises an error that names it, before any work is done.
Traced arrays pass unchanged, so `jit`, `vmap` and `grad` see the function as it is.
NumPy's whole numbers become Python's where one number is wanted, since those of 8 bits
overflow in sums. Arguments annotated with `Any` are checked by the function itself,
with [`phongfit.checks`][].
"""

import dataclasses
import functools
import inspect
import os
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Literal, NamedTuple, ParamSpec, TypeVar, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import AbstractArray

P = ParamSpec("P")
R = TypeVar("R")

SHOWN = 60
"""Largest number of characters of a value in a message."""


class Kind(NamedTuple):
    """A kind of argument.

    - `words`: its description, which completes "expected …".
    - `holds`: a test.
    - `one_number`: whether one plain number is of this kind, so that it is no array.
    """

    words: str
    holds: Callable[[Any], bool]
    one_number: bool = False


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """Decorator: check a function's arguments against its annotations at each call.

    Costs a few microseconds a call. Too many arguments and unknown names raise
    `TypeError`, as usual. An iterator given for a sequence is read into a tuple, since
    checking it would consume it.

    Options annotated as `**options: Unpack[...]` of a `TypedDict` are checked by its
    annotations, and are in the function's signature, where their default `...` means
    that of the options.

    **Raises:** `ValueError` that names the argument, what was expected and what came.
    """
    signature = inspect.signature(function)
    names = [
        name
        for name, parameter in signature.parameters.items()
        if parameter.kind
        in (parameter.POSITIONAL_ONLY, parameter.POSITIONAL_OR_KEYWORD)
    ]
    options = _options_of(function)
    whole = _with_options(signature, options) if options else signature

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        named = [_check(function, *pair) for pair in zip(names, args, strict=False)]
        given = {name: _check(function, name, kwargs[name]) for name in kwargs}
        if options:
            _check_names(function, kwargs, whole)
        # For surplus arguments the function raises its own TypeError.
        return function(*named, *args[len(named) :], **given)  # pyright: ignore

    if options:
        vars(call)["__signature__"] = whole
    return call


def _options_of(annotated: Any) -> dict[str, Any]:
    """Annotations of the options in `**options: Unpack[...]`, if there are any."""
    for hint in inspect.get_annotations(inspect.unwrap(annotated)).values():
        if typing.get_origin(hint) is Unpack:
            return inspect.get_annotations(typing.get_args(hint)[0])
    return {}


def _with_options(
    signature: inspect.Signature, options: Mapping[str, Any]
) -> inspect.Signature:
    """The signature with each of the options in place of `**options`."""
    *others, _ = signature.parameters.values()
    keyword = inspect.Parameter.KEYWORD_ONLY
    named = [
        inspect.Parameter(name, keyword, default=..., annotation=hint)
        for name, hint in options.items()
    ]
    return signature.replace(parameters=[*others, *named])


def _check_names(
    function: Callable[..., Any], given: Iterable[str], signature: inspect.Signature
) -> None:
    names = [name for name in signature.parameters if name != "self"]
    for name in given:
        if name not in names:
            # A constructor is named after its class.
            called = function.__qualname__.removesuffix(".__init__").split(".")[-1]
            raise TypeError(
                f"{called}() got an unexpected keyword argument {name!r}, expected "
                f"one of {', '.join(names)}"
            )


def check_fields(record: Any) -> None:
    """Check a dataclass's fields against their annotations, after they are set.

    **Raises:** `ValueError` that names the field.
    """
    for field in dataclasses.fields(record):
        _check(type(record), field.name, getattr(record, field.name))


@functools.cache
def _kinds(annotated: Any) -> dict[str, Kind | None]:
    """Kinds of a function's arguments or a class's fields, from their annotations.

    They are read at the first check, when all names in the annotations are defined.
    """
    hints = inspect.get_annotations(inspect.unwrap(annotated)) | _options_of(annotated)
    return {name: kind_of(hint) for name, hint in hints.items()}


def _check(annotated: Any, name: str, value: Any) -> Any:
    """Check one argument or field, and return it, a few types converted.

    Iterators become tuples, and NumPy's whole numbers Python's, unless the argument is
    an array.

    **Raises:** `ValueError` that names the argument.
    """
    kind = _kinds(annotated).get(name)
    if kind is None:
        return value
    if isinstance(value, Iterator) and not kind.holds(value):
        value = tuple(value)
    if not kind.holds(value):
        raise ValueError(f"{name}: expected {kind.words}, got {shown(value)}")
    if kind.one_number and isinstance(value, np.integer):
        return int(value)
    return value


def shown(value: Any) -> str:
    """Any value in a few words on one line, for a message."""
    if isinstance(value, jax.Array | np.ndarray) and np.ndim(value):
        kind = "a masked" if isinstance(value, np.ma.MaskedArray) else "an"
        return f"{kind} array of shape {value.shape}, {value.dtype}"
    plain = value is None or isinstance(
        value, str | bytes | int | float | complex | np.generic | list | tuple | dict
    )
    try:
        text = repr(value) if plain else type(value).__name__
    except Exception:
        # `repr` raises for integers of thousands of digits, and for some objects.
        text = type(value).__name__
    if isinstance(value, type):
        text = f"the class {value.__name__}"
    text = " ".join(text.split())
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 1]}…"


def kind_of(hint: Any) -> Kind | None:
    """The kind of value that an annotation allows; `None` if any value passes."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return _any_of(parts)
    if origin is Literal:
        return Kind(_either([repr(part) for part in parts]), _choice_test(parts))
    if origin is tuple and len(parts) == 2 and parts[1] is Ellipsis:
        return _sequence_kind(parts[0])
    if isinstance(origin, type):
        if issubclass(origin, Mapping):
            return _mapping_kind(*parts)
        if origin is not tuple and issubclass(origin, Iterable):
            return _sequence_kind(parts[0])
        if origin is os.PathLike:
            return Kind("a path", _is_path)
        return Kind("a function", callable) if origin is _CALLABLE else None
    if hint is None or hint is types.NoneType:
        return Kind("None", lambda value: value is None)
    if not isinstance(hint, type) or getattr(hint, "_is_protocol", False):
        return None
    if hint is Any or hint is object:
        return None
    if hint in _PLAIN:
        return _PLAIN[hint]
    if issubclass(hint, AbstractArray):  # pyright: ignore
        return Kind("an array of real numbers", _is_array)
    article = "an" if hint.__name__[0] in "AEIOU" else "a"
    return Kind(f"{article} {hint.__name__}", lambda value: isinstance(value, hint))


def _any_of(parts: tuple[Any, ...]) -> Kind | None:
    """The kind of a union of annotations; `None` if one of them allows any value."""
    # `str` beside a path is described as a path.
    paths = [part for part in parts if typing.get_origin(part) is os.PathLike]
    kinds = [kind_of(part) for part in parts if not (paths and part is str)]
    known = [kind for kind in kinds if kind is not None]
    if len(known) < len(kinds):
        return None
    return Kind(
        _either([kind.words for kind in known]),
        lambda value: any(kind.holds(value) for kind in known),
        any(kind.one_number for kind in known),
    )


def _either(words: list[str]) -> str:
    """A list in words: "a, b or c"."""
    *most, last = words
    return f"{', '.join(most)} or {last}" if most else last


def _choice_test(choices: tuple[Any, ...]) -> Callable[[Any], bool]:
    """Test whether a value is one of these texts and whole numbers."""

    def holds(value: Any) -> bool:
        # Arrays and unhashable values are not compared, which could raise.
        return isinstance(value, str | int | np.integer) and value in choices

    return holds


def _sequence_kind(part: Any) -> Kind:
    """The kind of a sequence whose entries are annotated with `part`."""
    entry_kind = kind_of(part)
    words = "a list" if entry_kind is None else f"a list, each entry {entry_kind.words}"
    words = "a list of names" if part is str else words

    def holds(values: Any) -> bool:
        if isinstance(values, str | bytes | Mapping | Iterator | Tracer):
            return False
        if isinstance(values, np.ndarray | jax.Array):
            # JAX's arrays of complex numbers or random keys are rejected.
            has_list = isinstance(values, np.ndarray) or _is_real(values)
            values = values.tolist() if has_list else None
        return isinstance(values, Iterable) and (
            entry_kind is None or all(entry_kind.holds(value) for value in values)
        )

    return Kind(words, holds)


def _mapping_kind(key: Any, part: Any) -> Kind:
    """The kind of a mapping whose keys and values are annotated with these."""
    key_kind, value_kind = kind_of(key), kind_of(part)
    words = "a mapping of names"
    if value_kind is not None:
        words += f", each to {value_kind.words}"

    def holds(values: Any) -> bool:
        return isinstance(values, Mapping) and all(
            (key_kind is None or key_kind.holds(name))
            and (value_kind is None or value_kind.holds(value))
            for name, value in values.items()
        )

    return Kind(words, holds)


def _is_path(value: Any) -> bool:
    """Whether a value is a path without null characters, which systems reject."""
    return isinstance(value, str | os.PathLike) and "\0" not in str(value)


def _is_real(value: Any) -> bool:
    """Whether a value is an array or a NumPy number, and real or Boolean."""
    if not isinstance(value, jax.Array | np.ndarray | np.generic):
        return False
    kinds = jnp.floating, jnp.integer, jnp.bool_
    return any(jnp.issubdtype(value.dtype, kind) for kind in kinds)


def _is_array(value: Any) -> bool:
    """Whether a value is an array of real numbers without a mask, or one number."""
    if isinstance(value, int):
        # JAX converts Python's integers to 32 bits.
        return -(2**31) <= value < 2**31
    if isinstance(value, np.ma.MaskedArray):
        # JAX would drop the mask silently, or raise a less clear error.
        return False
    return _is_real(value) or is_number(value)


def is_number(value: Any) -> bool:
    """Whether a value is one real number and not NaN; a traced one may be NaN.

    Python's whole numbers may have at most 64 bits.
    """
    if isinstance(value, int):
        return _fits(value)
    if isinstance(value, float):
        return bool(value == value)
    if not _is_real(value) or np.ndim(value):
        return False
    return isinstance(value, Tracer) or bool(value == value)


def _is_whole(value: Any) -> bool:
    """Whether a value is a known whole number of at most 64 bits, and not a Boolean."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    return whole and _fits(int(value))


def _fits(number: int) -> bool:
    """Whether a whole number fits in 64 bits, with sign."""
    return -(2**63) <= number < 2**63


def _is_flag(value: Any) -> bool:
    """Whether a value is a known Boolean, or the whole number 0 or 1."""
    if isinstance(value, int):
        return value in (0, 1)
    if not _is_real(value) or np.ndim(value) or isinstance(value, Tracer):
        return False
    return value.dtype.kind == "b"


# `collections.abc.Callable`, as `typing.get_origin` returns it for annotations.
_CALLABLE = typing.get_origin(Callable[[], None])
_PLAIN: dict[Any, Kind] = {
    str: Kind("text", lambda value: isinstance(value, str)),
    bool: Kind("True or False", _is_flag),
    int: Kind("a whole number of at most 64 bits", _is_whole, one_number=True),
    float: Kind("a number", is_number, one_number=True),
    type: Kind("a class", lambda value: isinstance(value, type)),
}
