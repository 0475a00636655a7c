"""Convergence of a fit: the cost at each step of the solver, computed again."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.fitting.problem.problem import Problem
from phongfit.fitting.solve.search import SearchResult
from phongfit.fitting.solve.solution import few_residuals, make_solver
from phongfit.fitting.solve.start import scan
from phongfit.fitting.uncertainty.profile import total_cost
from phongfit.programs import program

MOST_STEPS = 60


@dataclasses.dataclass(frozen=True)
class Convergence:
    """Costs at each step of the solver, from the scan's start to its end.

    **Arguments:**

    - `costs`: χ² at the start and after each step; a rejected step repeats its cost.
    - `least`: χ² of the fit. With unknowns of the scene a fit has several starts, and
        this single run may end higher.
    """

    costs: np.ndarray
    least: float


def trace_convergence(found: SearchResult) -> Convergence:
    """The cost step by step, on all samples, with the noise level of the fit.

    The search of a fit has several stages and starts, and keeps no record, which would
    make it slower. This is a single run from one start.
    """
    start = scan(found.problem, found.problem.unknowns.start)
    points, count = _walk(found.problem, start)
    costs = [total_cost(found.problem, y) for y in points[: int(count)]]
    return Convergence(np.array(costs), total_cost(found.problem, found.y))


@program()
def _walk(
    problem: Problem, start: Float[Array, " n"]
) -> tuple[Float[Array, "steps n"], Array]:
    """Points of the solver from its start on, and the number of them.

    The solver's first step evaluates the start.
    """
    solver = make_solver(problem, start.dtype)
    tags = frozenset[object]()
    shape, left = jax.eval_shape(few_residuals, start, problem)
    first = solver.init(few_residuals, start, problem, {}, shape, left, tags)
    arrays, static = eqx.partition(first, eqx.is_array)

    def unfinished(carry: Any) -> Array:
        _, arrays, _, count = carry
        return (count < MOST_STEPS) & ~eqx.combine(arrays, static).terminate

    def step(carry: Any) -> Any:
        y, arrays, points, count = carry
        state = eqx.combine(arrays, static)
        y, state, _ = solver.step(few_residuals, y, problem, {}, state, tags)
        return y, eqx.filter(state, eqx.is_array), points.at[count].set(y), count + 1

    points = jnp.zeros((MOST_STEPS, start.size), start.dtype)
    carry = (start, arrays, points, jnp.zeros((), int))
    return jax.lax.while_loop(unfinished, step, carry)[2:]
