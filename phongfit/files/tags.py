"""Tags of TIFF, which EXIF and many RAW files are written in as well.

??? cite "Source"
    *TIFF, revision 6.0*, Adobe, 1992, section 2; BigTIFF, Aware Systems, 2008;
    CIPA DC-008, *Exif 2.32*, 2019.
"""

import struct
from collections.abc import Iterator
from typing import NamedTuple

# Types of whole numbers and of ratios, as struct spells them.
_WHOLE = {1: "B", 3: "H", 4: "I", 6: "b", 8: "h", 9: "i", 16: "Q", 17: "q"}
_RATIOS = {5: "II", 10: "ii"}
_BYTES = (1, 2, 7)

MOST = 64
"""Pictures of a file that are looked at: a hostile one may refer to itself."""


class Directory(NamedTuple):
    """A list of tags. Values are looked up when they are asked for.

    - `data`: the whole file.
    - `order`, `offset`: how struct spells its byte order and its offsets.
    - `entries`: of each tag its type, how many values it has, and where these stand.
    - `following`: where the next picture's list stands; 0 after the last.
    """

    data: bytes
    order: str
    offset: str
    entries: dict[int, tuple[int, int, int]]
    following: int = 0

    def whole(self, tag: int, default: int = 0) -> int:
        """A whole number; of several the largest."""
        kind, count, _ = self.entries.get(tag, (0, 0, 0))
        if kind not in _WHOLE or count == 0:
            return default
        # As many as a pixel may have channels: others are of no interest here.
        several = f"{self.order}{min(count, 4)}{_WHOLE[kind]}"
        return max(struct.unpack_from(several, self.data, self._place(tag)))

    def ratio(self, tag: int) -> float | None:
        """A ratio of whole numbers, such as 1/60; `None` where it states none."""
        kind, count, _ = self.entries.get(tag, (0, 0, 0))
        if kind not in _RATIOS or count == 0:
            return None
        pair = self.order + _RATIOS[kind]
        above, below = struct.unpack_from(pair, self.data, self._place(tag))
        return above / below if below else None

    def content(self, tag: int) -> bytes | None:
        """Bytes as they stand in the file; `None` where there are none."""
        kind, count, _ = self.entries.get(tag, (0, 0, 0))
        if kind not in _BYTES or count == 0:
            return None
        at = self._place(tag)
        if at + count > len(self.data):
            raise ValueError(f"tag {tag} lies beyond the end of the file")
        return self.data[at : at + count]

    def below(self, tag: int) -> "Directory | None":
        """The directory that a tag points to."""
        start = self.whole(tag)
        return _directory(self.data, self.order, self.offset, start) if start else None

    def others(self) -> "Iterator[Directory]":
        """The directories of the next pictures in the file, 64 of them at most."""
        directory = self
        for _ in range(MOST):
            if not directory.following:
                return
            place = directory.following
            directory = _directory(self.data, self.order, self.offset, place)
            yield directory

    def _place(self, tag: int) -> int:
        """Where values stand: in the entry, where they fit."""
        kind, count, where = self.entries[tag]
        each = struct.calcsize(self.order + (_WHOLE | _RATIOS).get(kind, "B"))
        pointer = self.order + self.offset
        if each * count <= struct.calcsize(pointer):
            return where
        return struct.unpack_from(pointer, self.data, where)[0]


def first_directory(data: bytes) -> Directory:
    """The tags of a file's first picture.

    **Raises:** `ValueError` or `struct.error` for what is no TIFF.
    """
    if data[:4] not in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        raise ValueError("it does not start as a TIFF does")
    order = "<" if data[:2] == b"II" else ">"
    (version,) = struct.unpack_from(order + "H", data, 2)
    offset = "I" if version == 42 else "Q"
    (start,) = struct.unpack_from(order + offset, data, 4 if version == 42 else 8)
    return _directory(data, order, offset, start)


def _directory(data: bytes, order: str, offset: str, start: int) -> Directory:
    number = "H" if offset == "I" else "Q"
    (count,) = struct.unpack_from(order + number, data, start)
    start += struct.calcsize(order + number)
    head = order + "HH" + offset
    size = struct.calcsize(head) + struct.calcsize(order + offset)
    entries: dict[int, tuple[int, int, int]] = {}
    for at in range(start, min(start + count * size, len(data)), size):
        tag, kind, length = struct.unpack_from(head, data, at)
        if tag in entries:
            # Readers differ in which of them they believe.
            raise ValueError(f"it has tag {tag} twice")
        entries[tag] = kind, length, at + struct.calcsize(head)
    end, following = start + count * size, 0
    if end + struct.calcsize(order + offset) <= len(data):
        (following,) = struct.unpack_from(order + offset, data, end)
    return Directory(data, order, offset, entries, following)
