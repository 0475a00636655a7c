"""`-p tests.annotations`: what is annotated is checked while the tests run.

Shapes, types and the names of axes, of what a function of phongfit was given and of
what it gives back, by jaxtyping and beartype. What its annotations forbid, it may
refuse in its own words.
"""

import dataclasses
import functools
from collections.abc import Callable
from types import CodeType, FunctionType
from typing import Any

import jaxtyping
import pytest
from beartype import BeartypeConf, FrozenDict, beartype
from beartype.roar import (
    BeartypeCallHintParamViolation,
    BeartypeCallHintReturnViolation,
)
from jaxtyping import jaxtyped
from pydantic import ValidationInfo

Function = Callable[..., Any]

_typed = beartype(
    conf=BeartypeConf(
        # An int is as good as a float.
        is_pep484_tower=True,
        # pydantic's protocol, which nothing can be asked for.
        hint_overrides=FrozenDict({ValidationInfo: object}),
    )
)


class Forbidden(AssertionError):
    """A function was given, or gave back, what its annotations forbid."""


# Of each function within a function the first one made, and its checks.
_firsts: dict[CodeType, tuple[Function, FunctionType]] = {}


def checked(function: FunctionType) -> Function:
    """The function, which looks at what it is given and at what it gives back.

    One that does not say what it gives back takes what it is given as it comes.
    """
    if "return" not in function.__annotations__:
        return function

    @functools.cache
    def typed() -> Function:
        # Not before it is called: by then all that its annotations name is there.
        inner = "<locals>" in function.__qualname__
        return _checks_of_first(function) if inner else _typed_as_known(function)

    @functools.wraps(function)
    def run(*args: Any, **kwargs: Any) -> Any:
        __tracebackhide__ = True
        with jaxtyped("context"):
            try:
                return typed()(*args, **kwargs)
            except BeartypeCallHintParamViolation as wrong:
                function(*args, **kwargs)
                raise Forbidden(wrong) from None
            except BeartypeCallHintReturnViolation as wrong:
                raise Forbidden(wrong) from None

    return run


def _typed_as_known(function: FunctionType) -> FunctionType:
    """With checks of all annotations but those that only a type checker can read."""
    written, names = function.__annotations__, function.__globals__

    def read(hint: Any) -> Any:
        try:
            return eval(hint, names) if isinstance(hint, str) else hint
        except NameError:
            return Any

    function.__annotations__ = {name: read(hint) for name, hint in written.items()}
    typed = _typed(function)
    function.__annotations__ = written
    return typed


def _checks_of_first(function: FunctionType) -> Function:
    """Those of the first function of the same code, around this one.

    It is made anew at each call of the outer one, and to write its checks takes a
    hundred times as long as to call it.
    """
    if function.__code__ not in _firsts:
        _firsts[function.__code__] = function, _typed_as_known(function)
    first, typed = _firsts[function.__code__]
    given = typed.__kwdefaults__ or {}
    if all(value is not first for value in given.values()):
        # Nothing is annotated, or beartype knows another way now.
        return _typed_as_known(function)
    code, names = typed.__code__, typed.__globals__
    anew = FunctionType(code, names, typed.__name__, typed.__defaults__)
    anew.__kwdefaults__ = {
        name: function if value is first else value for name, value in given.items()
    }
    return anew


def _checked_class(made: type) -> type:
    """A class, whose `__init__` is checked if a dataclass wrote it."""
    start: Any = made.__init__
    plain = isinstance(start, FunctionType) and not hasattr(start, "__wrapped__")
    left_out = getattr(start, "__no_type_check__", False)
    if dataclasses.is_dataclass(made) and plain and not left_out:
        made.__init__ = checked(start)
    return made


def _decorator(*, typechecker: Any) -> Callable[[Any], Any]:
    """What the hook puts before each function and class, in place of jaxtyping's own.

    That looks up for each call which argument is which, to name it in an error, and
    takes several times as long.
    """
    del typechecker
    return lambda made: (
        _checked_class(made) if isinstance(made, type) else checked(made)
    )


@pytest.hookimpl(tryfirst=True)
def pytest_load_initial_conftests() -> None:
    """Before any test, or what prepares it, imports phongfit."""
    jaxtyping.jaxtyped = _decorator
    jaxtyping.install_import_hook("phongfit", None)
