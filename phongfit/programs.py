"""Compiled programs: in a hurry, ahead, kept, and not waited for."""

import dataclasses
import functools
import gc
import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, dataclass_transform, no_type_check
from weakref import WeakKeyDictionary

import equinox as eqx
import jax
import numpy as np
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
# What JAX calls it.
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
        part = jax.jit(function, static_argnames=static)
        careful = eqx.filter_jit(function)

        @functools.cache
        def whole() -> Callable[..., R]:
            _prepare()
            options = compiler_options()
            return jax.jit(function, static_argnames=static, compiler_options=options)

        @functools.wraps(function)
        def run(*args: P.args, **kwargs: P.kwargs) -> R:
            # What is traced becomes part of another program, with that one's options.
            traced = get_opaque_trace_state() != _untraced()
            if not traced:
                _room.make()
                _ahead.wait(run, args, kwargs)
            try:
                return (part if traced else whole())(*args, **kwargs)
            except TypeError:
                # To look for functions beforehand takes as long as to call a program.
                return careful(*args, **kwargs)

        _ahead.programs[run] = whole
        return run

    return decorate


def compile_ahead(
    function: Callable[P, object], *args: P.args, **kwargs: P.kwargs
) -> None:
    """Begin to compile a program, beside what else is done, for a call that will come.

    **Arguments:** `function`: a [`program`][]; the others are those of the call, with
    any numbers.
    """
    _ahead.begin(function, args, kwargs)


def is_new(*arguments: Any) -> bool:
    """Whether it is asked for the first time of arguments of this kind.

    What is begun for the first of a kind in a process would be in vain for others.
    """
    kind = _kind(None, arguments, {})
    if kind in _seen:
        return False
    _seen.add(kind)
    return True


_seen: set[Any] = set()


class _Ahead:
    """Programs that another thread compiles, until they are called."""

    def __init__(self) -> None:
        self.programs: WeakKeyDictionary[Callable[..., Any], Callable[[], Any]]
        self.programs = WeakKeyDictionary()
        self._coming: dict[Any, Future[None]] = {}

    def begin(self, function: Callable[..., Any], args: Any, kwargs: Any) -> None:
        """In the other thread, which does one after another."""
        key = _kind(function, args, kwargs)
        coming = _beside().submit(_compile, self.programs[function](), args, kwargs)
        self._coming[key] = coming
        # Perhaps nobody asks for it.
        coming.add_done_callback(lambda _: self._coming.pop(key, None))

    def wait(self, function: Callable[..., Any], args: Any, kwargs: Any) -> None:
        """Until the program of a call is there, if it was begun."""
        if not self._coming:
            return
        coming = self._coming.get(_kind(function, args, kwargs))
        if coming is not None:
            # If it failed, the call does, too, and says why.
            wait([coming])


_ahead = _Ahead()


@functools.cache
def _beside() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, "compiler")


def _compile(whole: Any, args: Any, kwargs: Any) -> None:
    whole.lower(*args, **kwargs).compile()


def _kind(function: Callable[..., Any] | None, args: Any, kwargs: Any) -> Any:
    """What tells a program apart: what is called, and with which arrays."""
    leaves, structure = jax.tree.flatten((args, kwargs))
    kinds = tuple(
        (np.shape(leaf), leaf.dtype) if hasattr(leaf, "dtype") else leaf
        for leaf in leaves
    )
    return function, structure, kinds, jax.config.read("jax_enable_x64")


class _Room:
    """Sees to it that a process does not run out of pieces of memory."""

    def __init__(self) -> None:
        self._compiled = 0

    def count(self, event: str, duration_secs: float, **kwargs: Any) -> None:
        """Told of all that JAX does: of what it compiles, or loads."""
        del duration_secs, kwargs
        self._compiled += event == COMPILED

    def make(self) -> None:
        """Where there is little left, all programs go; those in use come again."""
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
    """How many this process has; 0 where nothing tells."""
    maps = Path("/proc/self/maps")
    return maps.read_bytes().count(b"\n") if maps.exists() else 0


@functools.cache
def _untraced() -> Any:
    """JAX's state where it traces nothing, as it does not in a thread of its own."""
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(get_opaque_trace_state).result()


@functools.cache
def compiler_options() -> dict[str, Any] | None:
    """What XLA is asked for, unless `XLA_FLAGS` says otherwise; `None` for nothing."""
    asked = os.environ.get("XLA_FLAGS", "")
    options = {name: value for name, value in HURRY.items() if name not in asked}
    if not options or jax.default_backend() != "cpu":
        return None
    try:
        jax.jit(lambda: 0, compiler_options=options).lower().compile()
    except jax.errors.JaxRuntimeError:
        # These names are of XLA's inner life, and may go.
        return None
    return options
