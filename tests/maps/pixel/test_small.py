"""Written-out linear algebra against NumPy's and SciPy's."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from phongfit.maps.pixel.small import (
    curvatures,
    factorize,
    minimize_in_box,
    solve,
    sum_over_images,
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


@pytest.mark.parametrize(
    "size", [*(pytest.param(n, marks=pytest.mark.extended) for n in (1, 2)), 3]
)
def test_minimum_in_a_box(size):
    columns, target, gram, vector = problems(size, seed=3)
    lower, upper = np.zeros((COUNT, size)), np.full((COUNT, size), 0.2)
    found = jax.jit(partial(minimize_in_box, rounds=6))(
        triangle(gram), entries(vector), entries(lower), entries(upper)
    )
    point = np.stack(found.point, axis=1)
    assert np.all((point >= 0) & (point <= floats(0.2)))
    off = []
    for k in range(COUNT):
        best = scipy.optimize.lsq_linear(columns[k], target[k], (0, 0.2), tol=1e-12).x
        here, there = (
            np.sum((columns[k] @ x - target[k]) ** 2) for x in (point[k], best)
        )
        off.append(here - there)
    # In rare cases the rounds go in circles: then it is a little off, and inside.
    assert np.mean(np.array(off) > 1e-4) < 0.01 and np.max(off) < 0.05


def test_a_minimum_does_not_depend_on_its_neighbours():
    """Those that end early wait for the others, and keep their bits."""
    _, _, gram, vector = problems(3, seed=3)
    edges = np.zeros((COUNT, 3)), np.full((COUNT, 3), 0.2)
    solve_all = jax.jit(jax.vmap(partial(minimize_in_box, rounds=6)))
    arguments = (triangle(gram), entries(vector), *map(entries, edges))
    together = solve_all(*arguments)
    assert np.any(together.free[0]) and not np.all(together.free[0])
    mixed = np.random.default_rng(1).permutation(COUNT)
    apart = solve_all(*jax.tree.map(lambda leaf: leaf[mixed], arguments))
    for a, b in zip(jax.tree.leaves(apart), jax.tree.leaves(together), strict=True):
        np.testing.assert_array_equal(a, np.asarray(b)[mixed])


@pytest.mark.parametrize("count", [1, 7, 8, 13, 16, 97])
def test_sums_over_images_hold_each_once(count):
    rng = np.random.default_rng(0)
    images = floats(rng.normal(size=(count, 3))), floats(rng.normal(size=(count, 1)))

    def add(sums, image):
        return sums[0] + image[0] * image[1], sums[1] + 1

    products, seen = sum_over_images(add, (jnp.zeros(3), jnp.zeros(())), images)
    np.testing.assert_allclose(
        products, np.asarray(images[0] * images[1]).sum(0), atol=1e-4
    )
    assert seen == count
