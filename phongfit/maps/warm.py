"""Memory that a thread uses again: fresh pages cost a fifth of what fits cost."""

import math
import threading
from typing import final

import numpy as np
from jaxtyping import Shaped

from phongfit.maps.pixel.samples import Tile

# What XLA takes on a CPU as it is, without a copy of its own.
ALIGNED = 64


@final
class WarmMemory(threading.local):
    """Of each thread: as much as it last asked for."""

    def __init__(self) -> None:
        self._bytes = np.empty(0, np.uint8)

    def copy(
        self, array: Shaped[np.ndarray, "images few channels"], pixels: int
    ) -> Shaped[np.ndarray, "images pixels channels"]:
        """The same and zeros, in one piece, until this thread's next copy."""
        images, few, channels = array.shape
        shape = images, pixels, channels
        size = math.prod(shape) * array.itemsize
        if len(self._bytes) != size:
            fresh = np.empty(size + ALIGNED, np.uint8)
            start = -fresh.ctypes.data % ALIGNED
            self._bytes = fresh[start : start + size]
        same = self._bytes.view(array.dtype).reshape(shape)
        same[:, :few] = array
        same[:, few:] = 0
        return same


def filled(tile: Tile, memory: WarmMemory) -> Tile:
    """A tile, or a part of one, whose light ended before its pixels, with zeros there.

    What was missing is not used. The light lies in `memory`.
    """
    pixels = len(tile.normal)
    used, missing = tile.used, pixels - tile.used.shape[1]
    if missing:
        used = np.pad(used, ((0, 0), (0, missing), (0, 0)))
    return tile._replace(target=memory.copy(tile.target, pixels), used=used)
