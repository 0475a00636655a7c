"""Memory that a thread uses again."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from phongfit.maps.pixel.samples import Tile
from phongfit.maps.warm import ALIGNED, WarmMemory, filled


def test_a_copy_is_what_was_copied_in_one_piece():
    warm = WarmMemory()
    for dtype in (np.float32, np.float64):
        whole = np.arange(4 * 50 * 3, dtype=dtype).reshape(4, 50, 3)
        copy = warm.copy(whole[:, 7:30], 25)
        assert np.array_equal(copy[:, :23], whole[:, 7:30]) and copy.dtype == dtype
        assert copy.shape == (4, 25, 3) and not copy[:, 23:].any()
        assert copy.flags.c_contiguous and copy.ctypes.data % ALIGNED == 0


def test_a_thread_gets_its_own_again():
    warm = WarmMemory()
    first = warm.copy(np.zeros((3, 5, 1)), 5)
    again = warm.copy(np.ones((1, 5, 3)), 5)
    assert np.shares_memory(first, again) and again.all()
    with ThreadPoolExecutor(1) as other:
        apart = other.submit(warm.copy, np.zeros((3, 5, 1)), 5).result()
    assert not np.shares_memory(first, apart)
    assert not np.shares_memory(first, warm.copy(np.zeros((3, 5, 1)), 6))


def test_what_is_missing_of_a_tile_is_not_used():
    light, used = np.ones((2, 5, 3)), np.ones((1, 5, 1), bool)
    tile = Tile(light, used, np.ones((8, 3)), np.ones((1, 3)), np.ones((1, 3)))
    for part, few in zip(tile.parts(4), (4, 1), strict=True):
        whole = filled(part, WarmMemory())
        assert whole.target.shape == (2, 4, 3) and whole.used.shape == (1, 4, 1)
        assert whole.target[:, :few].all() and not whole.target[:, few:].any()
        assert whole.used[:, :few].all() and not whole.used[:, few:].any()
