"""Damage to the bytes of a file, as disks, networks and attackers do it."""

import numpy as np

# Numbers that readers stumble over, little and big end first.
EDGES = [0, 1, 127, 128, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1]


def damaged(random: np.random.Generator, data: bytes) -> tuple[str, bytes]:
    """Data with a random damage, and its name."""
    kind = str(random.choice(list(_DAMAGES)))
    return kind, _DAMAGES[kind](random, data)


def _at(random: np.random.Generator, data: bytes) -> int:
    """A place, more often near the start, where the header is."""
    end = len(data) if random.random() < 0.5 else min(len(data), 256)
    return int(random.integers(0, max(end, 1)))


def _flipped(random: np.random.Generator, data: bytes) -> bytes:
    changed = bytearray(data)
    for _ in range(int(random.integers(1, 4))):
        if changed:
            changed[_at(random, data)] ^= 1 << int(random.integers(8))
    return bytes(changed)


def _noisy(random: np.random.Generator, data: bytes) -> bytes:
    at, length = _at(random, data), int(random.integers(1, 64))
    return data[:at] + random.bytes(length) + data[at + length :]


def _edged(random: np.random.Generator, data: bytes) -> bytes:
    size = int(random.choice([1, 2, 4, 8]))
    number = int(random.choice(EDGES)) % 2 ** (8 * size)
    order = "little" if random.random() < 0.5 else "big"
    at = _at(random, data)
    return data[:at] + number.to_bytes(size, order) + data[at + size :]


def _cut(random: np.random.Generator, data: bytes) -> bytes:
    return data[: int(random.integers(0, len(data) + 1))]


def _holed(random: np.random.Generator, data: bytes) -> bytes:
    at, length = _at(random, data), int(random.integers(1, 64))
    return data[:at] + data[at + length :]


def _doubled(random: np.random.Generator, data: bytes) -> bytes:
    at, length = _at(random, data), int(random.integers(1, 512))
    return data[:at] + 2 * data[at : at + length] + data[at + length :]


def _zeroed(random: np.random.Generator, data: bytes) -> bytes:
    at, length = _at(random, data), int(random.integers(1, 4096))
    blank = bytes(min(length, len(data) - at))
    return data[:at] + blank + data[at + len(blank) :]


def _longer(random: np.random.Generator, data: bytes) -> bytes:
    return data + random.bytes(int(random.integers(1, 4096)))


def _swapped(random: np.random.Generator, data: bytes) -> bytes:
    one, two = sorted(_at(random, data) for _ in range(2))
    return data[:one] + data[two:] + data[one:two]


def _none(random: np.random.Generator, data: bytes) -> bytes:
    del random
    return data


_DAMAGES = {
    "bits flipped": _flipped,
    "bytes of noise": _noisy,
    "an extreme number": _edged,
    "cut off": _cut,
    "a hole": _holed,
    "a piece twice": _doubled,
    "zeros": _zeroed,
    "more at the end": _longer,
    "pieces swapped": _swapped,
    "no damage": _none,
}
