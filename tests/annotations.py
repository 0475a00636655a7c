"""`-p tests.annotations`: what is annotated is checked while the tests run.

Shapes, types and the names of axes, of what a function of phongfit was given and of
what it gives back, by jaxtyping and beartype. They are looked at when it returns: what
its annotations forbid, it may refuse in its own words.
"""

from collections.abc import Callable
from typing import Any

import jaxtyping
import pytest
from beartype import BeartypeConf, FrozenDict, beartype
from pydantic import ValidationInfo

_typed = beartype(
    conf=BeartypeConf(
        # An int is as good as a float.
        is_pep484_tower=True,
        # pydantic's protocol, which nothing can be asked for.
        hint_overrides=FrozenDict({ValidationInfo: object}),
    )
)


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, checked where it is the one that jaxtyping calls with the result.

    The other one, which it calls before, is said to give back anything.
    """
    before = function.__annotations__.get("return", Any) is Any
    return function if before else _typed(function)


@pytest.hookimpl(tryfirst=True)
def pytest_load_initial_conftests() -> None:
    """Before any test, or what prepares it, imports phongfit."""
    jaxtyping.install_import_hook("phongfit", "tests.annotations.checked")
