"""Surfaces given as a function (u, v) → p, cut into triangles."""

import functools
import inspect
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.checks import as_floats, finite, require
from phongfit.edge import checked
from phongfit.geometry.grids import grid_faces
from phongfit.geometry.meshes import Mesh
from phongfit.geometry.normals import parametric_normal
from phongfit.programs import program
from phongfit.vectors import Scalar, Vec3, norm

MAX_STEPS = 2**16
"""Largest number of steps along a parameter."""


@checked
def tessellate(
    function: Callable[[Scalar, Scalar], Vec3],
    u: Any = (0.0, 1.0),
    v: Any = (0.0, 1.0),
    *,
    columns: int = 32,
    rows: int = 32,
    two_sided: bool = False,
) -> Mesh:
    r"""A mesh whose vertices lie on a surface and carry its exact normals.

    Its front is where $\partial p / \partial u \times \partial p / \partial v$ points.

    **Arguments:**

    - `function`: (u, v) → p, world units; written in `jax.numpy`.
    - `u`, `v`: (first, last) value of each parameter.
    - `columns`, `rows`: steps in u and in v, 1 to 65 536; each cell is two triangles.
    - `two_sided`: as in [`Mesh`][].

    **Raises:** `ValueError` that names the argument.
    """
    ends = _as_range("u", u), _as_range("v", v)
    _check_steps("columns", columns)
    _check_steps("rows", rows)
    _check_takes_two(function)
    point = jax.eval_shape(
        function, *(jax.ShapeDtypeStruct((), end.dtype) for end in ends)
    )
    shape = getattr(point, "shape", None)
    if shape != (3,):
        raise ValueError(f"function: expected points of shape (3,), got {shape}")
    if all(eqx.is_array(leaf) for leaf in jax.tree.leaves(function)):
        # A module of arrays: one program for each class of function and size of grid.
        vertices, normals = _cached_grid(function, *ends, columns, rows)
    else:
        # The function may read variables that change between calls: it is not cached.
        grid = jax.jit(functools.partial(_grid, function), static_argnums=(2, 3))
        vertices, normals = grid(*ends, columns, rows)
    return Mesh(vertices, _cell_faces(columns, rows), normals, two_sided=two_sided)


def _grid(
    function: Callable[[Scalar, Scalar], Vec3],
    u: Float[Array, "2"],
    v: Float[Array, "2"],
    columns: int,
    rows: int,
) -> tuple[Float[Array, "vertices 3"], Float[Array, "vertices 3"]]:
    """Points of the surface, and unit normals there.

    **Arguments:** `u`, `v`: (first, last) value; `columns`, `rows`: numbers of steps.

    **Returns:** (rows + 1) · (columns + 1) vertices, row by row, with u along a row.
    """
    us = jnp.linspace(u[0], u[1], columns + 1)
    vs = jnp.linspace(v[0], v[1], rows + 1)
    middle = (us[0] + us[-1]) / 2, (vs[0] + vs[-1]) / 2

    def point_and_normal(u: Scalar, v: Scalar) -> tuple[Vec3, Vec3]:
        # At a pole a derivative vanishes, or both are parallel: rounding would decide
        # where the normal points. The normal of a point a little nearer to the middle
        # of the domain is used instead.
        tolerance = step = np.sqrt(np.finfo(u.dtype).eps)
        along_u, along_v = jax.jacfwd(function, argnums=(0, 1))(u, v)
        area = norm(jnp.cross(along_u, along_v))
        longer = jnp.maximum(norm(along_u), norm(along_v))
        inward = jnp.where(area <= tolerance * longer**2, step, 0)
        inner_u, inner_v = u + inward * (middle[0] - u), v + inward * (middle[1] - v)
        return function(u, v), parametric_normal(function, inner_u, inner_v)

    grid = jax.vmap(jax.vmap(point_and_normal, in_axes=(0, None)), in_axes=(None, 0))
    points, normals = grid(us, vs)
    return points.reshape(-1, 3), normals.reshape(-1, 3)


_cached_grid = program("columns", "rows")(_grid)


def _check_takes_two(function: Callable[..., Any]) -> None:
    """Raise a `ValueError` for a function that cannot be called with u and v."""
    try:
        signature = inspect.signature(function)
    except ValueError:
        # Some functions written in C have no signature.
        return
    try:
        signature.bind(None, None)
    except TypeError as error:
        raise ValueError(
            f"function: expected a function of u and v, got {function!r}: {error}"
        ) from None


def _as_range(name: str, ends: Any) -> Float[Array, "2"]:
    """First and last value of a parameter; `ValueError` names `name`."""
    ends = as_floats(name, ends)
    if ends.shape != (2,):
        raise ValueError(f"{name}: expected shape (first, last), got {ends.shape}")
    return require(name, ends, finite, "finite numbers")


def _check_steps(name: str, count: int) -> None:
    """Raise a `ValueError` that names `name` for a number of steps out of range."""
    if not 1 <= count <= MAX_STEPS:
        raise ValueError(
            f"{name}: expected a whole number from 1 to {MAX_STEPS}, got {count!r}"
        )


def _cell_faces(columns: int, rows: int) -> np.ndarray:
    """Two triangles for each cell of a grid of vertices, counted row by row.

    `grid_faces` has y down; here v is up, so the faces run the other way round.
    """
    # Each triangle with its second and third corner exchanged.
    lower, upper = np.split(grid_faces(rows + 1, columns + 1)[:, [0, 2, 1]], 2)
    return np.concatenate([upper, lower])
