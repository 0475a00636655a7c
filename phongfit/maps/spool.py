"""Photographs that are decoded once, and then read a few pixels at a time.

A stack of them is larger than memory, and a tile wants a few pixels of each. So they
stand in a temporary file, without the loss of a bit, and as small as the files were
before they were compressed: where light has few values, as that of 8 bits has, a table
tells them, and the file holds their numbers.
"""

import contextlib
import hashlib
import tempfile
import threading
import weakref
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from phongfit.files.budget import in_words

LOW_BITS = 13
"""Bits of a single-precision number that may tell no two values apart: values differ by
a thousandth at least, as those of 8 bits do in any encoding."""

PIECE = 2**14
"""Numbers that are looked up at a time: few enough to stay in cache."""


class Levels:
    """The few values that numbers have; NaN may be one."""

    def __init__(self, dtype: Any):
        """**Arguments:** `dtype`: of the numbers, a float."""
        self.dtype = np.dtype(dtype)
        self._bits = np.dtype(f"u{self.dtype.itemsize}")
        keys = 2 ** (32 - LOW_BITS)
        self._value = np.zeros(keys, self.dtype)
        self._level = np.full(keys, -1, np.int32)
        self._table: list[float] = []

    @property
    def table(self) -> Float[np.ndarray, " levels"]:
        """The value of each level."""
        return np.array(self._table, self.dtype)

    def encode(
        self, numbers: Float[np.ndarray, " n"]
    ) -> Shaped[np.ndarray, " n"] | None:
        """The level of each number; `None` if there are too many values, too close."""
        levels = np.empty(numbers.shape, np.uint16)
        for start in range(0, numbers.size, PIECE):
            part = slice(start, start + PIECE)
            single = numbers[part].astype(np.float32, copy=False)
            keys = (single.view(np.uint32) >> LOW_BITS).astype(int)
            if not self._know(numbers[part], keys):
                return None
            levels[part] = self._level.take(keys)
        return levels.astype(np.uint8) if len(self._table) <= 256 else levels

    def _know(self, values: np.ndarray, keys: np.ndarray) -> bool:
        """Learn values that are new; false if two of them are too close."""
        new = self._level.take(keys) < 0
        if new.any():
            fresh, first = np.unique(keys[new], return_index=True)
            count = len(self._table)
            if count + len(fresh) > np.iinfo(np.uint16).max:
                return False
            self._value[fresh] = values[new][first]
            self._level[fresh] = np.arange(count, count + len(fresh))
            self._table.extend(self._value[fresh].tolist())
        known = self._value.take(keys)
        return bool((known.view(self._bits) == values.view(self._bits)).all())

    def decode(self, levels: Shaped[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """The number of each level."""
        table, numbers = self.table, np.empty(levels.shape, self.dtype)
        for start in range(0, levels.size, PIECE):
            part = slice(start, start + PIECE)
            np.take(table, levels[part], out=numbers[part], mode="clip")
        return numbers


class _Image(NamedTuple):
    """Where an image stands in the file, and what its numbers are.

    - `levels`: whose numbers they are; `None` for light itself.
    - `complete`: whether all samples may be used.
    """

    offset: int
    dtype: np.dtype
    levels: Levels | None
    complete: bool


class Spool:
    """Images of one size in a temporary file, which goes with the process."""

    def __init__(self, dtype: Any):
        """**Arguments:** `dtype`: of linear light."""
        self._dtype = np.dtype(dtype)
        self._levels: Levels | None = Levels(dtype)
        self._images: list[_Image] = []
        self._end = 0
        self._checksum = hashlib.blake2b(digest_size=16)
        self._lock = threading.Lock()
        self._file = tempfile.TemporaryFile(prefix="phongfit-")
        weakref.finalize(self, self._file.close)

    def add(
        self,
        image: Float[np.ndarray, "height width 3"],
        used: Bool[np.ndarray, "height width *channel"],
    ) -> None:
        """One image more.

        **Raises:** `OSError` that says where there should be room.
        """
        light = np.ascontiguousarray(image, self._dtype)
        complete = bool(used.all())
        if not complete:
            used = used.reshape(*used.shape[:2], -1)
            light = np.where(used, light, light.dtype.type(np.nan))
        light = light.reshape(-1)
        levels = None if self._levels is None else self._levels.encode(light)
        if levels is None:
            # Those that are there keep their table.
            self._levels, levels = None, light
        kept = _Image(self._end, levels.dtype, self._levels, complete)
        self._images.append(kept)
        self._checksum.update(f"{levels.dtype.str} {image.shape}".encode())
        self._checksum.update(levels.data)
        size = self._end + levels.nbytes
        try:
            self._file.write(levels.data)
            self._file.flush()
        except OSError as error:
            # What could not be written would be written again before it is closed.
            with contextlib.suppress(OSError):
                self._file.close()
            raise OSError(
                f"{tempfile.gettempdir()}: cannot be written: {error.strerror}; "
                f"photographs stand there once they are decoded, {in_words(size)} so "
                "far: make room, or set TMPDIR to another folder"
            ) from error
        self._end = size

    def take(
        self, pixels: Int[np.ndarray, " n"], order: Sequence[int]
    ) -> Float[np.ndarray, "images n 3"]:
        """Linear light of some pixels: see [`AbstractStack`][]."""
        taken = np.empty((len(order), len(pixels), 3), self._dtype)
        first, last = (pixels[0], pixels[-1] + 1) if len(pixels) else (0, 0)
        run = last - first == len(pixels)
        for row, number in enumerate(order):
            light = self._read(number, int(first), int(last))
            taken[row] = light if run else light[pixels - first]
        if all(self._images[number].complete for number in order):
            return taken
        hidden = np.isnan(taken)
        taken[hidden] = 0
        return np.ma.MaskedArray(taken, hidden)

    def _read(self, number: int, first: int, last: int) -> Float[np.ndarray, "n 3"]:
        """Pixels of an image, row by row; NaN where a sample may not be used."""
        image = self._images[number]
        numbers = np.empty(3 * (last - first), image.dtype)
        with self._lock:
            self._file.seek(image.offset + 3 * first * image.dtype.itemsize)
            self._file.readinto(numbers.data)
        levels = image.levels
        return (numbers if levels is None else levels.decode(numbers)).reshape(-1, 3)

    @property
    def checksum(self) -> bytes:
        """Of all that the images hold."""
        found = self._checksum.copy()
        # All that have levels share one table, and the first is among them.
        levels = self._images[0].levels if self._images else None
        if levels is not None:
            found.update(levels.table.data)
        return found.digest()
