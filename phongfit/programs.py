"""Compiled programs that nobody waits for until a result is looked at."""

import dataclasses
import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar, dataclass_transform, no_type_check

import equinox as eqx
import jax

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def record(cls: type[T]) -> type[T]:
    """A frozen dataclass of arrays that programs take.

    Made in a tenth of the time that an `equinox.Module` takes, and taken apart in C++:
    a fit makes and hands over a dozen. Fields of `metadata={"static": True}` are
    compiled in.
    """
    made = dataclasses.dataclass(frozen=True, eq=False)(cls)
    # JAX makes it of what stands for arrays, too.
    no_type_check(made.__init__)
    return jax.tree_util.register_dataclass(made)


def program(*static: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """`jax.jit`, also for arguments that hold functions among their arrays.

    Unlike `equinox.filter_jit`, which waits for what it returns: so Python goes on
    meanwhile, and starts the next program beside this one.

    **Arguments:** `static`: names of arguments that are compiled in.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        compiled = jax.jit(function, static_argnames=static)
        careful = eqx.filter_jit(function)

        @functools.wraps(function)
        def run(*args: P.args, **kwargs: P.kwargs) -> R:
            try:
                return compiled(*args, **kwargs)
            except TypeError:
                # To look for functions beforehand takes as long as to call a program.
                return careful(*args, **kwargs)

        return run

    return decorate
