"""Blocks of a tile, and the second pass for pixels that need it."""

import jax.numpy as jnp
import numpy as np
import pytest

from phongfit.maps.pixel.block import BLOCK, in_two_passes
from phongfit.maps.pixel.samples import Tile
from tests.helpers import floats

BLOCKS = 8


def passes_of(unsettled):
    """The pixel that each result is of, and whether its fit was thorough."""
    count = len(unsettled)
    normal = floats(np.stack([np.arange(count), unsettled, unsettled], axis=-1))
    one, none = jnp.zeros((1, 3)), jnp.zeros((1, count, 1), bool)
    light, seen = jnp.zeros((1, count, 3)), jnp.array(count)
    tile = Tile(light, none, normal, one, one, None, None, seen)

    def fit(part, thorough):
        pixel, unsettled, _ = part.normal.T
        return (pixel, jnp.broadcast_to(thorough, pixel.shape)), unsettled > 0

    return map(np.asarray, in_two_passes(tile, fit))


@pytest.mark.parametrize("share", [0.0, 0.01, 0.8, 1.0])
def test_unsettled_pixels_are_fitted_thoroughly(share):
    rng = np.random.default_rng(0)
    count = BLOCKS * BLOCK
    unsettled = rng.random(count) < share
    pixel, thorough = passes_of(unsettled)
    assert np.array_equal(pixel, np.arange(count))
    assert np.array_equal(thorough, unsettled)


def test_padding_of_the_last_block_overwrites_no_pixel():
    unsettled = np.zeros(BLOCKS * BLOCK, bool)
    unsettled[-1] = True
    pixel, thorough = passes_of(unsettled)
    assert np.array_equal(pixel, np.arange(BLOCKS * BLOCK))
    assert np.array_equal(thorough, unsettled)
