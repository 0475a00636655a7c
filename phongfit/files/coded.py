"""Light as files store it: whole numbers, and a table with the light of each number.

An image of 8 bits takes a quarter of the memory that its light takes. It is decoded
where light is needed, a few samples at a time.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Shaped

PIECE = 2**20
"""Samples that are looked up at a time: NumPy copies their numbers, 8 bytes each."""


class Coded(NamedTuple):
    """Linear light, or encoded numbers with a table that decodes them.

    - `numbers`: light itself, or whole numbers ≥ 0; a NumPy masked array if some may
        not be used.
    - `table`: the light of each whole number, with a row for each item of the first
        axis of `numbers` if tables differ. `None` if `numbers` is light itself.
    """

    numbers: Shaped[np.ndarray, "..."]
    table: Float[np.ndarray, "*images levels"] | None = None

    @property
    def light(self) -> Float[np.ndarray, "..."]:
        """The decoded light; a masked array, with zeros, if some may not be used."""
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
        """The light multiplied by a factor."""
        if self.table is None:
            return Coded(self.numbers * self.numbers.dtype.type(share))
        return Coded(self.numbers, self.table * self.table.dtype.type(share))
