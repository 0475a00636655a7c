"""NumPy's own files, read without trusting them."""

import zipfile
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.lib.npyio import NpzFile

from phongfit.files.inputs import MAX_BYTES, read_bytes
from phongfit.files.outputs import replacing


def read_array(path: Path, key: str) -> np.ndarray:
    """The array of an `.npy` file, or the one called `key` in an `.npz` file.

    **Raises:** `ValueError` that names the file: it is missing, broken, too large, or
    holds Python objects.
    """
    if path.suffix.lower() not in (".npy", ".npz"):
        raise ValueError(f"{path}: expected suffix .npy or .npz, got {path.suffix!r}")
    read_bytes(path)
    try:
        if path.suffix.lower() == ".npy":
            # Mapped first: a header may promise more numbers than the file has.
            return np.array(np.load(path, mmap_mode="r", allow_pickle=False))
        return _from_archive(path, key)
    except Exception as error:
        # A broken file makes this reader raise nearly anything.
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{path}: cannot be read: {reason}") from error


def _from_archive(path: Path, key: str) -> np.ndarray:
    with open_archive(path) as arrays:
        if key not in arrays:
            raise ValueError(f"expected an array {key!r}, got {list(arrays)}")
        return arrays[key]


def open_archive(file: Path | BinaryIO) -> NpzFile:
    """The arrays of an `.npz` file, none of them Python objects.

    **Raises:** `ValueError` if they are more than a file may hold; whatever NumPy's
    reader raises for a broken one.
    """
    with zipfile.ZipFile(file) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
    if size > MAX_BYTES:
        raise ValueError(f"expected at most {MAX_BYTES} bytes unpacked, got {size}")
    if not isinstance(file, Path):
        file.seek(0)
    return np.load(file, allow_pickle=False)


def write_array(path: Path, array: np.ndarray) -> None:
    """Write an `.npy` file, in one piece."""
    with replacing(path) as temporary:
        np.save(temporary, array, allow_pickle=False)
