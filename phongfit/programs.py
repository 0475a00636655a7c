"""Compiled programs that nobody waits for until a result is looked at."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import equinox as eqx
import jax

P = ParamSpec("P")
R = TypeVar("R")


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
