"""Solution of a problem by a least-squares solver, with sums over the samples."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

from phongfit.fitting.problem.problem import Problem
from phongfit.fitting.solve.solver import BoundedLevenbergMarquardt
from phongfit.fitting.solve.sums import (
    ResidualSums,
    add_up,
    in_double,
    linearized,
    sums,
)
from phongfit.programs import program

# Most Newton steps of [`polish`][]; mostly one is enough.
POLISHED = 4


@eqx.filter_custom_jvp
def few_residuals(
    y: Float[Array, " n"], problem: Problem
) -> tuple[Float[Array, " n+1"], ResidualSums]:
    r"""n + 1 residuals that are equivalent to all residuals for a Gauss-Newton method.

    With the symmetric root $R = (J^\top J)^{1/2}$ they are $R^{-1} J^\top r$ and the
    rest of the length of $r$; their Jacobian is $R$ and a row of zeros. So sum of
    squares, gradient and $J^\top J$ are those of the problem, and a solver needs n + 1
    numbers instead of a million.

    **Returns:** the residuals, and sums for the noise level: optimistix's `aux`.
    """
    residuals, _, residual_sums = _residuals_and_root(y, problem)
    return residuals, residual_sums


@few_residuals.def_jvp
def _derivative(
    at: tuple[Array, Problem], towards: tuple[Array | None, Any]
) -> tuple[tuple[Array, ResidualSums], tuple[Array, ResidualSums]]:
    residuals, root, residual_sums = _residuals_and_root(*at)
    tangent, others = towards
    if any(leaf is not None for leaf in jax.tree.leaves(others)):
        raise NotImplementedError("few_residuals: a derivative in the unknowns only")
    moved = jnp.zeros_like(at[0]) if tangent is None else root @ tangent
    moved = jnp.append(moved, jnp.zeros((), moved.dtype))
    return (residuals, residual_sums), (
        moved,
        jax.tree.map(jnp.zeros_like, residual_sums),
    )


# A separate program, since optimistix calls it three times, and it is traced once.
@program()
def _residuals_and_root(
    y: Float[Array, " n"], problem: Problem
) -> tuple[Float[Array, " n+1"], Float[Array, "n n"], ResidualSums]:
    total = sums(problem, y)
    tiny = jnp.finfo(y.dtype).tiny
    scale = jnp.sqrt(jnp.diag(total.hessian))
    scale = jnp.where(scale > 0, scale, 1)
    values, vectors = jnp.linalg.eigh(total.hessian / jnp.outer(scale, scale))
    # Rounding can make the eigenvalue of an undetermined direction negative.
    root = jnp.sqrt(jnp.maximum(values, 0))
    small = jnp.finfo(root.dtype).eps * jnp.max(root)
    inverse = jnp.where(root > small, 1 / jnp.where(root > small, root, 1), 0)
    head = vectors @ (inverse * (vectors.T @ (total.gradient / scale)))
    jacobian = (vectors * root[None]) @ vectors.T * scale[None]
    # The curvature is raised where the cost would otherwise become negative.
    length = jnp.sum(head**2)
    steeper = jnp.sqrt(jnp.maximum(length / jnp.maximum(total.cost, tiny), 1))
    tail = jnp.sqrt(jnp.maximum(total.cost - length / steeper**2, 0))
    unit = _unit(problem)
    residuals = jnp.append(head / steeper, tail) / unit
    return residuals, jacobian * steeper / unit, total.residual_sums


def polish(problem: Problem, y: Float[Array, " n"]) -> Float[Array, " n"]:
    """`y` after Newton steps from sums in double precision.

    Beside many samples, sums in single precision lose a prior that alone tells apart
    two unknowns, such as the strength of a light and a reflectance.
    """
    if not any(problem.unknowns.has_prior) or y.dtype == np.float64:
        return y
    lower, upper = (
        np.asarray(problem.unknowns.lower),
        np.asarray(problem.unknowns.upper),
    )
    here = in_double(add_up, problem, linearized(problem, y))
    for _ in range(POLISHED):
        at = np.asarray(y)
        free = (lower < at) & (at < upper)
        hessian, gradient = (np.asarray(part) for part in (here.hessian, here.gradient))
        step = np.zeros(len(at))
        step[free] = -_inverse(hessian[np.ix_(free, free)]) @ gradient[free]
        there = jnp.asarray(np.clip(at + step, lower, upper), y.dtype)
        sums = in_double(add_up, problem, linearized(problem, there))
        if not float(sums.cost) < float(here.cost):
            break
        y, here = there, sums
    return y


def _inverse(hessian: np.ndarray) -> np.ndarray:
    scale = np.sqrt(np.diag(hessian))
    scale = np.outer(*[np.where(scale > 0, scale, 1)] * 2)
    return np.linalg.pinv(hessian / scale, 1e-12, hermitian=True) / scale


def _unit(problem: Problem) -> Float[Array, ""]:
    """Unit of the residuals, so that one tolerance serves all problems.

    It makes the cost a mean over the samples, since the rounding of a sum grows with
    their number, and is not below the rounding of a prediction.
    """
    dtype, step = problem.sigma.dtype, problem.samples.step
    used = jnp.sum(problem.samples.weight > 0)
    count = jnp.maximum(used, 1).astype(dtype)
    deviation = problem.sigma
    if step is not None:
        # Without noise the rounding of the image is still coarser than a prediction's.
        deviation = jnp.sqrt(deviation**2 + jnp.mean(step**2) / 12)
    coarse = 8 * float(jnp.finfo(dtype).eps) / deviation / _tolerance(dtype)
    return jnp.sqrt(count) * jnp.maximum(coarse, 1)


def _tolerance(dtype: Any) -> float:
    return max(float(jnp.finfo(dtype).eps) ** 0.7, 1e-8)


def make_solver(
    problem: Problem,
    dtype: Any,
    coarse: Float[Array, ""] | float = 0.0,
) -> BoundedLevenbergMarquardt:
    """The solver for a problem's box, by default as exact as the number type allows.

    **Arguments:** `coarse`: a larger tolerance that is enough.
    """
    exact = _tolerance(dtype) if problem.tolerance is None else problem.tolerance
    tolerance = jnp.maximum(coarse, exact)
    return BoundedLevenbergMarquardt(
        rtol=tolerance,
        atol=tolerance,
        lower=problem.unknowns.lower,
        upper=problem.unknowns.upper,
    )


class Solution(eqx.Module):
    """Point where the solver stopped, whether it converged, and sums of residuals."""

    y: Float[Array, " n"]
    cost: Float[Array, ""]
    residual_sums: ResidualSums
    steps: Int[Array, ""]
    converged: Array


@program("max_steps")
def solve(
    problem: Problem,
    start: Float[Array, " n"],
    max_steps: int,
    coarse: Float[Array, ""] | float = 0.0,
) -> Solution:
    """Bounded Levenberg-Marquardt from `start`; failure is data, not an exception.

    **Arguments:** `coarse`: see [`make_solver`][].
    """
    solver = make_solver(problem, start.dtype, coarse)
    solution = optx.least_squares(
        few_residuals,
        solver,
        start,
        args=problem,
        has_aux=True,
        max_steps=max_steps,
        throw=False,
    )
    done, state = solution.result == optx.RESULTS.successful, solution.state
    cost = 2 * _unit(problem) ** 2 * state.f_info.as_min()
    steps, converged = solution.stats["num_steps"], done & jnp.isfinite(cost)
    return Solution(solution.value, cost, solution.aux, steps, converged)
