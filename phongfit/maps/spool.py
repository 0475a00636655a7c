"""Photographs in a temporary file that is mapped to memory.

A stack of photographs may be larger than memory, and a tile needs a few pixels of each.
The file holds their whole numbers, and a byte for each sample of an image of which some
samples may not be used.
"""

import contextlib
import tempfile
from collections.abc import Callable
from typing import IO, Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from phongfit.files.budget import in_words
from phongfit.files.coded import Coded
from phongfit.maps.ahead import ahead

DECODED = 2
"""Number of photographs decoded in parallel, while another is written."""

ALIGNED = 16
"""Arrays begin at multiples of this number of bytes."""


class UsedImage(NamedTuple):
    """An image, (H, W, 3), and its samples that may be used; `None` for all."""

    coded: Coded
    used: Bool[np.ndarray, "height width *channel"] | None = None


def spooled(read: Callable[[int], UsedImage], count: int) -> list[UsedImage]:
    """Images that are read once and then mapped from a temporary file.

    The file is in the folder TMPDIR, and is deleted with the last of its images. The
    original files may change or vanish meanwhile.

    **Arguments:** `read`: returns the image with a number from 0 to `count` − 1.

    **Raises:** `OSError` that names the folder without room.
    """
    with tempfile.TemporaryFile(prefix="phongfit-") as file:
        images = []
        for _, ((numbers, table), used) in ahead(read, count, DECODED):
            used = None if used is None or used.all() else used
            places = [None if a is None else _write(file, a) for a in (numbers, used)]
            images.append((*places, table))
        data = np.memmap(file, np.uint8, "r")

    def mapped(place: _Place | None) -> Any:
        if place is None:
            return None
        return np.ndarray(place.shape, place.dtype, data, place.offset)

    return [
        UsedImage(Coded(mapped(numbers), table), mapped(used))
        for numbers, used, table in images
    ]


class _Place(NamedTuple):
    """An array in the file."""

    offset: int
    shape: tuple[int, ...]
    dtype: np.dtype


def _write(file: IO[bytes], array: np.ndarray) -> _Place:
    place = _Place(file.tell(), array.shape, array.dtype)
    try:
        file.write(np.ascontiguousarray(array).data)
        file.write(bytes(-array.nbytes % ALIGNED))
        file.flush()
    except OSError as error:
        # Closing flushes the buffer again, which fails again.
        with contextlib.suppress(OSError):
            file.close()
        size = place.offset + array.nbytes
        raise OSError(
            f"{tempfile.gettempdir()}: cannot be written: {error.strerror}; "
            f"photographs stand there once they are decoded, {in_words(size)} so "
            "far: make room, or set TMPDIR to another folder"
        ) from error
    return place
