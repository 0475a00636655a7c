import numpy as np
import pytest

from phongfit.fitting.texels.solve import inverse_diagonal, precondition, rescale
from phongfit.fitting.texels.stencil import make_stencil
from phongfit.fitting.texels.sums import Grid
from tests.fitting.texels.test_sums import products, touched
from tests.helpers import near

RNG = np.random.default_rng(0)


def sums(grid: Grid):
    """Of three fields, of which no sample sees the second beside the third."""
    seen, count = touched(grid, "bilinear", 4 * grid.texels), grid.texels
    columns = RNG.uniform(0.2, 1, (3, len(seen.number)))
    columns[1, ::2], columns[2, 1::2] = 0, 0
    coupled = [(0, 0), (0, 1), (1, 1), (0, 2), (2, 2)]
    return {
        (p, q): 1e3 * products(seen, columns[p] * columns[q], count).astype(np.float32)
        for p, q in coupled
    }


@pytest.mark.parametrize("wrap, layers", [("repeat", 1), ("clamp", 2)])
@pytest.mark.parametrize("units", [False, True])
def test_stencils_are_solved_as_matrices_are(wrap, layers, units):
    grid = Grid(layers, 7, 9, wrap)
    blocks, size = sums(grid), 3 * grid.texels
    prior = RNG.uniform(0.5, 2, size)
    unit = RNG.uniform(0.1, 10, size) if units else None
    whole = grid.matrix(blocks, 3, prior)
    if unit is not None:
        rescale(whole, unit)
    stencil = make_stencil(blocks, grid.shape, prior, unit)
    right = RNG.normal(size=(size, 2))
    near(precondition(whole.copy()).scale, stencil.scale, 1e-5)
    expected = np.linalg.solve(whole.toarray(), right)
    near(stencil.solve(right, 1e-6), expected, 1e-3 * abs(expected).max())
    # What is not free stays 0, and the rest is solved for as if that were known.
    free = np.arange(size) % 5 > 0
    solved = stencil.solve(right, 1e-6, free)
    assert not solved[~free].any()
    inner = whole.toarray()[np.ix_(free, free)]
    expected = np.linalg.solve(inner, right[free])
    near(solved[free], expected, 1e-3 * abs(expected).max())


def test_variances_are_those_of_the_inverse():
    grid = Grid(1, 24, 20, "repeat")
    blocks = {(0, 0): sums(grid)[0, 0]}
    exact = precondition(grid.matrix(blocks, 1, 1.0)).variances()
    assert exact is not None
    stencil = make_stencil(blocks, grid.shape, 1.0, None)
    ratio = np.sqrt(inverse_diagonal(stencil, grid, 1) / exact)
    # Standard errors: within some percent, most of them.
    assert abs(np.median(ratio) - 1) < 0.01
    assert np.quantile(abs(ratio - 1), 0.9) < 0.1
