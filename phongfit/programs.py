"""`jax.jit` with options that shorten compilation on a CPU."""

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ParamSpec, TypeVar

import jax
from jax.extend.core import get_opaque_trace_state

P = ParamSpec("P")
R = TypeVar("R")

QUICK_COMPILATION = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": 1,
}
"""XLA options for CPUs, not documented by XLA.

A first fit of one 256² photograph takes 13 s of processor time with them and 21 s
without; the fit itself takes as long either way.
"""


def program(*static: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator: `jax.jit` with the options of [`QUICK_COMPILATION`][].

    JAX accepts options for the outermost program only. Inside another program, or under
    `jax.grad` or `jax.vmap`, the function is therefore a plain `jax.jit`.

    **Arguments:** `static`: names of static arguments, whose values are compiled in.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        inner = jax.jit(function, static_argnames=static)

        @functools.cache
        def outermost() -> Callable[..., R]:
            options = compiler_options()
            return jax.jit(function, static_argnames=static, compiler_options=options)

        @functools.wraps(function)
        def run(*args: P.args, **kwargs: P.kwargs) -> R:
            is_outermost = get_opaque_trace_state() == _untraced()
            return (outermost() if is_outermost else inner)(*args, **kwargs)

        return run

    return decorate


@functools.cache
def _untraced() -> Any:
    """JAX's trace state outside of any transformation.

    It is taken in a new thread, since this one may be inside a transformation.
    """
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(get_opaque_trace_state).result()


@functools.cache
def compiler_options() -> dict[str, Any] | None:
    """The options of `QUICK_COMPILATION` that `XLA_FLAGS` does not set, for `jax.jit`.

    `None`, which stands for no options, if none is left, on devices other than CPUs,
    and where this version of XLA does not have the options.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    options = {
        name: value for name, value in QUICK_COMPILATION.items() if name not in flags
    }
    if not options or jax.default_backend() != "cpu":
        return None
    try:
        # Tried on an empty program: a later XLA may not know these names.
        jax.jit(lambda: 0, compiler_options=options).lower().compile()
    except jax.errors.JaxRuntimeError:
        return None
    return options
