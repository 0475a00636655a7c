"""Bounded Levenberg-Marquardt, as an optimistix solver that stands on its own.

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

from phongfit.fitting.box import minimize_in_box


class _State(eqx.Module):
    """What a step needs of the last accepted point."""

    y: PyTree[Array]
    hessian: Float[Array, "n n"]
    gradient: Float[Array, " n"]
    cost: Scalar


class BoxDampedNewtonDescent(optx.AbstractDescent):
    r"""The best damped Gauss-Newton step that stays in a box.

    Minimises $g \cdot p + \tfrac12 p^\top (J^\top J + \lambda D) p$ over all $p$ with
    $l \le y + p \le u$, where $D$ is the diagonal of $J^\top J$ and $\lambda$ is
    `damping` over the step size. A parameter may end exactly on its bound and may leave
    it again.
    """

    lower: PyTree[Array]
    upper: PyTree[Array]
    damping: float = 1e-3

    def init(self, y: PyTree[Array], f_info_struct: Any) -> _State:
        del f_info_struct
        flat, _ = ravel_pytree(y)
        cost = jnp.zeros((), flat.dtype)
        return _State(y, jnp.zeros((flat.size, flat.size), flat.dtype), flat, cost)

    def query(self, y: PyTree[Array], f_info: Any, state: _State) -> _State:
        del state
        jacobian = f_info.jac.as_matrix()
        residual, _ = ravel_pytree(f_info.residual)
        # A GPU would otherwise multiply in reduced precision.
        exact = jax.lax.Precision.HIGHEST
        hessian = jnp.matmul(jacobian.T, jacobian, precision=exact)
        gradient = jnp.matmul(jacobian.T, residual, precision=exact)
        return _State(y, hessian, gradient, jnp.sum(residual**2) / 2)

    def step(
        self, step_size: Scalar, state: _State
    ) -> tuple[PyTree[Array], optx.RESULTS]:
        from_flat = ravel_pytree(state.y)[1]
        y, lower, upper = (
            ravel_pytree(tree)[0] for tree in (state.y, self.lower, self.upper)
        )
        diagonal = jnp.diag(state.hessian)
        still = _unfelt(diagonal, state, upper - lower)
        # What does nothing at all here still needs a positive curvature.
        diagonal = jnp.where(diagonal > 0, diagonal, 1)
        damped = jnp.fill_diagonal(
            state.hessian, (1 + self.damping / step_size) * diagonal, inplace=False
        )
        step = minimize_in_box(
            damped,
            state.gradient,
            jnp.where(still, 0, lower - y),
            jnp.where(still, 0, upper - y),
        )
        return from_flat(_landing(y, step, lower, upper)), optx.RESULTS.successful


def _unfelt(
    diagonal: Float[Array, " n"], state: _State, width: Float[Array, " n"]
) -> Bool[Array, " n"]:
    """Parameters that the residuals hardly feel, and that the cost would not feel.

    They rest: their steps are arbitrary, and without an end in sight.
    """
    resolution = jnp.finfo(diagonal.dtype).eps
    faint = diagonal <= resolution * jnp.max(diagonal)
    slope = jnp.abs(state.gradient)
    parabola = slope * (slope / jnp.where(diagonal > 0, 2 * diagonal, jnp.inf))
    gain = jnp.minimum(parabola, slope * width)
    return faint & (gain <= resolution * state.cost)


def _landing(
    y: Float[Array, " n"],
    step: Float[Array, " n"],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
) -> Float[Array, " n"]:
    """`step`, such that y + step rounds to the bound where it was meant to meet it."""
    there = jnp.clip(y + step, lower, upper)
    there = jnp.where(step == lower - y, lower, there)
    there = jnp.where(step == upper - y, upper, there)
    return step + (there - (y + step))


BoxDampedNewtonDescent.__init__.__doc__ = r"""**Arguments:**

- `lower`, `upper`: of the structure of the unknowns; may be infinite.
- `damping`: $\lambda$ at the first step.
"""


class _SearchState(eqx.Module):
    step_size: Scalar


class RoundingTolerantTrustRegion(optx.AbstractSearch):
    """Accepts what does not raise the cost by more than rounding.

    Near the solution the true and the predicted decrease are both below the rounding of
    the cost. A search that compares them rejects every step there, and never ends; this
    one goes on, and lets the solver's own test of convergence decide.
    """

    good: float = 0.75
    poor: float = 0.25
    grow: float = 4.0
    shrink: float = 0.25

    def init(self, y: PyTree[Array], f_info_struct: Any) -> _SearchState:
        del f_info_struct
        dtype = jnp.result_type(*jax.tree.leaves(y))
        return _SearchState(jnp.ones((), dtype))

    def step(
        self,
        first_step: Bool[Array, ""],
        y: PyTree[Array],
        y_eval: PyTree[Array],
        f_info: Any,
        f_eval_info: Any,
        state: _SearchState,
    ) -> tuple[Scalar, Bool[Array, ""], optx.RESULTS, _SearchState]:
        difference = jax.tree.map(jnp.subtract, y_eval, y)
        before, after = f_info.as_min(), f_eval_info.as_min()
        predicted = before - _sum_squares(f_info, difference) / 2
        decrease = before - after
        rounding = 8 * jnp.finfo(before.dtype).eps * before
        accept = first_step | (decrease >= -rounding)
        alike = (jnp.abs(decrease) <= rounding) & (predicted <= rounding)
        factor = jnp.where(decrease >= self.good * predicted, self.grow, 1)
        factor = jnp.where(decrease < self.poor * predicted, self.shrink, factor)
        factor = jnp.where(alike | first_step, 1, factor)
        factor = jnp.where(accept, factor, self.shrink)
        step_size = factor * state.step_size
        return step_size, accept, optx.RESULTS.successful, _SearchState(step_size)


def _sum_squares(f_info: Any, difference: PyTree[Array]) -> Scalar:
    """Squares of the residuals that the linear model predicts after a step."""
    change = f_info.jac.mv(difference)
    predicted, _ = ravel_pytree(jax.tree.map(jnp.add, f_info.residual, change))
    return jnp.sum(predicted**2)


RoundingTolerantTrustRegion.__init__.__doc__ = """**Arguments:**

- `good`, `poor`: shares of the predicted decrease from which on the step size grows,
    and below which it shrinks.
- `grow`, `shrink`: factors on the step size; it shrinks too where a step is rejected.
"""


class BoundedLevenbergMarquardt(optx.AbstractGaussNewton):
    """Levenberg-Marquardt for least squares in a box: a descent and a search.

    The bounds hold exactly at every point that is evaluated, and may bind at the
    solution. In float32 it does not stall where the decrease of the cost falls below
    its rounding: see [`RoundingTolerantTrustRegion`][].

    ??? cite "Source"
        Kanzow, Yamashita and Fukushima, *Levenberg-Marquardt methods with strong local
        convergence properties for solving nonlinear equations with convex constraints*,
        J. Comput. Appl. Math. 172, 2004.
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
    ):
        """**Arguments:**

        - `rtol`, `atol`: relative and absolute tolerance on the change of unknowns and
            residuals, at which an accepted step is the last.
        - `lower`, `upper`: bounds, of the structure of the unknowns; may be infinite.
            The starting point must lie between them.
        - `norm`: of these changes.
        - `damping`: share of the curvature that is added at first.
        """
        self.rtol = rtol
        self.atol = atol
        self.norm = norm
        self.descent = BoxDampedNewtonDescent(lower, upper, damping)
        self.search = RoundingTolerantTrustRegion()
        self.verbose = _silent


def _silent(**report: Any) -> None:
    del report
