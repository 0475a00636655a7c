"""Stacks that files fill: what they hold, and how little of it at a time."""

import errno
import io
import mmap
import tempfile
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import phongfit as pf
from phongfit.files.coded import Coded
from phongfit.files.dataset import Photograph, Photographs
from phongfit.files.images import level_table
from phongfit.maps.ahead import ahead
from phongfit.maps.spool import UsedImage, spooled
from phongfit.maps.stacks import ArrayStack, _mapping
from tests.helpers import floats
from tests.maps.synthetic import Stack, dtype, make_stack, same, write_diligent

QUICK: dict[str, Any] = {"unknowns": ("diffuse",), "tile_pixels": 512}


@pytest.fixture(scope="module")
def stack() -> Stack:
    return make_stack(48, 64, 12, ambient=0.0)


@pytest.fixture(scope="module")
def written(stack, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("diligent")
    write_diligent(folder, stack, brightness=1.5)
    return folder


@pytest.mark.extended
def test_a_data_set_read_piece_by_piece(written):
    """The same bits as with all of it in memory, saturated samples left out."""
    data = pf.open_dataset(written, min_cosine=0.3, min_facing=0.88)
    whole = data.load()
    hidden = ~np.stack(whole.masks)
    assert 0 < hidden.all(axis=(0, 3)).mean() < 0.5
    stack = pf.DatasetStack(data)
    found, expected = (
        pf.fit_maps(data.scenes, images, mask=mask, film=data.film, **QUICK)
        for images, mask in ((stack, stack.mask), (whole.images, whole.masks))
    )
    same(found, expected)
    assert expected.samples.max() > expected.samples[expected.identified].min()
    assert expected.identified.sum() > 1000


def test_two_photographs_are_in_memory():
    """One while the next is read, however many there are; or all, where all are asked
    for."""
    count, size = 8, 512
    scene = pf.Scene(pf.Sphere(), pf.OrthographicCamera(size, size))

    def read(number: int) -> Photograph:
        image = np.full((size, size, 3), number / count, dtype())
        return Photograph(Coded(image), np.ones((size, size), bool))

    names = tuple(str(number) for number in range(count))
    data = Photographs("made", (scene,) * count, names, pf.Film(), read)
    one = size * size * 3 * dtype().itemsize
    tracemalloc.start()
    try:
        pf.DatasetStack(data).take(np.arange(64), range(count))
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        whole = data.load()
        _, all_of_it = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(whole.images) == count and all_of_it > count * one
    assert peak < 5 * one


def test_what_identifies_a_data_set(written, tmp_path):
    """Another image, or another mask, is another job."""

    def checksum(folder: Path, **options: Any) -> bytes:
        parts: list[bytes] = []
        pf.DatasetStack(pf.open_dataset(folder, **options)).identify(
            lambda part: parts.append(bytes(part))
        )
        return b"".join(parts)

    for path in written.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    first = checksum(written)
    assert checksum(tmp_path) == first
    assert checksum(written, min_cosine=0.5) != first
    (tmp_path / "003.png").write_bytes((written / "004.png").read_bytes())
    assert checksum(tmp_path) != first


def test_a_broken_photograph_is_named_at_once(written, tmp_path):
    for path in written.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "007.png").write_bytes(b"junk")
    with pytest.raises(ValueError, match=r"007\.png: is broken"):
        pf.DatasetStack(pf.open_dataset(tmp_path))


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (0, 2, 1, 3), (1, 2)])
@pytest.mark.parametrize("pixels", [range(7, 21), (3, 4, 9)])
def test_an_array_gives_the_same_in_any_order_and_type(order, pixels):
    rng = np.random.default_rng(0)
    whole = np.asarray(floats(rng.random((4, 5, 6, 3))))
    pixels = np.array(pixels)
    expected = whole.reshape(4, 30, 3)[np.array(order)[:, None], pixels]
    turned = np.asfortranarray(whole)
    for images in (whole, list(whole), turned, whole.astype(np.float16)):
        taken = ArrayStack(images).take(pixels, order)
        coarse = np.asarray(images).dtype == np.float16
        np.testing.assert_allclose(taken, expected, atol=1e-3 if coarse else 0)


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (2, 0)])
@pytest.mark.parametrize("pixels", [range(7, 21), (3, 4, 9)])
def test_a_rectangle_keeps_whole_numbers(order, pixels):
    """With the table that belongs to each image, and what may not be used."""
    rng = np.random.default_rng(0)
    numbers = rng.integers(0, 256, (4, 5, 6, 3), np.uint8)
    masked = np.ma.MaskedArray(numbers, rng.random(numbers.shape) < 0.5)
    tables = np.asarray(floats(rng.random((4, 256))))
    pixels, rows = np.array(pixels), np.array(order)[:, None]
    for table in (tables, tables[0]):
        images = Coded(masked, table)
        taken = ArrayStack(images).take_coded(pixels, order)
        assert taken.numbers.dtype == np.uint8
        expected = images.light.reshape(4, 30, 3)[rows, pixels]
        assert np.array_equal(np.ma.getdata(taken.light), np.ma.getdata(expected))
        hidden = np.ma.getmaskarray(taken.numbers)
        assert np.array_equal(hidden, np.ma.getmaskarray(expected))
    checksums = set()
    for one in (images, Coded(numbers, table), Coded(masked, table + 1)):
        parts: list[bytes] = []
        ArrayStack(one).identify(lambda part, to=parts: to.append(bytes(part)))
        checksums.add(b"".join(parts))
    assert len(checksums) == 3


@pytest.mark.parametrize(
    "options", [{"access": mmap.ACCESS_COPY}, {"flags": mmap.MAP_PRIVATE}]
)
def test_arrays_in_a_private_map_keep_their_values(options, tmp_path):
    (tmp_path / "file").write_bytes(bytes(4 * 300))
    with open(tmp_path / "file", "r+b") as file:
        memory = mmap.mmap(file.fileno(), 0, **options)
    images = np.frombuffer(memory, np.float32).reshape(1, 10, 10, 3)
    images[:] = 0.5
    ArrayStack(images).take(np.arange(9), [0])
    assert (images == 0.5).all()


def test_pages_that_can_be_read_again_are_let_go(tmp_path):
    np.save(tmp_path / "stack.npy", np.ones((1, 4, 5, 3)))
    modes: Any = {"r": True, "r+": True, "c": False}
    for mode, known in modes.items():
        array = np.load(tmp_path / "stack.npy", mmap_mode=mode)[0]
        assert (_mapping(np.asarray(array)) is not None) == known
    (image,) = spooled(lambda _: UsedImage(Coded(np.ones((4, 5, 3)))), 1)
    assert _mapping(image.coded.numbers) is not None


def test_masked_samples_keep_what_is_finite():
    """They are a lower bound of clipped light; NaN is 0, so that fits stay finite."""
    light = np.repeat([0.8, 0.8, np.nan], 3).reshape(1, 1, 3, 3)
    hidden = np.repeat([False, True, True], 3).reshape(light.shape)
    images = np.ma.MaskedArray(light, hidden)
    taken = ArrayStack(images).take(np.arange(3), [0])
    assert np.ma.getdata(taken)[0, :, 0] == pytest.approx([0.8, 0.8, 0])
    assert np.array_equal(np.ma.getmaskarray(taken), hidden[0])


def test_a_table_is_identified_at_once():
    image = Coded(np.zeros((1, 2, 3, 3), np.uint16), np.zeros(2**16, dtype()))
    parts: list[bytes] = []
    ArrayStack(image).identify(lambda part: parts.append(bytes(part)))
    assert len(parts) == 5 and len(parts[-1]) == 2**16 * dtype().itemsize


def test_reading_ahead_is_in_order_and_ends_with_an_error():
    begun = []

    def read(number: int) -> int:
        begun.append(number)
        if number == 5:
            raise ValueError("5: is broken")
        return number**2

    for beside in (1, 3):
        begun.clear()
        found = []
        with pytest.raises(ValueError, match="5: is broken"):
            for number, here in ahead(read, 40, beside):
                assert here == number**2 and max(begun) <= number + beside
                found.append(number)
        assert found == [0, 1, 2, 3, 4] and len(begun) <= 5 + beside
    assert list(ahead(read, 0)) == []
    assert list(ahead(read, 2, 3)) == [(0, 0), (1, 1)]


SHAPE = 40, 60, 3
SIZE = SHAPE[0] * SHAPE[1]
WHOLE = np.ones(SHAPE[:2], bool)


def coded(rng, kind: Any = np.uint8, share: float = 1.0) -> Coded:
    """A photograph of 8 or 16 bits, or light itself."""
    if kind is float:
        return Coded(rng.random(SHAPE).astype(dtype()))
    numbers = rng.integers(0, np.iinfo(kind).max, SHAPE, kind, True)
    return Coded(numbers, level_table(kind, "srgb")).times(share)


@pytest.mark.parametrize(
    ("kinds", "shares", "stored", "tables"),
    [
        ([np.uint8] * 3, [1, 1, 1], np.uint8, (256,)),
        ([np.uint16] * 3, [1, 1, 1], np.uint16, (2**16,)),
        # A table for each exposure; of 16 bits tables would be the larger.
        ([np.uint8] * 3, [1, 0.3, 3.7], np.uint8, (2, 256)),
        ([np.uint16] * 3, [1, 0.3, 3.7], None, None),
        ([np.uint8, np.uint16, float, np.uint8], [1, 1, 1, 0.5], None, None),
    ],
)
def test_photographs_come_back_from_their_file(kinds, shares, stored, tables):
    """Bit for bit, with masks of pixels, of channels, and none."""
    rng = np.random.default_rng(3)
    images = [coded(rng, *one) for one in zip(kinds, shares, strict=True)]
    masks = [rng.random(SHAPE[:2]) < 0.7, rng.random(SHAPE) < 0.7, WHOLE, WHOLE]
    masks = masks[: len(images)]
    given = [UsedImage(*one) for one in zip(images, masks, strict=True)]
    stack = ArrayStack.__new__(ArrayStack)
    stack._keep(spooled(given.__getitem__, len(given)))
    assert stack.itemsize == np.dtype(dtype() if stored is None else stored).itemsize
    numbers, table = stack.take_coded(np.arange(9), [0, 2])
    assert numbers.dtype == (dtype() if stored is None else stored)
    assert (None if table is None else table.shape) == tables
    every = np.arange(SIZE)
    for order in (list(range(len(images))), list(range(len(images)))[::-2]):
        for pixels in (every, every[417:903], np.array([3, 40, 41, 2000])):
            light = np.ma.asarray(stack.take(pixels, order))
            for row, k in zip(light, order, strict=True):
                used = np.broadcast_to(masks[k].reshape(*SHAPE[:2], -1), SHAPE)
                used = used.reshape(-1, 3)[pixels]
                image = images[k].light.reshape(-1, 3)[pixels]
                assert np.array_equal(np.ma.getmaskarray(row), ~used)
                assert np.array_equal(np.ma.getdata(row)[used], image[used])
    unmasked = stack.take_coded(np.arange(9), [2]).numbers
    assert not isinstance(unmasked, np.ma.MaskedArray)


def test_a_full_disk_says_what_to_do(monkeypatch):
    class Full(io.BytesIO):
        def write(self, data) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(tempfile, "TemporaryFile", lambda **_: Full())
    image = UsedImage(coded(np.random.default_rng(3)))
    said = r"No space left on device; .* 7\.03 KB so far: .*TMPDIR"
    with pytest.raises(OSError, match=said):
        spooled(lambda _: image, 1)
