"""NumPy's own files, read without trusting them."""

import io
import math
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from phongfit.files.budget import afford
from phongfit.files.inputs import read_bytes, reason
from phongfit.files.outputs import replacing


def read_array(path: Path, key: str) -> np.ndarray:
    """The array of an `.npy` file, or the one called `key` in an `.npz` file.

    **Raises:** `ValueError` that names the file: it is missing, broken, too large, or
    holds Python objects.
    """
    if path.suffix.lower() not in (".npy", ".npz"):
        raise ValueError(f"{path}: expected suffix .npy or .npz, got {path.suffix!r}")
    data = read_bytes(path)
    try:
        if path.suffix.lower() == ".npy":
            return _array(data)
        arrays = unpack(data)
        if key not in arrays:
            raise ValueError(f"expected an array {key!r}, got {list(arrays)}")
        return arrays[key]
    except MemoryError:
        raise
    except Exception as error:
        # A broken file makes this reader raise nearly anything.
        raise ValueError(f"{path}: cannot be read: {reason(error)}") from error


def unpack(data: bytes) -> dict[str, np.ndarray]:
    """The arrays of an `.npz` file, by their names.

    **Raises:** `ValueError` if they are more than a file may hold, or Python objects;
    `zipfile.BadZipFile` and others for what is broken.
    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = archive.infolist()
        names = [entry.filename.removesuffix(".npy") for entry in entries]
        if len(set(names)) != len(names):
            raise ValueError("expected each array once")
        sizes = [entry.file_size for entry in entries]
        # Each array is in memory twice for a moment: as bytes and as an array.
        afford(len(data) + sum(sizes) + max(sizes, default=0), "arrays")
        contents = _contents(archive, entries)
        return {name: _array(one) for name, one in zip(names, contents, strict=True)}


def _contents(
    archive: zipfile.ZipFile, entries: list[zipfile.ZipInfo]
) -> Iterator[bytes]:
    for entry in entries:
        # NumPy writes only these; other methods need more memory than is checked here.
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError(f"{entry.filename}: is packed in a way of its own")
        with archive.open(entry) as file:
            # Read at most the stated size; one byte more detects a wrong size.
            content = file.read(entry.file_size + 1)
        if len(content) != entry.file_size:
            raise ValueError(f"{entry.filename}: is truncated")
        yield content


def _array(data: bytes) -> np.ndarray:
    """The array of an `.npy` file's bytes."""
    file = io.BytesIO(data)
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(file)
    elif version == (2, 0):
        shape, _, dtype = np.lib.format.read_array_header_2_0(file)
    else:
        raise ValueError(f"expected version 1.0 or 2.0 of .npy, got {version}")
    if dtype.hasobject:
        raise ValueError("expected numbers, got Python objects")
    # The shape in the header may be larger than the file.
    size = math.prod(shape) * dtype.itemsize
    if size > len(data) - file.tell():
        raise ValueError(
            f"expected {size} bytes for shape {shape}, got {len(data) - file.tell()}"
        )
    afford(len(data) + size, f"an array of shape {shape}")
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)


def write_array(path: Path, array: np.ndarray) -> None:
    """Write an `.npy` file, whole or not at all."""
    with replacing(path) as temporary:
        np.save(temporary, array, allow_pickle=False)
