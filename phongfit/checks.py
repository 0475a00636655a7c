"""Conversion of arguments to arrays, with errors that name the argument and the fault.

Shapes are always checked. Known values are checked at once, traced ones (inside `jit`,
`vmap` or `grad`) by `eqx.error_if` when the program runs.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from phongfit.edge import shown

MOST_MATERIALS = 2**16
"""Largest number of materials of a surface."""

NOISE = 1e-12, 1e12
"""Range of standard deviations: σ² and 1 / σ² do not overflow in single precision."""


def unmasked(name: str, value: Any) -> None:
    """Raise a `ValueError` if `value` is masked: conversion would drop its mask."""
    if isinstance(value, np.ma.MaskedArray):
        raise ValueError(f"{name}: expected an array without a mask, got a masked one")


def is_noise(values: Any) -> Any:
    """Whether each number is a usable standard deviation: neither tiny nor huge."""
    return (values >= NOISE[0]) & (values <= NOISE[1])


def as_floats(name: str, value: Any) -> Float[Array, "..."]:
    """`value` as an array of JAX's default float type; `ValueError` names `name`.

    Any shape; NaN and infinity are accepted.
    """
    wanted = jnp.result_type(float)
    unmasked(name, value)
    try:
        # Through NumPy, which compiles nothing, unless the list contains a tracer.
        given = isinstance(value, Array)
        array = value if given else (jnp if is_traced(value) else np).asarray(value)
        # Kind V includes bfloat16. Text and objects raise JAX's error.
        if array.dtype.kind not in "bfiucV":
            array = jnp.asarray(value)
    except Exception as error:
        # Conversion runs code of the object's class, which may raise anything.
        got = shown(value)
        raise ValueError(f"{name}: {got} is not an array of numbers") from error
    if jnp.issubdtype(array.dtype, jnp.complexfloating):
        raise ValueError(f"{name}: expected real numbers, got complex numbers")
    # Numbers too large for this precision become infinite; the caller rejects these.
    with np.errstate(over="ignore"):
        return jnp.asarray(array if array.dtype == wanted else array.astype(wanted))


def as_array(name: str, value: Any) -> np.ndarray:
    """`value` as a NumPy array of any type and shape; `ValueError` names `name`."""
    try:
        return np.asarray(value)
    except Exception as error:
        raise ValueError(f"{name}: {shown(value)} is not an array") from error


def as_vector(name: str, value: Any) -> Float[Array, "3"]:
    """`value` as a finite vector of shape (3,); `ValueError` names `name`."""
    return as_finite(name, value, (3,))


def as_finite(name: str, value: Any, shape: tuple[int, ...]) -> Float[Array, "..."]:
    """`value` as finite numbers of this shape; `ValueError` names `name`."""
    array = as_floats(name, value)
    if array.shape != shape:
        raise ValueError(f"{name}: expected shape {shape}, got {array.shape}")
    return require(name, array, finite, "finite numbers")


def as_scalar(name: str, value: Any) -> Float[Array, ""]:
    """`value` as one finite number of shape (); `ValueError` names `name`."""
    array = as_floats(name, value)
    if array.shape != ():
        raise ValueError(f"{name}: expected one number, got shape {array.shape}")
    return require(name, array, finite, "a finite number")


def as_positive(name: str, value: Any, below: float = np.inf) -> Float[Array, ""]:
    """`value` as one finite number > 0 and < `below`; `ValueError` names `name`."""
    wanted = "a number > 0" + (f" and < {below:g}" if below < np.inf else "")
    scalar = as_scalar(name, value)
    return require(name, scalar, lambda a: (a > 0) & (a < below), wanted)


def as_light(name: str, value: Any) -> Float[Array, "3"]:
    """`value`, one number or three, as RGB light of shape (3,), finite and ≥ 0.

    **Raises:** `ValueError` that names `name`.
    """
    array = as_floats(name, value)
    if array.shape not in ((), (1,), (3,)):
        raise ValueError(f"{name}: expected shape () or (3,), got {array.shape}")
    return at_least(name, jnp.broadcast_to(array, (3,)), 0)


def as_reflectance(name: str, value: Any) -> Float[Array, "..."]:
    """`value` as an array ≥ 0 whose shape is () or ends in 1 or 3, the colour axis.

    **Raises:** `ValueError` that names `name`, also for numbers that are not finite.
    """
    array = as_floats(name, value)
    if array.ndim > 0 and array.shape[-1] not in (1, 3):
        raise ValueError(
            f"{name}: expected 1 or 3 along the last axis, which is colour, got "
            f"{array.shape} (one number for each of {array.shape[-1]} materials has "
            f"shape ({array.shape[-1]}, 1))"
        )
    return at_least(name, array, 0)


def as_integers(name: str, value: Any, lowest: int, below: float) -> np.ndarray:
    """`value` as known whole numbers in [lowest, below); `ValueError` names `name`.

    Returns a NumPy array, since these numbers are static in compiled programs. Its type
    is int32, so numbers must also be below 2³¹.
    """
    if isinstance(value, Tracer):
        raise ValueError(f"{name}: expected known numbers, got a traced array")
    unmasked(name, value)
    array = as_array(name, value)
    if array.dtype.kind not in "iu":
        raise ValueError(f"{name}: expected whole numbers, got {array.dtype}")
    below = min(below, 2**31)
    wrong = (array < lowest) | (array >= below)
    if wrong.any():
        where = tuple(int(i) for i in np.argwhere(wrong)[0])
        raise ValueError(
            f"{name}: expected whole numbers ≥ {lowest} and < {below}, got "
            f"{array[where]} at {where}"
        )
    return array.astype(np.int32)


def as_indices(
    name: str, value: Any, shape: tuple[int, ...]
) -> tuple[Int[Array, "..."] | None, int]:
    """`value` as material indices of `shape`, and the number of materials.

    The number is the largest index plus 1. `None` stands for a single material: the
    result is (`None`, 1).

    **Raises:** `ValueError` that names `name`.
    """
    if value is None:
        return None, 1
    array = as_integers(name, value, 0, MOST_MATERIALS)
    if array.shape != shape:
        raise ValueError(f"{name}: expected shape {shape}, got {array.shape}")
    return jnp.asarray(array), int(array.max(initial=0)) + 1


def as_covariance(name: str, value: Any) -> Float[np.ndarray, "n n"]:
    """`value` as a covariance matrix: finite, symmetric, positive semidefinite.

    Deviations of up to 1e-6 of the largest entry count as rounding; the result is made
    symmetric.

    **Arguments:** `value`: numbers of shape (n, n), which the caller has checked.

    **Raises:** `ValueError` that names `name`.
    """
    matrix = np.asarray(value, float)
    slack = 1e-6 * np.abs(matrix).max(initial=0)
    with np.errstate(all="ignore"):
        if not np.allclose(matrix, matrix.T, atol=slack):
            raise ValueError(f"{name}: expected a symmetric covariance")
        matrix = (matrix + matrix.T) / 2
        if not np.linalg.eigvalsh(matrix).min(initial=0) >= -slack:
            raise ValueError(
                f"{name}: expected a covariance, got a negative variance along some "
                "direction"
            )
    return matrix


def as_function(name: str, value: Any) -> Any:
    """The function `value` as a pytree whose leaves are arrays, as `jax.jit` needs.

    A plain function becomes a `jax.tree_util.Partial`, which is static; the arrays of a
    callable `equinox.Module` stay arrays, so that they have gradients.

    **Raises:** `ValueError` that names `name` if `value` cannot be called.
    """
    if not callable(value):
        raise ValueError(f"{name}: expected a function, got {value!r}")

    def static(leaf: Any) -> Any:
        is_function = callable(leaf) and not eqx.is_array(leaf)
        return jax.tree_util.Partial(leaf) if is_function else leaf

    return jax.tree.map(static, value)


def at_least(name: str, array: Array, lowest: float) -> Array:
    """Return `array` if it is finite and ≥ `lowest`; else an error names `name`."""
    wanted = f"finite numbers ≥ {lowest:g}"
    return require(name, array, lambda a: finite(a) & (a >= lowest), wanted)


def nonzero(name: str, vector: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return `vector`, or raise an error that names `name` if it has no direction.

    That is a zero vector, or one whose squared length underflows or overflows.
    """

    def fine(a: Any) -> Any:
        # Its square must neither underflow nor overflow in this precision.
        squared = (a * a).sum()
        return (squared >= np.finfo(a.dtype).tiny) & (squared < np.inf)

    wanted = "a vector that is not zero, nor too short or too long to square"
    with np.errstate(over="ignore", under="ignore"):
        return require(name, vector, fine, wanted)


def finite(values: Any) -> Any:
    """True where the numbers of an array, of NumPy or JAX, are finite."""
    # `jnp.isfinite` would compile a program for known values.
    return abs(values) < np.inf


def untraced(instead: str, **arguments: Any) -> None:
    """Raise an error that names the first argument that contains a JAX tracer.

    **Arguments:**

    - `instead`: what to do instead; the end of the message.
    - `arguments`: pytrees, by their names.
    """
    # One test of all arguments, since nearly always none is traced.
    if not is_traced(arguments):
        return
    name = next(name for name, value in arguments.items() if is_traced(value))
    raise ValueError(
        f"{name}: expected known numbers, got a traced array (inside jit, grad or "
        f"vmap); {instead}"
    )


def is_traced(value: Any) -> bool:
    """Whether any leaf of a pytree is a JAX tracer."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(value))


def require(
    name: str,
    array: Array,
    test: Callable[[Any], Any],
    wanted: str,
) -> Array:
    """Return `array`, or raise an error that begins with `name` if the test fails.

    **Arguments:**

    - `test`: gets known values as an array of NumPy, so that nothing is compiled, and
        traced ones, inside `jit`, as they are: there the error comes when the program
        runs. It returns true, or an array of true, for valid values.
    - `wanted`: completes "expected …".
    """
    if isinstance(array, Tracer):
        return eqx.error_if(array, ~test(array), f"{name}: expected {wanted}")
    values = np.asarray(array)
    if not np.all(test(values)):
        shown = np.array2string(values, threshold=6, precision=6)
        raise ValueError(f"{name}: expected {wanted}, got {shown}")
    return array
