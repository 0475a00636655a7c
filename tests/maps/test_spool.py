"""Decoded photographs in a temporary file: not a bit is lost, and few are kept."""

import errno
from typing import Any

import numpy as np
import pytest

from phongfit.files.images import from_levels
from phongfit.maps.spool import Levels, Spool
from tests.maps.synthetic import DTYPE

SHAPE = 40, 60, 3


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def photograph(rng, dtype: Any = np.uint8, encoding: Any = "srgb") -> np.ndarray:
    highest = np.iinfo(dtype).max
    return from_levels(rng.integers(0, highest, SHAPE, dtype, True), encoding)


def everything(spool: Spool, count: int) -> np.ma.MaskedArray:
    return np.ma.asarray(spool.take(np.arange(SHAPE[0] * SHAPE[1]), range(count)))


@pytest.mark.parametrize("encoding", ["srgb", "linear"])
@pytest.mark.parametrize("strength", [1.0, 0.317, 3.7])
def test_light_of_8_bits_takes_a_byte_a_sample(rng, encoding, strength):
    light = photograph(rng, encoding=encoding) * DTYPE.type(strength)
    levels = Levels(DTYPE)
    found = levels.encode(light.ravel())
    assert found is not None and found.dtype == np.uint8 and len(levels.table) == 256
    assert np.array_equal(levels.decode(found), light.ravel())


def test_images_of_all_kinds_come_back_bit_for_bit(rng):
    """8 bits, each of other values, then 16, then 8 again, and samples left out."""
    images = [photograph(rng) / DTYPE.type(1 + k) for k in range(3)]
    images += [photograph(rng, np.uint16), photograph(rng)]
    masks = [rng.random(SHAPE[:2]) < 0.7, *(rng.random(SHAPE) < 0.7 for _ in range(4))]
    spool = Spool(DTYPE)
    for image, mask in zip(images, masks, strict=True):
        spool.add(image, mask)
    found = everything(spool, 5)
    for light, image, mask in zip(found, images, masks, strict=True):
        used = np.broadcast_to(mask.reshape(*SHAPE[:2], -1), SHAPE).reshape(-1, 3)
        assert np.array_equal(np.ma.getmaskarray(light), ~used)
        assert np.array_equal(light.data[used], image.reshape(-1, 3)[used])
    some = np.array([3, 40, 41, 2000])
    part = spool.take(some, [4, 0])
    expected = found[[4, 0]][:, some]
    assert np.ma.getmaskarray(part).any() and not np.ma.getmaskarray(part).all()
    assert np.array_equal(np.ma.getmaskarray(part), np.ma.getmaskarray(expected))
    assert np.array_equal(np.ma.filled(part, 0), np.ma.filled(expected, 0))


def test_nothing_is_masked_where_all_may_be_used(rng):
    spool = Spool(DTYPE)
    spool.add(photograph(rng), np.ones(SHAPE[:2], bool))
    assert not isinstance(spool.take(np.arange(9), [0]), np.ma.MaskedArray)


def test_the_checksum_tells_images_and_masks_apart(rng):
    image, all_of_it = photograph(rng), np.ones(SHAPE[:2], bool)
    but_one = all_of_it.copy()
    but_one[3, 5] = False

    def checksum(image: np.ndarray, mask: np.ndarray) -> bytes:
        spool = Spool(DTYPE)
        spool.add(image, mask)
        return spool.checksum

    first = checksum(image, all_of_it)
    assert checksum(image.copy(), all_of_it) == first
    others = [
        checksum(image, but_one),
        checksum(image[::-1], all_of_it),
        # The same levels of another table.
        checksum(image * DTYPE.type(0.5), all_of_it),
    ]
    assert len({first, *others}) == 4


def test_a_full_disk_says_what_to_do(rng, monkeypatch):
    spool = Spool(DTYPE)

    class Full:
        def write(self, data) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

        def close(self) -> None:
            """Nothing is open."""

    monkeypatch.setattr(spool, "_file", Full())
    said = r"No space left on device; .* 7\.03 KB so far: .*TMPDIR"
    with pytest.raises(OSError, match=said):
        spool.add(photograph(rng), np.ones(SHAPE[:2], bool))
