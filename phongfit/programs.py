"""Compiled programs: in a hurry, kept, and not waited for."""

import dataclasses
import functools
import gc
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, dataclass_transform, no_type_check

import equinox as eqx
import jax
from jax.extend.core import get_opaque_trace_state

from phongfit.cache import keep_compiled

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")

# Linux gives a process 65 530 pieces of memory, of which XLA takes dozens for each
# program, and fails without a word where there are no more.
MOST_PIECES = 40_000
# Programs that are compiled between two counts of these.
COUNTED = 100
# JAX's name of the event that a program was compiled.
COMPILED = "/jax/core/compile/backend_compile_duration"

# On a CPU: compiled in two thirds of the time, and a little slower.
HURRY = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 1}


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def record(cls: type[T]) -> type[T]:
    """A frozen dataclass of arrays that programs take.

    Made in a tenth of the time that an `equinox.Module` takes, and taken apart in C++:
    a fit makes and hands over a dozen. Fields of `metadata={"static": True}` are
    compiled in.
    """
    made = dataclasses.dataclass(frozen=True, eq=False)(cls)
    # JAX also constructs it with placeholders in place of arrays.
    no_type_check(made.__init__)
    return jax.tree_util.register_dataclass(made)


def program(*static: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """`jax.jit`, also for arguments that hold functions among their arrays.

    Unlike `equinox.filter_jit`, which waits for what it returns: so Python goes on
    meanwhile, and starts the next program beside this one.

    **Arguments:** `static`: names of arguments that are compiled in.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        part = jax.jit(function, static_argnames=static)
        careful = eqx.filter_jit(function)

        @functools.cache
        def whole() -> Callable[..., R]:
            _prepare()
            options = compiler_options()
            return jax.jit(function, static_argnames=static, compiler_options=options)

        @functools.wraps(function)
        def run(*args: P.args, **kwargs: P.kwargs) -> R:
            # While tracing, the function becomes part of the program around it.
            traced = get_opaque_trace_state() != _untraced()
            if not traced:
                _room.make()
            try:
                return (part if traced else whole())(*args, **kwargs)
            except TypeError:
                # To look for functions beforehand takes as long as to call a program.
                return careful(*args, **kwargs)

        return run

    return decorate


class _Room:
    """Sees to it that a process does not run out of pieces of memory."""

    def __init__(self) -> None:
        self._compiled = 0

    def count(self, event: str, duration_secs: float, **kwargs: Any) -> None:
        """Told of all that JAX does: of what it compiles, or loads."""
        del duration_secs, kwargs
        self._compiled += event == COMPILED

    def make(self) -> None:
        """Drop all compiled programs if memory maps run out; later calls recompile."""
        if self._compiled < COUNTED:
            return
        self._compiled = 0
        if pieces_of_memory() > MOST_PIECES:
            jax.clear_caches()
            gc.collect()


_room = _Room()


@functools.cache
def _prepare() -> None:
    """Once in a process: programs are kept for the next one, and counted."""
    keep_compiled()
    jax.monitoring.register_event_duration_secs_listener(_room.count)


def pieces_of_memory() -> int:
    """Number of memory maps of this process; 0 where the system does not state it."""
    maps = Path("/proc/self/maps")
    return maps.read_bytes().count(b"\n") if maps.exists() else 0


@functools.cache
def _untraced() -> Any:
    """JAX's trace state outside of any transformation, taken in a fresh thread."""
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(get_opaque_trace_state).result()


@functools.cache
def compiler_options() -> dict[str, Any] | None:
    """XLA options that `XLA_FLAGS` does not set already; `None` for none."""
    asked = os.environ.get("XLA_FLAGS", "")
    options = {name: value for name, value in HURRY.items() if name not in asked}
    if not options or jax.default_backend() != "cpu":
        return None
    try:
        jax.jit(lambda: 0, compiler_options=options).lower().compile()
    except jax.errors.JaxRuntimeError:
        # Undocumented options, which a later XLA may not have.
        return None
    return options
