import jax
import jax.numpy as jnp
import numpy as np
import pytest

from phongfit.testing import check_gradients
from phongfit.vectors import dot, norm, normalize, power
from tests.helpers import floats, near


def test_dot_norm_normalize():
    a, b = floats([3.0, 0.0, 4.0]), floats([1.0, 2.0, 0.5])
    near(dot(a, b), 5.0)
    near(norm(a), 5.0)
    near(normalize(a), [0.6, 0.0, 0.8])


@pytest.mark.parametrize("function", [norm, normalize])
def test_zero_vector_stays_zero_and_has_zero_derivatives(function):
    zero = floats([0.0, 0.0, 0.0])
    for derivative in (function, jax.jacfwd(function), jax.hessian(function)):
        assert np.all(np.asarray(derivative(zero)) == 0)


@pytest.mark.parametrize(
    "base, exponent, expected",
    [
        (1.0, 1000.0, 1.0),
        (0.5, 3.0, 0.125),
        (0.9, 0.0, 1.0),
        (0.0, 2.0, 0.0),
        (-0.5, 2.0, 0.0),
        (-0.5, 0.0, 0.0),
    ],
)
def test_power(base, exponent, expected):
    near(power(floats(base), floats(exponent)), expected)


def test_power_has_derivatives_everywhere():
    def function(point):
        return power(*point)

    base, exponent = np.meshgrid([0.2, 0.97, 1.0], [1.0, 2.5, 60.0, 1000.0])
    check_gradients(function, (base.ravel(), exponent.ravel()))
    # At 0 the second derivative jumps for small exponents: finite, and 0 by convention.
    base, exponent = np.meshgrid([0.0, -0.3], [1.0, 2.5, 1000.0])
    point = (base.ravel(), exponent.ravel())
    check_gradients(function, point, finite_differences=False)
    slopes = jax.grad(lambda p: jnp.sum(function(p)))(jax.tree.map(floats, point))
    assert all(np.all(np.asarray(slope) == 0) for slope in slopes)
