"""Decoded photographs in a temporary file: not a bit is lost, and few are kept."""

import errno
from typing import Any

import numpy as np
import pytest

from phongfit.files.coded import Coded
from phongfit.files.images import level_table
from phongfit.maps.spool import Spool
from tests.maps.synthetic import dtype

SHAPE = 40, 60, 3
SIZE = SHAPE[0] * SHAPE[1]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def photograph(rng, dtype: Any = np.uint8, encoding: Any = "srgb") -> Coded:
    numbers = rng.integers(0, np.iinfo(dtype).max, SHAPE, dtype, True)
    return Coded(numbers, level_table(dtype, encoding))


def spool_of(images: list[Coded], masks: list[np.ndarray]) -> Spool:
    spool = Spool(dtype())
    for image, mask in zip(images, masks, strict=True):
        spool.add(image, mask)
    return spool


def check(spool: Spool, images: list[Coded], masks: list[np.ndarray]) -> None:
    """All of it, and some pixels of some images."""
    count = len(images)
    every = np.arange(SIZE)
    for order in (list(range(count)), list(range(count))[::-2]):
        for pixels in (every, every[417:903], np.array([3, 40, 41, 2000])):
            light = np.ma.asarray(spool.take(pixels, order).light)
            for row, k in zip(light, order, strict=True):
                used = np.broadcast_to(masks[k].reshape(*SHAPE[:2], -1), SHAPE)
                used = used.reshape(-1, 3)[pixels]
                image = images[k].light.reshape(-1, 3)[pixels]
                assert np.array_equal(np.ma.getmaskarray(row), ~used)
                assert np.array_equal(np.ma.getdata(row), np.where(used, image, 0))


def masks_of(rng, count: int) -> list[np.ndarray]:
    """Of pixels, of channels, and none."""
    kinds = (
        rng.random(SHAPE[:2]) < 0.7,
        rng.random(SHAPE) < 0.7,
        np.ones(SHAPE[:2], bool),
    )
    return [kinds[k % 3] for k in range(count)]


@pytest.mark.parametrize("encoding", ["srgb", "linear"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_whole_numbers_stay_whole(rng, encoding, dtype):
    images, masks = (
        [photograph(rng, dtype, encoding) for _ in range(3)],
        masks_of(rng, 3),
    )
    spool = spool_of(images, masks)
    taken = spool.take(np.arange(9), [0, 2])
    assert taken.numbers.dtype == dtype and spool.itemsize == np.dtype(dtype).itemsize
    assert taken.table is not None
    assert taken.table.shape == (2 ** (8 * spool.itemsize),)
    check(spool, images, masks)


def test_each_of_its_own_exposure(rng):
    """A byte a sample, and a table for each; of 16 bits tables would be the larger."""
    shares = 1.0, 0.317, 3.7, 1.0
    images, masks = [photograph(rng).times(share) for share in shares], masks_of(rng, 4)
    spool = spool_of(images, masks)
    taken = spool.take(np.arange(9), [1, 3])
    assert taken.table is not None
    assert taken.numbers.dtype == np.uint8 and taken.table.shape == (2, 256)
    check(spool, images, masks)
    images = [photograph(rng, np.uint16).times(share) for share in shares]
    spool = spool_of(images, masks)
    assert spool.take(np.arange(9), [1, 3]).table is None
    check(spool, images, masks)


def test_images_of_all_kinds_come_back_bit_for_bit(rng):
    """8 bits, 16, light itself, then 8 again, and samples left out."""
    images = [photograph(rng), photograph(rng, np.uint16)]
    images += [Coded(rng.random(SHAPE).astype(dtype())), photograph(rng).times(0.5)]
    masks = masks_of(rng, 4)
    spool = spool_of(images, masks)
    assert spool.itemsize == dtype().itemsize
    check(spool, images, masks)


def test_nothing_is_masked_where_all_may_be_used(rng):
    spool = spool_of([photograph(rng)], [np.ones(SHAPE[:2], bool)])
    assert not isinstance(spool.take(np.arange(9), [0]).numbers, np.ma.MaskedArray)


def test_the_checksum_tells_images_and_masks_apart(rng):
    image, all_of_it = photograph(rng), np.ones(SHAPE[:2], bool)
    but_one = all_of_it.copy()
    but_one[3, 5] = False

    def checksum(image: Coded, mask: np.ndarray) -> bytes:
        return spool_of([image], [mask]).checksum

    first = checksum(image, all_of_it)
    assert checksum(Coded(image.numbers.copy(), image.table), all_of_it) == first
    others = [
        checksum(image, but_one),
        checksum(Coded(image.numbers[::-1], image.table), all_of_it),
        # The same numbers of another table.
        checksum(image.times(0.5), all_of_it),
        checksum(Coded(image.light), all_of_it),
    ]
    assert len({first, *others}) == 5


def test_a_full_disk_says_what_to_do(rng, monkeypatch):
    spool = Spool(dtype())

    class Full:
        def write(self, data) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

        def close(self) -> None:
            """Nothing is open."""

    monkeypatch.setattr(spool, "_file", Full())
    said = r"No space left on device; .* 7\.03 KB so far: .*TMPDIR"
    with pytest.raises(OSError, match=said):
        spool.add(photograph(rng), np.ones(SHAPE[:2], bool))
