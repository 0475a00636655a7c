"""Written-out linear algebra against NumPy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from phongfit.maps.pixel.small import (
    curvatures,
    factorize,
    solve,
    times,
)
from tests.helpers import floats

COUNT = 200


def triangle(matrices: np.ndarray):
    """Batched matrices as tuples of rows, each entry an array over the batch."""
    size = matrices.shape[-1]
    return tuple(
        tuple(floats(matrices[:, i, j]) for j in range(i + 1)) for i in range(size)
    )


def entries(vectors: np.ndarray):
    return tuple(floats(vectors[:, i]) for i in range(vectors.shape[-1]))


def problems(size: int, seed: int = 0):
    rng = np.random.default_rng(seed)
    columns = rng.normal(size=(COUNT, 8, size))
    target = rng.normal(size=(COUNT, 8))
    gram = np.einsum("nki,nkj->nij", columns, columns)
    return columns, target, gram, np.einsum("nki,nk->ni", columns, target)


@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_solves(size):
    _, _, gram, vector = problems(size)
    found = jax.jit(lambda m, v: solve(factorize(m), v))(
        triangle(gram), entries(vector)
    )
    expected = np.linalg.solve(gram, vector[..., None])[..., 0]
    np.testing.assert_allclose(np.stack(found, 1), expected, rtol=2e-3, atol=1e-4)
    product = jnp.stack(times(triangle(gram), found), axis=1)
    np.testing.assert_allclose(product, vector, rtol=1e-3, atol=1e-4)


def test_curvatures_are_inverse_variances():
    _, _, gram, _ = problems(3)
    found = np.stack(jax.jit(curvatures)(triangle(gram)), axis=1)
    inverse = np.linalg.inv(gram)
    np.testing.assert_allclose(found, 1 / np.einsum("nii->ni", inverse), rtol=2e-3)


def test_what_rounding_hides_is_not_identified():
    gram = np.ones((COUNT, 2, 2))
    factors = factorize(triangle(gram))
    assert not np.any(factors.last) and not np.any(factors.inverse[1])
    x = solve(factors, entries(np.full((COUNT, 2), 3.0)))
    np.testing.assert_allclose(x[0], 3)
    assert not np.any(x[1])
