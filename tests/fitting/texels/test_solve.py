import numpy as np
import pytest
from scipy import sparse

from phongfit.fitting.texels import solve
from phongfit.fitting.texels.solve import inverse_diagonal, precondition
from phongfit.fitting.texels.sums import Grid, Touched
from phongfit.textures import texels
from tests.fitting.texels.test_sums import products
from tests.helpers import floats, near

GRID = Grid(1, 24, 20, "repeat")


def matrix(parameters: int = 2) -> sparse.csr_array:
    """As a fit has it: each texel is seen some three times."""
    rng = np.random.default_rng(0)
    uv = floats(rng.uniform(size=(3 * GRID.texels, 2)))
    index, share = texels(uv, (24, 20), "bilinear", "repeat")
    seen = Touched(np.asarray(index), np.asarray(share))
    columns = rng.uniform(0.2, 1, (parameters, len(uv)))
    blocks = {
        (p, q): products(seen, columns[p] * columns[q], GRID.texels)
        for p in range(parameters)
        for q in range(p, parameters)
    }
    size = parameters * GRID.texels
    return sparse.csr_array(
        1e3 * GRID.matrix(blocks, parameters) + sparse.eye_array(size)
    )


def test_systems_are_solved():
    whole = matrix()
    count = 2 * GRID.texels
    right = np.random.default_rng(1).normal(size=(count, 3))
    ready = precondition(whole.copy())
    solved = ready.solve(right, 1e-9)
    near(solved, np.linalg.solve(whole.toarray(), right), 1e-6)
    # What is not free stays 0, and the rest is solved for as if that were known.
    free = np.arange(len(right)) % 5 > 0
    solved = ready.solve(right, 1e-9, free)
    assert not solved[~free].any()
    inner = whole.toarray()[np.ix_(free, free)]
    near(solved[free], np.linalg.solve(inner, right[free]), 1e-6)


@pytest.mark.parametrize("parameters", [1, pytest.param(2, marks=pytest.mark.extended)])
def test_variances_are_those_of_the_inverse(parameters, monkeypatch):
    whole = matrix(parameters)
    exact = np.diag(np.linalg.inv(whole.toarray()))
    ready = precondition(whole)
    near(inverse_diagonal(ready, GRID, parameters), exact, 1e-6)
    monkeypatch.setattr(solve, "EXACT", 0)
    probed = inverse_diagonal(ready, GRID, parameters)
    ratio = np.sqrt(probed / exact)
    # Standard errors: within some percent, most of them.
    assert abs(np.median(ratio) - 1) < 0.01
    assert np.quantile(abs(ratio - 1), 0.9) < 0.1
