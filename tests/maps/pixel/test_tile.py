"""Blocks of a tile, and the effort that their pixels take."""

import jax.numpy as jnp
import numpy as np
import pytest

from phongfit.maps.pixel.samples import Tile
from phongfit.maps.pixel.tile import BLOCK, FEW, MOST, in_blocks
from tests.helpers import floats

BLOCKS = 2 * FEW


def efforts_of(wanted):
    """Which pixel each result is of, and the effort that was made for it."""
    count = len(wanted)
    normal = floats(np.stack([np.arange(count), wanted, wanted], axis=-1))
    one, none = jnp.zeros((1, 3)), jnp.zeros((1, count, 1), bool)
    tile = Tile(jnp.zeros((1, count, 3)), none, normal, one, one)

    def fit(part, effort):
        pixel, wanted, _ = part.normal.T
        made = jnp.full(pixel.shape, effort).astype(pixel.dtype)
        return (pixel, made), wanted > made

    return map(np.asarray, in_blocks(tile, fit))


@pytest.mark.parametrize("share", [0.0, 0.01, 0.8, 1.0])
def test_every_pixel_gets_what_it_takes(share):
    rng = np.random.default_rng(0)
    count = BLOCKS * BLOCK
    wanted = np.where(rng.random(count) < share, rng.integers(1, MOST + 1, count), 0)
    pixel, made = efforts_of(wanted)
    assert np.array_equal(pixel, np.arange(count))
    # Few pixels get the most at once: they fill no more blocks than that.
    few = np.sum(wanted > 0) <= FEW * BLOCK
    assert np.array_equal(made, np.where(wanted > 0, MOST, 0) if few else wanted)


def test_a_last_block_that_is_not_full_wants_nothing():
    """What fills it stands for no pixel: nothing is written for the first one."""
    wanted = np.zeros(BLOCKS * BLOCK)
    wanted[-1] = MOST
    pixel, made = efforts_of(wanted)
    assert np.array_equal(pixel, np.arange(BLOCKS * BLOCK))
    assert np.array_equal(made, wanted)
