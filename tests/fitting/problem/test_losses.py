import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.fitting.problem.losses import LOSSES, as_loss
from tests.helpers import eps, floats, near

ROBUST = tuple(name for name in LOSSES if name != "linear")


@eqx.filter_jit
def root(loss, residual):
    return loss.root(residual)


@eqx.filter_jit
def weight(loss, residual):
    return loss.weight(residual)


# ρ(z) with z = r², worked out by hand from the formulas of the docstrings.
@pytest.mark.usefixtures("precision")
@pytest.mark.parametrize(
    "loss, residual, expected",
    [
        (pf.Linear(), 3.0, 9.0),
        (pf.Huber(k=1.0), 0.5, 0.25),
        (pf.Huber(k=1.0), -1.0, 1.0),
        (pf.Huber(k=1.0), 3.0, 5.0),  # 2·1·3 − 1
        (pf.Huber(k=2.0), 10.0, 36.0),  # 2·2·10 − 4
        (pf.SoftL1(k=1.0), 3**0.5, 2.0),  # 2 (√4 − 1)
        (pf.SoftL1(k=2.0), -2 * 3**0.5, 8.0),
        (pf.Cauchy(k=1.0), (np.e - 1) ** 0.5, 1.0),  # ln e
        (pf.Cauchy(k=2.0), 2 * (np.e**2 - 1) ** 0.5, 8.0),
        (pf.Tukey(k=1.0), 1.0, 1 / 3),
        (pf.Tukey(k=1.0), 0.5**0.5, (1 - 1 / 8) / 3),
        (pf.Tukey(k=3.0), 50.0, 3.0),
    ],
)
def test_values(loss, residual, expected):
    found = np.asarray(root(loss, floats(residual)))
    near(found**2, expected)
    assert np.sign(found) == np.sign(residual)


# ψ(r)/r by hand: 1/(1 + z/k²) for Cauchy, (1 − z/k²)² for Tukey, k/|r| for Huber.
@pytest.mark.parametrize(
    "loss, residual, expected",
    [
        (pf.Linear(), 50.0, 1.0),
        (pf.Huber(k=1.0), 0.5, 1.0),
        (pf.Huber(k=1.0), -4.0, 0.25),
        (pf.SoftL1(k=1.0), 3**0.5, 0.5),
        (pf.Cauchy(k=2.0), -4.0, 0.2),
        (pf.Tukey(k=2.0), 1.0, 0.5625),
        (pf.Tukey(k=2.0), -2.5, 0.0),
    ],
)
def test_how_much_of_a_sample_is_accepted(loss, residual, expected):
    found = weight(loss, floats([residual, 0.0, -1e-9]))
    near(found, [expected, 1, 1])


@pytest.mark.parametrize("name", LOSSES)
def test_small_residuals_are_as_they_are(name):
    small = floats([-1e-3, -1e-6, 0.0, 1e-30, 1e-4])
    near(root(LOSSES[name], small), small, max(1e-8, eps()))


@pytest.mark.parametrize("name", LOSSES)
def test_cost_never_falls_and_pull_is_bounded(name):
    residual = np.asarray(floats(np.linspace(0, 40, 401)))
    cost = np.asarray(root(LOSSES[name], floats(residual))) ** 2
    assert np.all(np.diff(cost) >= -1e-5)
    assert np.all(cost <= residual**2 * (1 + 10 * eps()))
    pull = np.diff(cost[-2:])[0] / 0.1 / 2
    limits = {"linear": 40, "huber": 1.345, "soft_l1": 1.345, "cauchy": 0.15}
    assert pull <= 1.01 * limits.get(name, 1e-4)
    assert LOSSES[name].robust == (name != "linear")


@pytest.mark.parametrize("name", LOSSES)
def test_derivatives_are_finite_and_start_at_one(name):
    loss = LOSSES[name]
    k = getattr(loss, "k", 1.0)
    points = floats([0.0, 1e-5, 1e-20, eps() ** 0.5, -1e-3, 1.0, k, -k, 2 * k, 1e4])

    @jax.jit
    @jax.vmap
    def derivatives(r):
        return jax.grad(loss.root)(r), jax.grad(jax.grad(loss.root))(r)

    first, second = map(np.asarray, derivatives(points))
    assert np.all(np.isfinite(first)) and np.all(np.isfinite(second))
    near(first[:2], 1, 1e-4)


# Fraction of a normal sample's information that a loss keeps: E[ψ']² / E[ψ²].
@pytest.mark.parametrize("name", ["huber", "tukey", "cauchy"])
def test_95_percent_efficiency(name):
    grid = np.linspace(-8, 8, 4001)
    density = np.exp(-(grid**2) / 2)
    density /= density.sum()

    def half(r):
        return jnp.sum(LOSSES[name].root(r) ** 2) / 2

    at = floats(grid)
    score, slope = jax.jit(lambda r, by: jax.jvp(jax.grad(half), (r,), (by,)))(
        at, np.ones_like(at)
    )
    efficiency = np.sum(density * slope) ** 2 / np.sum(density * score**2)
    assert 0.945 < efficiency < 0.955


def test_names():
    for name, loss in LOSSES.items():
        assert as_loss(name) is loss
    mine = pf.Huber(k=0.3)
    assert as_loss(mine) is mine
    with pytest.raises(
        ValueError, match="loss: expected one of linear, huber.*got 'l2'"
    ):
        as_loss("l2")
