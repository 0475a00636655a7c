"""One array of numbers from a MATLAB file of version 5, as `save` writes it.

SciPy's reader is not used, since a damaged type of an array's numbers makes it end the
process.

??? cite "Source"
    The MathWorks, *MAT-File Format*, version 5 (1996).
"""

import itertools
import zlib
from collections.abc import Iterator

import numpy as np

MATRIX, COMPRESSED = 14, 15
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8"}
NUMBERS |= {12: "i8", 13: "u8"}
# Classes of arrays that hold numbers: double, single and integers.
NUMERIC = range(6, 16)
COMPLEX = 0x800
# Largest size of an array's header, bytes.
HEAD = 4096


def read_matrix(data: bytes, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """The array called `name`, of the given shape.

    **Raises:** `ValueError` if the file lacks such an array or is broken.
    """
    if len(data) < 128 or data[126:128] not in (b"IM", b"MI"):
        raise ValueError("is no MATLAB file of version 5")
    order = "<" if data[126:128] == b"IM" else ">"
    room = HEAD + 8 * int(np.prod(shape))
    for kind, part in _elements(data[128:], order):
        if kind == COMPRESSED:
            try:
                part = zlib.decompressobj().decompress(part, room)
            except zlib.error as error:
                raise ValueError(f"is broken: {error}") from error
            kind, part = _first(1, part, order)[0]
        if kind != MATRIX:
            continue
        found = _numbers(part, name, shape, order)
        if found is not None:
            return found
    raise ValueError(f"{name}: expected numbers of shape {shape}, got none")


def _elements(
    data: bytes, order: str, cut: bool = False
) -> Iterator[tuple[int, bytes]]:
    """Types and bytes of the elements of a file or of an array.

    **Arguments:** `cut`: allow the last element to exceed the data.
    """
    at = 0
    while at + 8 <= len(data):
        kind, size = np.frombuffer(data, f"{order}u4", 2, at).tolist()
        if kind >> 16:
            # Elements of at most 4 bytes: size and type share a word.
            kind, size, first, after = kind & 0xFFFF, kind >> 16, at + 4, at + 8
        else:
            first = at + 8
            after = first + size + (-size % 8 if kind != COMPRESSED else 0)
        if first + size > len(data) and not cut:
            raise ValueError("is broken: a part is larger than the file")
        yield kind, data[first : first + size]
        at = after


def _first(count: int, data: bytes, order: str) -> list[tuple[int, bytes]]:
    found = list(itertools.islice(_elements(data, order, cut=True), count))
    if len(found) < count:
        raise ValueError("is broken: a part is missing")
    return found


def _numbers(
    part: bytes, name: str, shape: tuple[int, ...], order: str
) -> np.ndarray | None:
    """The numbers of an array, or `None` if it has another name."""
    (_, flags), (_, dims), (_, own) = _first(3, part, order)
    if own.decode("latin-1") != name:
        return None
    kind, data = _first(4, part, order)[-1]
    flags = int(np.frombuffer(flags, f"{order}u4", 1)[0])
    found = tuple(np.frombuffer(dims, f"{order}i4").tolist())
    numeric = flags & 0xFF in NUMERIC and not flags & COMPLEX
    if found != shape or not numeric:
        got = f"{found}" if numeric else "no real numbers"
        raise ValueError(f"{name}: expected numbers of shape {shape}, got {got}")
    if kind not in NUMBERS:
        raise ValueError(f"{name}: is broken: its numbers are of no known type")
    values = np.frombuffer(data, f"{order}{NUMBERS[kind]}")
    if values.size != np.prod(shape):
        raise ValueError(
            f"{name}: expected {np.prod(shape)} numbers, got {values.size}"
        )
    return values.reshape(shape, order="F").astype(float)
