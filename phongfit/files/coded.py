"""Light as files have it: whole numbers, and a table of what each of them stands for.

An image of 8 bits takes a quarter of the memory that its light takes, and is turned
into light where that is needed, a few samples at a time.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Shaped

PIECE = 2**20
"""Samples that are looked up at a time: NumPy copies their numbers, 8 bytes each."""


class Coded(NamedTuple):
    """Linear light, or numbers that stand for it.

    - `numbers`: light itself, or whole numbers from 0 on; NumPy's masked array where
        some may not be used.
    - `table`: the light of each whole number; a row for each of the first axis of
        `numbers` where it differs among them. `None` where they are light.
    """

    numbers: Shaped[np.ndarray, "..."]
    table: Float[np.ndarray, "*images levels"] | None = None

    @property
    def light(self) -> Float[np.ndarray, "..."]:
        """All of it as light; NumPy's masked array, and 0, where it may not be used."""
        if self.table is None:
            return self.numbers
        numbers = np.ma.getdata(self.numbers)
        light = np.empty(numbers.shape, self.table.dtype)
        if self.table.ndim == 2:
            for k, (image, table) in enumerate(zip(numbers, self.table, strict=True)):
                light[k] = Coded(image, table).light
        else:
            rows = max(PIECE // max(numbers[:1].size, 1), 1)
            for start in range(0, len(numbers), rows):
                some = slice(start, start + rows)
                light[some] = self.table[numbers[some]]
        if not np.ma.is_masked(self.numbers):
            return light
        hidden = np.ma.getmaskarray(self.numbers)
        light[hidden] = 0
        return np.ma.MaskedArray(light, hidden)

    def times(self, share: float) -> "Coded":
        """So many times the light."""
        if self.table is None:
            return Coded(self.numbers * self.numbers.dtype.type(share))
        return Coded(self.numbers, self.table * self.table.dtype.type(share))
