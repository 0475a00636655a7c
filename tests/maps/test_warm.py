"""Memory that a thread uses again."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from phongfit.maps.warm import ALIGNED, WarmMemory


def test_a_copy_is_what_was_copied_in_one_piece():
    warm = WarmMemory()
    for dtype in (np.float32, np.float64):
        whole = np.arange(4 * 50 * 3, dtype=dtype).reshape(4, 50, 3)
        copy = warm.copy(whole[:, 7:30])
        assert np.array_equal(copy, whole[:, 7:30]) and copy.dtype == dtype
        assert copy.flags.c_contiguous and copy.ctypes.data % ALIGNED == 0


def test_a_thread_gets_its_own_again():
    warm = WarmMemory()
    first = warm.copy(np.zeros((3, 5)))
    again = warm.copy(np.ones((5, 3)))
    assert np.shares_memory(first, again) and again.all()
    with ThreadPoolExecutor(1) as other:
        apart = other.submit(warm.copy, np.zeros((3, 5))).result()
    assert not np.shares_memory(first, apart)
    assert not np.shares_memory(first, warm.copy(np.zeros((3, 6))))
