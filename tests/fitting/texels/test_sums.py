import numpy as np
import pytest

from phongfit.fitting.texels.sums import AbstractTexels, Grid, Touched, merged
from phongfit.textures import texels
from tests.helpers import floats, near

RNG = np.random.default_rng(0)


def touched(grid: Grid, filter, count: int = 300) -> Touched:
    uv = floats(RNG.uniform(-0.5, 1.5, (count, 2)))
    size = grid.rows, grid.columns
    number, weight = texels(uv, size, filter, grid.wrap)
    layer = RNG.integers(0, grid.layers, count) * grid.rows * grid.columns
    return merged(Touched(np.asarray(number) + layer[:, None], np.asarray(weight)))


def products(seen: Touched, values: np.ndarray, texels: int) -> np.ndarray:
    """As a fit adds them up, of one photograph."""
    total = np.zeros((seen.offsets, texels))
    seen.add_products(values, total)
    return total


def dense(seen: Touched, texels: int) -> np.ndarray:
    matrix = np.zeros((len(seen.number), texels))
    for k in range(seen.number.shape[1]):
        matrix[np.arange(len(matrix)), seen.number[:, k]] += seen.weight[:, k]
    return matrix


@pytest.mark.parametrize("filter", ["bilinear", "nearest"])
@pytest.mark.parametrize(
    "grid",
    [
        Grid(1, 5, 7, "repeat"),
        Grid(2, 4, 3, "clamp"),
        # So small that neighbours on either side are one.
        Grid(1, 2, 2, "repeat"),
        Grid(1, 1, 3, "repeat"),
        Grid(1, 1, 1, "clamp"),
    ],
)
def test_sums_are_those_of_the_whole_matrix(grid, filter):
    seen, count = touched(grid, filter), grid.texels
    whole = dense(seen, count)
    values, texture = RNG.normal(size=len(whole)), RNG.normal(size=count)
    near(seen.mean(texture), whole @ texture, 1e-5)
    near(seen.scattered(values, count), whole.T @ values, 1e-4)
    columns = [RNG.normal(size=len(whole)) for _ in range(2)]
    blocks = {
        (p, q): products(seen, columns[p] * columns[q], count)
        for p, q in ((0, 0), (0, 1), (1, 1))
    }
    both = np.concatenate([column[:, None] * whole for column in columns], axis=1)
    near(grid.matrix(blocks, 2).toarray(), both.T @ both, 1e-4)


@pytest.mark.parametrize("wrap, links", [("repeat", 24), ("clamp", 17)])
def test_smoothness_is_of_differences_between_neighbours(wrap, links):
    grid = Grid(1, 3, 4, wrap)
    first, second, _ = grid.links()
    assert (
        len(first)
        == links
        == len({frozenset(p) for p in zip(first, second, strict=True)})
    )
    check_differences(grid)


@pytest.mark.parametrize("rows, columns", [(2, 2), (1, 3), (1, 1)])
def test_differences_of_few_texels(rows, columns):
    check_differences(Grid(2, rows, columns, "repeat"))


def check_differences(texels: AbstractTexels) -> None:
    """As block and as gradient, each pair of neighbours once."""
    first, second, _ = texels.links()
    scale, values = RNG.uniform(0.5, 2, texels.texels), RNG.normal(size=texels.texels)
    matrix = texels.matrix({(0, 0): texels.differences(scale)}, 1)
    scaled = scale * values
    expected = ((scaled[first] - scaled[second]) ** 2).sum()
    near(values @ (matrix @ values), expected, 1e-5)
    near(scaled @ texels.from_neighbours(scaled), expected, 1e-5)
