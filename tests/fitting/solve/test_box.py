import jax
import numpy as np
import pytest
from scipy.optimize import lsq_linear

from phongfit.fitting.solve.box import minimize_in_box
from tests.helpers import eps, floats, near

SIZE = 6
solve = jax.jit(minimize_in_box)


def boxed_problem(seed: int) -> tuple[np.ndarray, ...]:
    """A random problem A p ≈ b in a box, that holds 0 or not, finite or not."""
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(9, SIZE)) * np.exp(rng.normal(size=SIZE))
    target = 3 * rng.normal(size=9)
    lower, upper = np.sort(rng.normal(size=(2, SIZE)), axis=0) * (1 + seed % 4) ** 2
    lower[rng.random(SIZE) < 0.2] = -np.inf
    upper[rng.random(SIZE) < 0.2] = np.inf
    # As the solver sees them: comparisons to the last bit must be in one precision.
    return tuple(np.asarray(floats(a)) for a in (matrix, target, lower, upper))


def answer(matrix, target, lower, upper) -> np.ndarray:
    hessian, gradient = matrix.T @ matrix, -matrix.T @ target
    return np.asarray(solve(*map(floats, (hessian, gradient, lower, upper))))


def cost(matrix, target, point) -> float:
    return float(np.sum((matrix.astype(float) @ point - target) ** 2))


@pytest.mark.usefixtures("precision")
def test_against_scipy():
    counts = set()
    for matrix, target, lower, upper in map(boxed_problem, range(60)):
        expected = lsq_linear(
            matrix.astype(float), target, (lower, upper), method="bvls", tol=1e-14
        )
        point = answer(matrix, target, lower, upper)
        near(point, expected.x, 2000 * eps())
        # Where SciPy's answer is on a bound, so is this one, to the last bit.
        bound = np.where(expected.active_mask < 0, lower, upper)
        active = expected.active_mask != 0
        assert np.array_equal(point[active], bound[active])
        counts.add(int(np.sum(active)))
    # Of all kinds.
    assert {0, 1, 2, 3, 4, 5} <= counts


@pytest.mark.usefixtures("precision")
@pytest.mark.parametrize("rank", [0, 1, 3])
def test_singular(rank):
    for seed in range(20):
        check_singular(seed, rank)


def check_singular(seed: int, rank: int) -> None:
    matrix, target, lower, upper = boxed_problem(seed)
    rng = np.random.default_rng(100 + seed)
    lower, upper = np.maximum(lower, -60), np.minimum(upper, 60)
    # Columns of ones: every diagonal is positive, but ranks are low.
    left = np.concatenate([rng.normal(size=(9, rank)), np.ones((9, 1))], axis=1)
    right = np.concatenate([rng.normal(size=(rank, SIZE)), np.ones((1, SIZE))])
    matrix = np.asarray(floats(left @ right))
    point = answer(matrix, target, lower, upper)
    assert np.all(np.isfinite(point))
    assert np.all((lower <= point) & (point <= upper))
    best = lsq_linear(matrix.astype(float), target, (lower, upper), method="bvls")
    assert cost(matrix, target, point) <= 2 * best.cost * (1 + 1e-3) + 1e-3


@pytest.mark.usefixtures("precision")
def test_opposite_columns_with_noise():
    # Rounding makes this matrix indefinite: a Cholesky factor of it does not exist.
    hessian = np.eye(SIZE)
    hessian[0, 1] = hessian[1, 0] = 1 + 4 * eps()
    point = solve(
        floats(hessian),
        floats([-1, -1, 0, 0, 0, 0]),
        floats([-9] * SIZE),
        floats([9] * SIZE),
    )
    near(point[0] + point[1], 1, 1e-3)


@pytest.mark.usefixtures("precision")
@pytest.mark.parametrize(
    "gradient, lower, upper, expected",
    [
        (-1.0, -1.0, 2.0, 1.0),  # free
        (-1.0, -1.0, 0.3, 0.3),  # stopped above
        (1.0, -0.3, 2.0, -0.3),  # stopped below
        (-1.0, 0.0, 0.3, 0.3),  # starts at one bound, ends at the other
        (1.0, 0.0, 0.3, 0.0),  # starts at the bound and stays
        (-1.0, 0.2, 0.2, 0.2),  # no room
        (-1.0, 2.0, 3.0, 2.0),  # the box does not hold 0
        (-1.0, -np.inf, np.inf, 1.0),
        (0.0, -1.0, 1.0, 0.0),
    ],
)
def test_one_unknown(gradient, lower, upper, expected):
    box = [np.full(SIZE, edge) for edge in (gradient, lower, upper)]
    point = solve(floats(np.eye(SIZE)), *map(floats, box))
    # An infinitesimal ridge may take part, a bound is a bound.
    near(point, expected, 200 * eps())
    if expected in (lower, upper):
        assert np.all(point == floats(expected))


def test_a_bound_is_left_again():
    # On the way from 0 to the free optimum (10, 2) the second entry meets 0.1, then the
    # first meets 1; there the second wants 2 - 0.9 (10 - 1), far below its bound.
    hessian = np.eye(SIZE)
    hessian[:2, :2] = [[1, -0.9], [-0.9, 1]]
    gradient = -hessian @ np.array([10, 2, 0, 0, 0, 0])
    lower, upper = np.full(SIZE, -7), np.array([1, 0.1, 1, 1, 1, 1])
    point = solve(*map(floats, (hessian, gradient, lower, upper)))
    assert point[0] == 1
    near(point, [1, -6.1, 0, 0, 0, 0], 500 * eps())


def test_huge_and_tiny_units():
    scale = np.array([1e-6, 1e-3, 1, 1, 1e3, 1e6])
    for seed in range(5):
        matrix, target, lower, upper = boxed_problem(seed)
        expected = answer(matrix, target, lower, upper)
        scaled = answer(matrix * scale, target, lower / scale, upper / scale)
        near(scaled * scale, expected, 2000 * eps())
