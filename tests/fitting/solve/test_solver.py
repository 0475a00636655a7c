import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import scipy.optimize

from phongfit.fitting.solve.box import least_squares_in_box
from phongfit.fitting.solve.solver import BoundedLevenbergMarquardt, _landing
from tests.fitting.standard_problems import rosenbrock
from tests.helpers import eps, floats, near


def rtol() -> float:
    """How well a minimum is found, in the precision that is set."""
    return 1e-8 if eps() < 1e-10 else 1e-5


@eqx.filter_jit
def _run(residual, start, lower, upper, max_steps, rtol, **options):
    solver = BoundedLevenbergMarquardt(rtol, rtol, lower, upper, **options)
    return optx.least_squares(
        lambda y, args: residual(y),
        solver,
        start,
        max_steps=max_steps,
        throw=False,
    )


def minimize(residual, start, lower, upper, max_steps=500, tolerance=None, **options):
    """The solver's answer from a start; bounds are numbers or of the start's shape."""
    start = floats(start)
    lower, upper = (jnp.broadcast_to(floats(b), start.shape) for b in (lower, upper))
    tolerance = tolerance or rtol()
    return _run(residual, start, lower, upper, max_steps, tolerance, **options)


def test_bounds_are_met_to_the_last_bit():
    # y + (bound − y) is not bound for many pairs of floats: try a lot of them.
    rng = np.random.default_rng(0)
    bounds = np.array([0.1, 1 / 3, 0.7, 1e-5]).repeat(100)[:, None]
    bounds = bounds.astype(floats(0.0).dtype)
    starts = bounds + rng.uniform(0, 3, bounds.shape).astype(bounds.dtype)

    @jax.jit
    @jax.vmap
    def end(start, bound):
        upper = floats([np.inf])
        return _run(lambda y: y + 1, start, bound, upper, 50, rtol()).value

    assert np.array_equal(end(starts, bounds), bounds)


@pytest.mark.usefixtures("precision")
def test_no_step_ends_outside():
    # From far off, y + step may have to round: then it rounds to the inside.
    rng = np.random.default_rng(0)
    sign, size, width = rng.choice([-1, 0, 1], 4000), *rng.uniform(-8, 4, (2, 4000))
    kind = floats(0.0).dtype
    lower = (sign * 10.0**size).astype(kind)
    upper = lower + (10.0**width).astype(kind)
    share = rng.uniform(size=(2, 4000)).astype(kind)
    y = np.clip(lower + share[0] * (upper - lower), lower, upper)
    landing = jax.jit(lambda y, step: y + _landing(y, step, lower, upper))
    for step in (lower - y, upper - y, share[1] * (upper - y)):
        there = landing(y, step)
        assert np.all((lower <= there) & (there <= upper))


def test_a_step_by_orthogonal_factors_tells_apart_what_squares_do_not():
    solve = jax.jit(least_squares_in_box)
    for seed in range(8):
        # Columns that differ by less than the root of the resolution.
        rng = np.random.default_rng(seed)
        matrix = rng.normal(size=(7, 4))
        matrix[:, 3] = matrix[:, 2] + 50 * eps() ** 0.6 * rng.normal(size=7)
        matrix *= 10.0 ** rng.uniform(-3, 3, 4)
        residual = rng.normal(size=7)
        box = np.array([[-1e-2], [1.0]]) * rng.uniform(size=4)
        expected = scipy.optimize.lsq_linear(
            matrix, -residual, box, method="bvls", tol=1e-14
        )
        point = np.asarray(solve(matrix, residual, np.zeros(4), *box))
        assert np.all((box[0] <= point) & (point <= box[1]))
        cost = np.sum((matrix @ point + residual) ** 2) / 2
        assert cost <= expected.cost * (1 + 1e3 * eps())


def test_pytrees():
    def residual(y):
        return {"line": y["slope"] * x + y["ends"][0] - target, "end": y["ends"][1] - 5}

    x = floats(np.linspace(0, 1, 7))
    target = 3 * x - 2
    start = {"slope": floats(0.0), "ends": floats([0.0, 0.0])}
    lower = {"slope": floats(-10.0), "ends": floats([-1.5, -np.inf])}
    upper = {"slope": floats(10.0), "ends": floats([9.0, 4.0])}
    solution = _run(residual, start, lower, upper, 100, rtol())
    assert solution.result == optx.RESULTS.successful
    # With the offset at −1.5 the best slope is 3 − ½ Σx / Σx².
    assert solution.value["ends"][0] == floats(-1.5)
    assert solution.value["ends"][1] == floats(4.0)
    best = 3 - 0.5 * np.sum(np.asarray(x)) / np.sum(np.asarray(x) ** 2)
    near(solution.value["slope"], best, 1e3 * eps())


@pytest.mark.usefixtures("precision")
def test_no_stall_where_nothing_is_left():
    """Zero residual at the solution: the predicted decrease drowns in rounding."""
    x = floats(np.linspace(0, 4, 60))
    rng = np.random.default_rng(0)

    @jax.jit
    @jax.vmap
    def steps_and_error(truth, start):
        def model(y):
            return y[0] * jnp.exp(-jnp.exp(y[1]) * x) + y[2]

        def residual(y):
            return model(y) - model(truth)

        box = floats([-20.0] * 3), floats([20.0] * 3)
        solution = _run(residual, start, *box, 100, 50 * eps())
        return (
            solution.stats["num_steps"],
            solution.result == optx.RESULTS.successful,
            jnp.max(jnp.abs(residual(solution.value))),
        )

    truth = rng.uniform([0.5, -1, -1], [2, 1, 1], (100, 3)).astype(x.dtype)
    start = truth + rng.uniform(-0.3, 0.3, (100, 3)).astype(x.dtype)
    steps, successful, error = steps_and_error(truth, start)
    assert np.all(successful)
    assert np.max(steps) <= 30
    assert np.max(error) < 100 * eps()


@pytest.mark.extended
def test_an_unknown_that_is_hardly_felt_ends_too():
    # What there is to gain from the second drowns in the rest of the cost.
    @jax.jit
    @jax.vmap
    def end(felt):
        def residual(y):
            first = 1e3 * (y[0] - 0.5) + 30
            return jnp.stack([first, felt * (y[1] - 3), 40 + 0 * y[0]])

        lower, upper = floats([0.0, 0.0]), floats([1.0, 1.0])
        solution = _run(residual, floats([0.0, 0.25]), lower, upper, 30, rtol())
        return solution.value, solution.result == optx.RESULTS.successful

    felt = 10.0 ** np.arange(-18, 0, 0.25)
    value, successful = end(floats(felt))
    assert np.all(successful)
    near(value[:, 0], 0.47, 1e3 * eps())
    assert np.all((value[:, 1] == 0.25) | (value[:, 1] == 1))
    assert np.all(value[felt > 0.01, 1] == 1)


def test_an_unknown_that_does_nothing_stays():
    solution = minimize(lambda y: jnp.stack([y[0] - 2, 3 * y[0]]), (1.0, 0.3), -5, 5)
    assert solution.result == optx.RESULTS.successful
    near(solution.value, [0.2, 0.3], 1e3 * eps())


def test_failure_is_data():
    short = minimize(rosenbrock, (-1.2, 1.0), -5, 5, max_steps=3)
    assert short.result == optx.RESULTS.nonlinear_max_steps_reached
    assert np.all(np.isfinite(short.value))

    never = minimize(lambda y: jnp.log(-1 - y**2), (1.0, 2.0), -5, 5, max_steps=20)
    assert never.result != optx.RESULTS.successful


def test_a_region_without_numbers_is_avoided():
    # The first, too long step lands where the root of a negative number is asked for.
    def residual(y):
        return jnp.sqrt(y) - 0.1

    solution = minimize(residual, (4.0,), -10.0, 10.0)
    assert solution.result == optx.RESULTS.successful
    near(solution.value, 0.01, 1e-3)


def test_start_on_a_bound_and_fixed_unknowns():
    solution = minimize(rosenbrock, (2.0, 0.25), (0.5, 0.25), (2.0, 0.25))
    assert solution.result == optx.RESULTS.successful
    assert solution.value[1] == 0.25
    # The root of d/dx: -400 x (1/4 - x²) = 2 (1 - x).
    (best,) = [x.real for x in np.roots([400, 0, -98, -2]) if 0.5 < x.real < 2]
    near(solution.value[0], best, 1e4 * eps())


@pytest.mark.parametrize("gone", [{"pace": np.ones(2)}, {"foresee": True}])
def test_an_argument_that_has_gone_is_named(gone):
    with pytest.warns(DeprecationWarning, match=next(iter(gone))):
        BoundedLevenbergMarquardt(1e-5, 1e-5, 0, 1, **gone)
