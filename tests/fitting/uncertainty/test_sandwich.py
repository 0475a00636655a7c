"""Sandwiches of small matrices, against what NumPy says of them."""

import numpy as np
import pytest

from phongfit.fitting.uncertainty.sandwich import (
    Sandwich,
    as_quadratic,
    inverse_of,
    threshold,
    unit_diagonal,
)

RNG = np.random.default_rng(3)
HALF = RNG.normal(size=(3, 12))
BREAD = HALF @ HALF.T
MEAT = HALF @ np.diag(RNG.uniform(0.5, 2, 12)) @ HALF.T
PULL = RNG.normal(size=3)
WHOLE = Sandwich(BREAD, MEAT, PULL, BREAD, 1e-16)


def test_the_covariance_is_a_sandwich():
    inverse = np.linalg.inv(BREAD)
    np.testing.assert_allclose(WHOLE.covariance(), inverse @ MEAT @ inverse, rtol=1e-9)


def test_a_direction_that_nothing_speaks_of_has_no_inverse():
    along = np.array([1.0, -1.0, 0.0]) / np.sqrt(2)
    flat = BREAD - np.outer(BREAD @ along, BREAD @ along) / (along @ BREAD @ along)
    assert np.abs(along @ flat @ along) < 1e-12
    scaled, root = unit_diagonal(flat)
    np.testing.assert_allclose(np.diag(scaled), 1)
    assert np.linalg.eigvalsh(scaled)[0] < threshold(1e-7)
    inverse = inverse_of(flat, 1e-7)
    # What is left of it is the inverse on the other directions.
    np.testing.assert_allclose(flat @ inverse @ flat, flat, atol=1e-9)


def test_the_strain_of_one_number_is_its_score_test():
    held = np.array([False, True, False])
    free = np.flatnonzero(~held)
    lean = BREAD[1, free] @ np.linalg.inv(BREAD[np.ix_(free, free)])
    weights = np.zeros(3)
    weights[1], weights[free] = 1, -lean
    expected = abs(weights @ PULL) / np.sqrt(weights @ MEAT @ weights)
    strain = WHOLE.strain(held)
    assert strain[1] == pytest.approx(expected) and not strain[free].any()


def test_its_quadratic_has_intervals_of_its_errors():
    far = np.full(3, 1e3)
    calm = WHOLE._replace(pull=np.zeros(3))
    ends = as_quadratic(calm, -far, far).ends(np.eye(3), 1.0)
    errors = np.sqrt(np.diag(calm.covariance()))
    np.testing.assert_allclose(ends, np.stack([-errors, errors], axis=1), rtol=1e-3)


def test_a_part_knows_the_others_as_given():
    part = WHOLE.part(np.array([0, 2]))
    np.testing.assert_array_equal(part.bread, BREAD[np.ix_([0, 2], [0, 2])])
    np.testing.assert_array_equal(part.pull, PULL[[0, 2]])
