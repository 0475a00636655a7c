"""Gradient checks for your own tests: three ways to a derivative must agree."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from phongfit.edge import checked
from phongfit.programs import compiler_options
from phongfit.vectors import Scalar


@checked
def check_gradients(
    function: Callable[[Any], Float[Array, "..."]],
    point: PyTree,
    *,
    order: int = 2,
    finite_differences: bool = True,
    rtol: float = 1e-5,
    atol: float = 1e-6,
) -> None:
    r"""Check that forward mode, reverse mode and finite differences agree.

    All of it is done in float64, whatever precision is set. First derivatives are those
    of a contraction $g(x) = w \cdot \text{function}(x)$ with fixed random weights $w$
    (1 for a function of one number), so that an image costs no more than a number, and
    errors in two pixels do not cancel. Second derivatives are forward over reverse,
    against central differences of the gradient.

    ```python
    check_gradients(lambda both: pf.render(*both), (scene, material))
    ```

    **Arguments:**

    - `function`: takes a pytree like `point`, returns an array; `jit`-able. Arrays that
        it closes over keep their precision: create them inside, or pass them in
        `point`.
    - `point`: any pytree. Its floats are differentiated, everything else (whole
        numbers, bools, strings, None) is held fixed.
    - `order`: 1 for gradients, 2 for second derivatives as well.
    - `finite_differences`: `False` at a kink, where there is nothing that they could
        converge to: then both modes must be finite and agree (to second order, forward
        over reverse and reverse over reverse).
    - `rtol`, `atol`: differences may be up to `atol` + `rtol` × the largest of the
        numbers compared. Finite differences have errors of about 1e-10 of `function`
        and 4e-11 of its third derivative (step 6e-6 × max(|x|, 1)).

    **Raises:** `AssertionError` that names the worst entry by its path, such as
    `.lights[0].position[2]`, with the numbers, or if the value is not finite;
    `ValueError` that names the argument if there is nothing to differentiate, or if
    arrays that `function` closes over keep it from float64.
    """
    if order not in (1, 2):
        raise ValueError(f"order: expected 1 or 2, got {order!r}")
    with jax.enable_x64(True):
        leaves, rebuild = _as_vector_space(point)
        start = np.concatenate([leaf.ravel() for _, leaf in leaves])

        _check_precision(function, rebuild, start)

        def contracted(vector: Float[Array, " n"]) -> Scalar:
            return _contract(function(rebuild(vector)))

        gradient = jax.grad(contracted)
        value, first = _derivatives(contracted, start, finite_differences)
        second = {}
        if order == 1:
            first["reverse"] = np.asarray(_compiled(gradient)(start))
        else:
            first["reverse"], second = _derivatives(gradient, start, finite_differences)
            if not finite_differences:
                second["reverse"] = np.asarray(_compiled(jax.jacrev(gradient))(start))
    if not np.isfinite(value):
        raise AssertionError(f"function: its value at the point is not finite: {value}")
    name = _namer(leaves)
    _compare("gradient", first, name, rtol, atol)
    if second:

        def pair(row: int, column: int) -> str:
            return f"{name(row)} and {name(column)}"

        _compare("second derivative", second, pair, rtol, atol)


def _check_precision(
    function: Callable[[Any], Array], rebuild: Callable[[Array], PyTree], start: Any
) -> None:
    """Check that a function can be traced in float64.

    **Arguments:** `rebuild`, `start`: from a vector to the function's argument, and the
    vector of the point.

    **Raises:** `ValueError` with the reason if it cannot: mostly arrays of single
    precision that the function closes over.
    """
    try:
        jax.eval_shape(lambda vector: function(rebuild(vector)), start)
    except (TypeError, ValueError) as error:
        if not all(name in str(error) for name in ("float32", "float64")):
            raise
        raise ValueError(
            "function: expected one that computes in float64, got float32 and float64 "
            "together: hand over the arrays and scenes that it closes over in point, "
            "or make them inside"
        ) from error


def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """`jax.jit` with options that shorten compilation: the programs run once."""
    return jax.jit(function, compiler_options=compiler_options())


Leaves = list[tuple[str, np.ndarray]]


def _as_vector_space(point: PyTree) -> tuple[Leaves, Callable[[Array], PyTree]]:
    """The floats of a pytree with their paths, and a function that sets them.

    The function takes all of them as one vector, and returns the pytree.
    """
    floats, rest = eqx.partition(point, eqx.is_inexact_array_like)
    with_paths, structure = jax.tree_util.tree_flatten_with_path(floats)
    if not with_paths:
        raise ValueError("point: expected something to differentiate, got no float")
    for path, leaf in with_paths:
        if np.iscomplexobj(leaf):
            raise ValueError(f"point: expected real numbers, got complex {_path(path)}")
    leaves = [(_path(path), np.asarray(leaf, np.float64)) for path, leaf in with_paths]
    ends = np.cumsum([leaf.size for _, leaf in leaves])[:-1]

    def rebuild(vector: Array) -> PyTree:
        parts = jnp.split(vector, ends)
        shaped = [
            p.reshape(leaf.shape) for p, (_, leaf) in zip(parts, leaves, strict=True)
        ]
        return eqx.combine(jax.tree.unflatten(structure, shaped), rest)

    return leaves, rebuild


def _path(path: tuple[Any, ...]) -> str:
    """A path in a pytree as text; "point" for a pytree that is a single array."""
    return jax.tree_util.keystr(path) or "point"


def _namer(leaves: Leaves) -> Callable[[int], str]:
    """A function from an entry's index to its name, such as `.diffuse[2]`."""

    def name(entry: int) -> str:
        for path, leaf in leaves:
            if entry < leaf.size:
                indices = np.unravel_index(entry, leaf.shape)
                return path + (f"[{', '.join(map(str, indices))}]" if indices else "")
            entry -= leaf.size
        raise IndexError(entry)

    return name


def _contract(output: Float[Array, "..."]) -> Scalar:
    """Sum of the entries with fixed random weights; of one entry, the entry itself."""
    if output.dtype != jnp.float64:
        raise ValueError(
            f"function: expected float64 for float64 input, got {output.dtype}, whose "
            "rounding would exceed the differences that are allowed"
        )
    if output.size == 1:
        return output.reshape(())
    weights = np.random.default_rng(0).standard_normal(output.shape)
    return jnp.sum(output * weights)


def _derivatives(
    function: Callable[[Array], Array], point: np.ndarray, finite_differences: bool
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """`function(point)`, and its derivative by each way of computing it.

    The derivatives are by name, `"forward"` and, if wanted, `"finite differences"`.
    The last axis of a derivative runs over the entries of `point`. Entries are
    differentiated one at a time, to save memory. Forward mode and finite differences
    call the same compiled function, since compilation is the slow part.
    """
    value_and_slope = _compiled(lambda x, tangent: jax.jvp(function, (x,), (tangent,)))
    # Balances the rounding error (~ε/step) and the truncation error (~step²).
    steps = np.cbrt(np.finfo(np.float64).eps) * np.maximum(np.abs(point), 1)
    forward, central = [], []
    for entry, step in enumerate(steps):
        unit = np.zeros_like(point)
        unit[entry] = 1
        forward.append(value_and_slope(point, unit)[1])
        if finite_differences:
            above, below = point + step * unit, point - step * unit
            rise = value_and_slope(above, unit)[0] - value_and_slope(below, unit)[0]
            # Divided by the actual step, which differs from `step` by rounding.
            central.append(rise / (above - below)[entry])
    methods = {"forward": forward}
    if finite_differences:
        methods["finite differences"] = central
    value = np.asarray(value_and_slope(point, np.zeros_like(point))[0])
    return value, {way: np.stack(slopes, axis=-1) for way, slopes in methods.items()}


def _compare(
    what: str,
    values: dict[str, np.ndarray],
    name: Callable[..., str],
    rtol: float,
    atol: float,
) -> None:
    """Raise an `AssertionError` that names the entry where methods differ the most.

    **Arguments:** `what`: the derivative, for the message; `values`: its value by each
    method; `name`: from an entry's indices to its name.
    """
    stacked = np.stack(list(values.values()))
    finite = np.isfinite(stacked).all(axis=0)
    stacked = np.where(finite, stacked, 0)
    allowed = atol + rtol * np.abs(stacked).max(axis=0)
    excess = np.where(finite, np.ptp(stacked, axis=0) - allowed, np.inf)
    wrong = excess > 0
    if not wrong.any():
        return
    worst = tuple(map(int, np.unravel_index(np.argmax(excess), excess.shape)))
    numbers = ", ".join(f"{way} {value[worst]:.9g}" for way, value in values.items())
    raise AssertionError(
        f"{what} at {name(*worst)}: {numbers}; allowed difference {allowed[worst]:.1g}"
        f" ({wrong.sum()} of {wrong.size} entries disagree)"
    )
