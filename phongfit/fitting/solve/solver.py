"""Bounded Levenberg-Marquardt, as a solver for optimistix.

    solver = BoundedLevenbergMarquardt(rtol=1e-8, atol=1e-8, lower=l, upper=u)
    optx.least_squares(residuals, solver, y0)

optimistix has no bounds for least squares, and ignores those in `options` silently.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree, Scalar, ScalarLike

from phongfit.fitting.solve.box import least_squares_in_box
from phongfit.moved import warn_deprecated


class _State(eqx.Module):
    """The last accepted point, and a factor of the Jacobian there."""

    y: PyTree[Array]
    triangle: Float[Array, "rows columns"]
    scale: Float[Array, " n"]


class BoxDampedNewtonDescent(optx.AbstractDescent):
    r"""The best damped Gauss-Newton step that stays in a box.

    Minimises $\|J p + r\|^2 + \lambda \|D p\|^2$ over all $p$ with
    $l \le y + p \le u$, where $D$ holds the largest norms that the columns of $J$ have
    had so far, and $\lambda$ is `damping` over the step size. A parameter may end
    exactly on its bound and may leave it again. It works on a QR factor of $J$: $J^\top
    J$ would square the condition number, which is too much in float32.

    **Fields:**

    - `lower`, `upper`: bounds, with the structure of the unknowns; may be infinite.
    - `damping`: $\lambda$ at the first step.

    ??? cite "Source"
        Moré, *The Levenberg-Marquardt algorithm: implementation and theory*, Numerical
        Analysis, Lecture Notes in Mathematics 630, 1978: norms that never shrink keep
        the region of trust where the residuals turn flat.
    """

    lower: PyTree[Array]
    upper: PyTree[Array]
    damping: float = 1e-3

    def init(self, y: PyTree[Array], f_info_struct: Any) -> _State:
        flat, _ = ravel_pytree(y)
        rows = sum(leaf.size for leaf in jax.tree.leaves(f_info_struct.residual))
        shape = (min(rows, flat.size + 1), flat.size + 1)
        return _State(y, jnp.zeros(shape, flat.dtype), jnp.zeros_like(flat))

    def query(self, y: PyTree[Array], f_info: Any, state: _State) -> _State:
        residual, _ = ravel_pytree(f_info.residual)
        both = jnp.column_stack([f_info.jac.as_matrix(), residual])
        triangle = jnp.linalg.qr(both, mode="r")
        norms = jnp.linalg.norm(triangle[:, :-1], axis=0)
        return _State(y, triangle, jnp.maximum(state.scale, norms))

    def step(
        self, step_size: Scalar, state: _State
    ) -> tuple[PyTree[Array], optx.RESULTS]:
        from_flat = ravel_pytree(state.y)[1]
        y, lower, upper = (
            ravel_pytree(tree)[0] for tree in (state.y, self.lower, self.upper)
        )
        jacobian, residual = state.triangle[:, :-1], state.triangle[:, -1]
        # A parameter without influence here still needs a positive curvature.
        scale = jnp.where(state.scale > 0, state.scale, 1)
        # A GPU would otherwise multiply in reduced precision.
        with jax.default_matmul_precision("highest"):
            held = _unfelt(jacobian, residual, upper - lower)
            step = least_squares_in_box(
                jacobian,
                residual,
                jnp.sqrt(self.damping / step_size) * scale,
                jnp.where(held, 0, lower - y),
                jnp.where(held, 0, upper - y),
            )
            meets = (step == lower - y) | (step == upper - y)
            idle = _is_rounding(jacobian, residual, y, step) & ~meets
        step = jnp.where(idle, 0, step)
        return from_flat(_landing(y, step, lower, upper)), optx.RESULTS.successful


def _unfelt(
    jacobian: Float[Array, "k n"],
    residual: Float[Array, " k"],
    width: Float[Array, " n"],
) -> Bool[Array, " n"]:
    """Parameters with negligible influence on residuals and cost.

    They are held fixed, since their steps are arbitrary and would not converge.
    """
    resolution = jnp.finfo(width.dtype).eps
    curvature = jnp.sum(jacobian**2, axis=0)
    faint = curvature <= resolution * jnp.max(curvature)
    slope = jnp.abs(jacobian.T @ residual)
    parabola = slope * (slope / jnp.where(curvature > 0, 2 * curvature, jnp.inf))
    gain = jnp.minimum(parabola, slope * width)
    return faint & (gain <= resolution * jnp.sum(residual**2) / 2)


def _is_rounding(
    jacobian: Float[Array, "k n"],
    residual: Float[Array, " k"],
    y: Float[Array, " n"],
    step: Float[Array, " n"],
) -> Bool[Array, ""]:
    """Whether a step changes the residuals by no more than the rounding of y does.

    Such steps are noise, and would never end if columns are parallel.
    """
    norms = jnp.linalg.norm(jacobian, axis=0)
    rounding = jnp.sum(jnp.abs(y) * norms) + jnp.linalg.norm(residual)
    change = jnp.linalg.norm(jacobian @ step)
    return change <= jnp.finfo(y.dtype).eps * rounding


def _landing(
    y: Float[Array, " n"],
    step: Float[Array, " n"],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
) -> Float[Array, " n"]:
    """`step`, changed so that y + step rounds to the bound at which it should end.

    Or to a point just inside: a step from a large y may not be able to reach a bound
    near 0 exactly.
    """
    there = jnp.clip(y + step, lower, upper)
    there = jnp.where(step == lower - y, lower, there)
    there = jnp.where(step == upper - y, upper, there)
    step = step + (there - (y + step))
    step = jnp.where(y + step < lower, jnp.nextafter(step, jnp.inf), step)
    return jnp.where(y + step > upper, jnp.nextafter(step, -jnp.inf), step)


class RoundingTolerantTrustRegion(optx.AbstractSearch):
    r"""Accepts steps that lower the cost, even by less than its rounding.

    Near the solution the true and the predicted decrease are both below the rounding of
    the cost. A search that compares them rejects every step there and never ends; one
    that accepts every step does not converge if $J^\top J$ is far from the curvature.
    There the decrease is computed from the slopes at both ends instead,
    $-\tfrac12 (r_0 \cdot J_0 p + r_1 \cdot J_1 p)$, whose rounding shrinks with the
    step.

    **Fields:**

    - `good`, `poor`: fractions of the predicted decrease above which the step size
        grows, and below which it shrinks.
    - `grow`, `shrink`: factors on the step size; it shrinks too where a step is
        rejected.

    ??? cite "Source"
        Hager and Zhang, *A new conjugate gradient method with guaranteed descent and an
        efficient line search*, SIAM J. Optim. 16(1), 2005: the approximate Wolfe
        conditions.
    """

    good: float = 0.75
    poor: float = 0.25
    grow: float = 4.0
    shrink: float = 0.25

    def init(self, y: PyTree[Array], f_info_struct: Any) -> Scalar:
        del f_info_struct
        dtype = jnp.result_type(*jax.tree.leaves(y))
        return jnp.ones((), dtype)

    def step(
        self,
        first_step: Bool[Array, ""],
        y: PyTree[Array],
        y_eval: PyTree[Array],
        f_info: Any,
        f_eval_info: Any,
        state: Scalar,
    ) -> tuple[Scalar, Bool[Array, ""], optx.RESULTS, Scalar]:
        difference = jax.tree.map(jnp.subtract, y_eval, y)
        before, after = f_info.as_min(), f_eval_info.as_min()
        slope, change = _slope(f_info, difference)
        predicted = -slope - change**2 / 2
        decrease = before - after
        resolution = jnp.finfo(before.dtype).eps
        unclear = jnp.abs(decrease) <= 8 * resolution * before
        by_slopes = -(slope + _slope(f_eval_info, difference)[0]) / 2
        decrease = jnp.where(unclear, by_slopes, decrease)
        # Rounding error of the slopes, within which a decrease cannot be judged.
        rounding = 2 * resolution * jnp.sqrt(2 * before) * change
        accept = first_step | (decrease >= -rounding)
        alike = (jnp.abs(decrease) <= rounding) & (predicted <= rounding)
        factor = jnp.where(decrease >= self.good * predicted, self.grow, 1)
        factor = jnp.where(decrease < self.poor * predicted, self.shrink, factor)
        factor = jnp.where(alike | first_step, 1, factor)
        factor = jnp.where(accept, factor, self.shrink)
        step_size = factor * state
        return step_size, accept, optx.RESULTS.successful, step_size


def _slope(f_info: Any, difference: PyTree[Array]) -> tuple[Scalar, Scalar]:
    """Slope of the cost along a step, and the linear change of the residuals by it."""
    change, _ = ravel_pytree(f_info.jac.mv(difference))
    residual, _ = ravel_pytree(f_info.residual)
    return jnp.sum(residual * change), jnp.linalg.norm(change)


class BoundedLevenbergMarquardt(optx.AbstractGaussNewton):
    r"""Levenberg-Marquardt for least squares in a box: a descent and a search.

    Minimises $\tfrac12 \|r(y)\|^2$ over all $y$ with $l \le y \le u$, for some tens of
    unknowns and any number of residuals. The bounds hold exactly at every point that is
    evaluated, and may be active at the solution. A step costs a Jacobian and a QR
    factorisation of it; a rejected step costs the derivative along one direction.

    It ends with `optx.RESULTS.successful` where a step moves unknowns and residuals by
    less than the tolerances, or by less than their rounding: with tolerances that are
    too tight it ends at the best possible point, also in float32. Otherwise it ends at
    `max_steps`. Steps to NaN or infinite residuals are rejected.

    Units of the unknowns do not matter, and zero or parallel columns are allowed. It
    works under `jit` and `vmap`; under `vmap` all problems take as long as the slowest.
    On a dozen problems of Moré, Garbow and Hillstrom, free and in boxes, it ends no
    higher than SciPy's `least_squares`.

    !!! example
        ```python
        def rosenbrock(y, args):
            return jnp.stack([10 * (y[1] - y[0] ** 2), 1 - y[0]])

        lower, upper = jnp.array([-5.0, -5.0]), jnp.array([0.5, 5.0])
        solver = BoundedLevenbergMarquardt(1e-6, 1e-6, lower, upper)
        solution = optx.least_squares(rosenbrock, solver, jnp.array([-1.2, 1.0]))
        solution.value  # [0.5, 0.25]
        ```

    ??? cite "Source"
        Kanzow, Yamashita and Fukushima, *Levenberg-Marquardt methods with strong local
        convergence properties for solving nonlinear equations with convex constraints*,
        J. Comput. Appl. Math. 172, 2004; scaling and search as in
        [`BoxDampedNewtonDescent`][] and [`RoundingTolerantTrustRegion`][].
    """

    rtol: Any
    atol: Any
    norm: Callable[[PyTree], Scalar]
    descent: Any
    search: Any
    verbose: Callable[..., None]

    def __init__(
        self,
        rtol: ScalarLike,
        atol: ScalarLike,
        lower: PyTree[Array],
        upper: PyTree[Array],
        norm: Callable[[PyTree], Scalar] = optx.max_norm,
        damping: float = 1e-3,
        foresee: bool | None = None,
        pace: Float[Array, "2"] | None = None,
    ):
        """**Arguments:**

        - `rtol`, `atol`: relative and absolute tolerance on the change of unknowns and
            residuals, at which an accepted step is the last.
        - `lower`, `upper`: bounds, of the structure of the unknowns; may be infinite.
            The starting point must lie between them.
        - `norm`: norm of these changes.
        - `damping`: fraction of the curvature that is added at first.
        - `foresee`, `pace`: have no effect; they go with version 0.4.
        """
        for name, given in (("foresee", foresee), ("pace", pace)):
            if given is not None:
                warn_deprecated(f"{name}: it has no effect, and goes in version 0.4")
        self.rtol = rtol
        self.atol = atol
        self.norm = norm
        self.descent = BoxDampedNewtonDescent(lower, upper, damping)
        self.search = RoundingTolerantTrustRegion()
        self.verbose = _silent


def _silent(**report: Any) -> None:
    del report
