"""Tags of TIFF, the format that also holds EXIF data and many RAW files.

??? cite "Source"
    *TIFF, revision 6.0*, Adobe, 1992, section 2; BigTIFF, Aware Systems, 2008;
    CIPA DC-008, *Exif 2.32*, 2019.
"""

import struct
from collections.abc import Iterator
from typing import NamedTuple

# Types of whole numbers and of ratios, as codes of struct.
_WHOLE = {1: "B", 3: "H", 4: "I", 6: "b", 8: "h", 9: "i", 16: "Q", 17: "q"}
_RATIOS = {5: "II", 10: "ii"}
_BYTES = (1, 2, 7)

MOST = 64
"""Maximum number of pictures read from a file: a hostile one may refer to itself."""


class Directory(NamedTuple):
    """A directory of tags, whose values are read on access.

    - `data`: the whole file.
    - `order`, `offset`: codes of struct for its byte order and its offsets.
    - `entries`: for each tag its type, its number of values, and the position of its
        values or of a pointer to them.
    - `following`: position of the next picture's directory; 0 after the last.
    """

    data: bytes
    order: str
    offset: str
    entries: dict[int, tuple[int, int, int]]
    following: int = 0

    def whole(self, tag: int, default: int = 0) -> int:
        """The largest of a tag's whole numbers, or `default` if it has none."""
        kind, count, _ = self.entries.get(tag, (0, 0, 0))
        if kind not in _WHOLE or count == 0:
            return default
        # At most four values, one for each channel, are needed.
        several = f"{self.order}{min(count, 4)}{_WHOLE[kind]}"
        return max(struct.unpack_from(several, self.data, self._place(tag)))

    def ratio(self, tag: int) -> float | None:
        """A tag's ratio of whole numbers, such as 1/60; `None` if it has none."""
        kind, count, _ = self.entries.get(tag, (0, 0, 0))
        if kind not in _RATIOS or count == 0:
            return None
        pair = self.order + _RATIOS[kind]
        above, below = struct.unpack_from(pair, self.data, self._place(tag))
        return above / below if below else None

    def content(self, tag: int) -> bytes | None:
        """A tag's bytes, as in the file; `None` if it has none."""
        kind, count, _ = self.entries.get(tag, (0, 0, 0))
        if kind not in _BYTES or count == 0:
            return None
        at = self._place(tag)
        if at + count > len(self.data):
            raise ValueError(f"tag {tag} lies beyond the end of the file")
        return self.data[at : at + count]

    def below(self, tag: int) -> "Directory":
        """The directory that a tag points to; an empty one without the tag."""
        start = self.whole(tag)
        if not start:
            return self._replace(entries={})
        return _directory(self.data, self.order, self.offset, start)

    def others(self) -> "Iterator[Directory]":
        """The directories of the next pictures in the file, at most 64."""
        directory = self
        for _ in range(MOST):
            if not directory.following:
                return
            place = directory.following
            directory = _directory(self.data, self.order, self.offset, place)
            yield directory

    def _place(self, tag: int) -> int:
        """Position of a tag's values: in the entry if they fit, else elsewhere."""
        kind, count, where = self.entries[tag]
        each = struct.calcsize(self.order + (_WHOLE | _RATIOS).get(kind, "B"))
        pointer = self.order + self.offset
        if each * count <= struct.calcsize(pointer):
            return where
        return struct.unpack_from(pointer, self.data, where)[0]


def first_directory(data: bytes) -> Directory:
    """The tags of a file's first picture.

    **Raises:** `ValueError` or `struct.error` if the data is not a TIFF.
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
            # An error, since readers differ in the one that they use.
            raise ValueError(f"it has tag {tag} twice")
        entries[tag] = kind, length, at + struct.calcsize(head)
    end, following = start + count * size, 0
    if end + struct.calcsize(order + offset) <= len(data):
        (following,) = struct.unpack_from(order + offset, data, end)
    return Directory(data, order, offset, entries, following)
