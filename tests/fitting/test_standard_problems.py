"""Bounded Levenberg-Marquardt on the standard problems, next to SciPy."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import scipy.optimize

from phongfit.fitting.solve.solver import BoundedLevenbergMarquardt
from tests.fitting.standard_problems import PROBLEMS, Problem
from tests.helpers import eps, floats

# All of two unknowns, and thus one program. None has data in a module's array, which
# JAX would keep in the precision that it was used in first.
FEW = ("1", "2", "5")


class Answer(NamedTuple):
    """Where the solver ended, and every point that it asked for on its way."""

    point: np.ndarray
    residual: np.ndarray
    successful: bool
    asked: np.ndarray


def _of_size(n: int) -> tuple:
    """The functions of n unknowns, one after the other."""
    found = [p.residual for p in PROBLEMS if len(p.start) == n]
    return tuple(dict.fromkeys(found))


# Little is computed: what takes the time is to compile.
QUICKLY = {
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
}


_asked: list[tuple[np.ndarray, np.ndarray]] = []


def _watch(point, residual):
    _asked.append((np.array(point), np.array(residual)))


def _tolerance() -> float:
    """SciPy's own in float64, some hundred roundings in float32."""
    return 1e-12 if eps() < 1e-10 else 1e-5


@functools.partial(jax.jit, compiler_options=QUICKLY)
def _run(which, start, lower, upper):
    """One program for all functions of as many unknowns."""
    functions = _of_size(start.size)
    rows = max(jax.eval_shape(f, start).size for f in functions)

    def padded(function, y):
        residual = function(y)
        return jnp.pad(residual, (0, rows - residual.size))

    def residual(y, args):
        del args
        branches = [functools.partial(padded, f) for f in functions]
        found = jax.lax.switch(which, branches, y)
        jax.debug.callback(_watch, y, found)
        return found

    solver = BoundedLevenbergMarquardt(_tolerance(), _tolerance(), lower, upper)
    solution = optx.least_squares(residual, solver, start, max_steps=500, throw=False)
    return solution.value, solution.result == optx.RESULTS.successful


@functools.cache
def _ours(problem: Problem, tolerance: float) -> Answer:
    """In the precision that has this tolerance, the one that is set."""
    _asked.clear()
    which = jnp.array(_of_size(len(problem.start)).index(problem.residual))
    box = floats(problem.box())
    point, successful = _run(which, floats(problem.start), *box)
    jax.effects_barrier()
    asked, residuals = map(np.array, zip(*_asked, strict=True))
    (last, *_) = np.flatnonzero(np.all(asked == np.asarray(point), axis=1))
    return Answer(np.asarray(point), residuals[last], bool(successful), asked)


def _cost(problem: Problem, point: np.ndarray) -> float:
    """Sum of squares, by NumPy in double precision."""
    return float(np.sum(problem.residual(point.astype(float), np) ** 2))


def _jacobian(problem: Problem, point: np.ndarray) -> np.ndarray:
    """By complex steps: no rounding but its own."""
    steps = 1e-30j * np.eye(point.size)
    columns = [problem.residual(point + step, np).imag / 1e-30 for step in steps]
    return np.stack(columns, axis=1)


@functools.cache
def _scipy(problem: Problem) -> float:
    """SciPy's sum of squares."""
    settings: dict[str, Any] = dict(
        jac=lambda x: _jacobian(problem, x), bounds=tuple(problem.box()), method="trf"
    )
    result = scipy.optimize.least_squares(
        lambda x: problem.residual(x, np),
        np.array(problem.start, float),
        xtol=1e-12,
        ftol=1e-12,
        gtol=1e-12,
        max_nfev=5000,
        **settings,
    )
    return 2 * float(result.cost)


def _unavoidable(problem: Problem, ours: Answer) -> float:
    """How long a residual the rounding of the unknowns and of itself can leave."""
    x = ours.point.astype(float)
    residual = problem.residual(x, np)
    of_unknowns = eps() * (np.abs(_jacobian(problem, x)) @ np.abs(x) + np.abs(residual))
    of_residual = ours.residual[: residual.size].astype(float) - residual
    return float(np.linalg.norm(of_unknowns) + np.linalg.norm(of_residual))


def check(problem: Problem) -> None:
    """Asked for points in the box alone, it ends there at SciPy's cost."""
    ours = _ours(problem, _tolerance())
    assert ours.successful
    lower, upper = (np.asarray(edge) for edge in floats(problem.box()))
    assert np.array_equal(ours.asked[0], floats(problem.start))
    assert np.all((lower <= ours.asked) & (ours.asked <= upper))
    assert np.all((lower <= ours.point) & (ours.point <= upper))

    cost, best = _cost(problem, ours.point), _scipy(problem)
    unavoidable = _unavoidable(problem, ours)
    if ours.point.dtype == np.float64:
        assert cost <= best * (1 + 1e-8) + unavoidable**2
    else:
        tolerated = _tolerance() * len(ours.point) ** 0.5
        assert np.sqrt(cost) <= np.sqrt(best) + 2 * unavoidable + tolerated


def bind(problem: Problem) -> bool:
    """Whether a bound is met, to the last bit."""
    point = _ours(problem, _tolerance()).point
    lower, upper = (np.asarray(edge) for edge in floats(problem.box()))
    return bool(np.any((point == lower) | (point == upper)))


@pytest.mark.usefixtures("precision")
def test_ends_in_its_box_at_the_best_cost():
    few = [problem for problem in PROBLEMS if problem.name.split()[0] in FEW]
    for problem in few:
        check(problem)
    assert sum(map(bind, few)) >= 4


@pytest.mark.extended
@pytest.mark.parametrize("problem", PROBLEMS, ids=lambda problem: problem.name)
def test_all_end_in_their_boxes_at_the_best_cost(problem):
    check(problem)


@pytest.mark.extended
def test_the_problems_are_many_and_bounds_bind():
    different = {problem.residual for problem in PROBLEMS}
    assert len(different) == 12
    assert sum(map(bind, PROBLEMS)) >= 10
