"""Temporary file of decoded photographs, from which a few pixels at a time are read.

A stack of photographs may be larger than memory, and a tile needs a few pixels of each.
The file is lossless, and has the size of the uncompressed images: it holds their whole
numbers, with a table of the light of each number.
"""

import contextlib
import hashlib
import tempfile
import threading
import weakref
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from phongfit.files.budget import in_words
from phongfit.files.coded import Coded


class _Image(NamedTuple):
    """Position, type and table of an image in the file.

    - `table`: index of the spool's table; `None` if the numbers are light.
    - `mask`: offset of the bits of its mask; `None` if all samples may be used.
    - `channels`: of the mask.
    """

    offset: int
    dtype: np.dtype
    table: int | None
    mask: int | None
    channels: int


class Spool:
    """Images of one size in a temporary file, which is deleted with the process."""

    def __init__(self, dtype: Any):
        """**Arguments:** `dtype`: of linear light."""
        self._dtype = np.dtype(dtype)
        self._tables: list[np.ndarray] = []
        self._images: list[_Image] = []
        self._end = 0
        self._checksum = hashlib.sha256()
        self._lock = threading.Lock()
        self._file = tempfile.TemporaryFile(prefix="phongfit-")
        weakref.finalize(self, self._file.close)

    def add(
        self, image: Coded, used: Bool[np.ndarray, "height width *channel"]
    ) -> None:
        """Append an image, (height, width, 3).

        **Raises:** `OSError` that names the folder without room.
        """
        numbers, table = image
        if table is None:
            numbers = numbers.astype(self._dtype, copy=False)
        numbers = np.ascontiguousarray(numbers)
        self._checksum.update(f"{numbers.dtype.str} {numbers.shape}".encode())
        if table is not None:
            self._checksum.update(np.ascontiguousarray(table).data)
        offset, mask, channels = self._end, None, ()
        self._write(numbers)
        if not used.all():
            channels, mask = used.shape[2:], self._end
            self._checksum.update(f"{channels}".encode())
            self._write(np.packbits(used))
        number = None if table is None else self._number(table)
        self._images.append(
            _Image(offset, numbers.dtype, number, mask, *(channels or (1,)))
        )

    def _write(self, array: np.ndarray) -> None:
        self._checksum.update(array.data.cast("B"))
        size = self._end + array.nbytes
        try:
            self._file.write(array.data)
            self._file.flush()
        except OSError as error:
            # Closing flushes the buffer again, which fails again.
            with contextlib.suppress(OSError):
                self._file.close()
            raise OSError(
                f"{tempfile.gettempdir()}: cannot be written: {error.strerror}; "
                f"photographs stand there once they are decoded, {in_words(size)} so "
                "far: make room, or set TMPDIR to another folder"
            ) from error
        self._end = size

    def _number(self, table: np.ndarray) -> int:
        """Index of a table, which is added if it is new."""
        for number, known in enumerate(self._tables):
            if np.array_equal(known, table):
                return number
        self._tables.append(table)
        return len(self._tables) - 1

    @property
    def itemsize(self) -> int:
        """Bytes of a sample in the arrays that `take` returns."""
        one = self._images[0] if self._images else None
        return one.dtype.itemsize if one and self._alike() else self._dtype.itemsize

    def _alike(self) -> bool:
        """True if samples are read as stored: of one type, with one or small tables."""
        kinds = {(image.dtype, image.table is None) for image in self._images}
        bytes_alone = all(image.dtype.itemsize == 1 for image in self._images)
        return len(kinds) == 1 and (bytes_alone or len(self._tables) == 1)

    def take(self, pixels: Int[np.ndarray, " n"], order: Sequence[int]) -> Coded:
        """Read some pixels: see [`AbstractStack`][]."""
        alike = self._alike()
        images = [self._images[number] for number in order]
        dtype = images[0].dtype if alike and images else self._dtype
        taken = np.empty((len(order), len(pixels), 3), dtype)
        first, last = (int(pixels[0]), int(pixels[-1]) + 1) if len(pixels) else (0, 0)
        run = last - first == len(pixels)
        hidden = None
        for row, image in enumerate(images):
            start = image.offset + 3 * first * image.dtype.itemsize
            if run and image.dtype == dtype:
                self._read(start, taken[row])
            else:
                numbers = np.empty((last - first, 3), image.dtype)
                self._read(start, numbers)
                numbers = numbers if run else numbers[pixels - first]
                if not alike and image.table is not None:
                    numbers = self._tables[image.table][numbers]
                taken[row] = numbers
            if image.mask is None:
                continue
            if hidden is None:
                hidden = np.zeros(taken.shape, bool)
            used = self._bits(image.mask, image.channels * first, image.channels * last)
            used = used.reshape(-1, image.channels)
            hidden[row] = ~(used if run else used[pixels - first])
        if hidden is not None and hidden.any():
            taken[hidden] = 0
            taken = np.ma.MaskedArray(taken, hidden)
        tables = [
            self._tables[k] for k in (one.table for one in images) if k is not None
        ]
        if not alike or not tables:
            return Coded(taken)
        return Coded(taken, tables[0] if len(self._tables) == 1 else np.stack(tables))

    def _read(self, offset: int, numbers: np.ndarray) -> None:
        """Fill `numbers` with those at an offset of the file."""
        with self._lock:
            self._file.seek(offset)
            self._file.readinto(numbers.data)

    def _bits(self, offset: int, first: int, last: int) -> np.ndarray:
        """Read bits `first` to `last` of a mask at an offset of the file."""
        start = first // 8
        found = np.empty(-(-last // 8) - start, np.uint8)
        self._read(offset + start, found)
        return np.unpackbits(found)[first - 8 * start : last - 8 * start].astype(bool)

    @property
    def checksum(self) -> bytes:
        """Checksum of the images, tables and masks."""
        return self._checksum.digest()
