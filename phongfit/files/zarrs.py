"""Arrays that may exceed memory: zarr, version 3, on a disk or an object store."""

import contextlib
import hashlib
import importlib.util
import math
import os
import re
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from phongfit.files.budget import afford
from phongfit.files.inputs import reason

if TYPE_CHECKING:
    import zarr

    Array = zarr.Array[Any]
    Group = zarr.Group

IMAGES = "images"
"""Name of the images in a group that has other arrays as well."""

Window = tuple[slice, ...]
"""Ranges along the first axes of an array."""


def require(*names: str) -> None:
    """Check that libraries are installed.

    **Raises:** `ValueError` with the command that installs them.
    """
    missing = [name for name in names if importlib.util.find_spec(name) is None]
    if missing:
        raise ValueError(
            f"{' and '.join(missing)} not installed: pip install 'phongfit[cluster]'"
        )


def is_store(path: Any) -> bool:
    """True if a path or URL ends with .zarr."""
    return isinstance(path, str | os.PathLike) and os.fspath(path).rstrip("/").endswith(
        ".zarr"
    )


def address(path: str | os.PathLike[str]) -> str:
    """The path or URL of a store, in zarr's notation."""
    # Restore the second slash of a URL, which pathlib removes.
    return re.sub(r"^([a-z0-9]{2,}):/(?=[^/])", r"\1://", os.fspath(path))


def is_remote(path: str | os.PathLike[str]) -> bool:
    """True if an address is a URL, of an object store."""
    return "://" in address(path)


@contextlib.contextmanager
def _blaming(path: str, doing: str) -> Iterator[None]:
    """Make errors of zarr or a file system name the store."""
    try:
        yield
    except (MemoryError, KeyboardInterrupt):
        raise
    except OSError as error:
        if isinstance(error, FileNotFoundError) and doing == "read":
            raise ValueError(f"{path}: there is no such zarr array or group") from error
        said = error.strerror or reason(error)
        raise OSError(f"{path}: cannot be {doing}: {said}") from error
    except Exception as error:
        # A broken store makes its reader raise nearly anything.
        raise ValueError(f"{path}: cannot be {doing}: {reason(error)}") from error


def open_array(path: str | os.PathLike[str], name: str = "") -> "Array":
    """Open an array to read.

    **Raises:** `ValueError` that names the store: it is missing, is broken, or has
    chunks above the limit of memory.
    """
    import zarr

    path = address(path)
    inside: Any = {"path": name} if name else {}
    with _blaming(path, "read"):
        array: Any = zarr.open_array(path, mode="r", zarr_format=3, **inside)
        afford(math.prod(array.chunks) * array.dtype.itemsize, "a chunk")
    return array


def open_group(path: str | os.PathLike[str], mode: Any = "r") -> "Group":
    """Open a group to read (`"r"`) or to write (`"r+"`), or make it if needed (`"a"`).

    **Raises:** as [`open_array`][] does; `OSError` if the group cannot be made.
    """
    import zarr

    path = address(path)
    with _blaming(path, "read" if mode == "r" else "written"):
        return zarr.open_group(path, mode=mode, zarr_format=3)


def find_images(path: str | os.PathLike[str]) -> "Array":
    """The images of a store, which is an array, or a group with an array `images`.

    **Raises:** `ValueError` that names the store and the error.
    """
    import zarr

    path = address(path)
    with _blaming(path, "read"):
        node = zarr.open(path, mode="r", zarr_format=3)
    array = open_array(path, "" if isinstance(node, zarr.Array) else IMAGES)
    if array.ndim != 4 or array.shape[-1] != 3 or 0 in array.shape:
        raise ValueError(
            f"{path}: expected images of shape (light, y, x, 3), got {array.shape}"
        )
    if array.dtype not in (np.uint8, np.uint16) and array.dtype.kind != "f":
        raise ValueError(
            f"{path}: expected floats, or whole numbers of 8 or 16 bits without a "
            f"sign, got {array.dtype}"
        )
    return array


def place_of(array: "Array") -> str:
    """Path or URL of an array, for other processes.

    **Raises:** `ValueError` for an array in this process's memory.
    """
    from zarr.storage import FsspecStore, LocalStore

    store = array.store
    if isinstance(store, LocalStore):
        return os.fspath(store.root.resolve() / array.path)
    if isinstance(store, FsspecStore):
        protocol = store.fs.protocol
        protocol = protocol if isinstance(protocol, str) else protocol[0]
        return f"{protocol}://{store.path.strip('/')}/{array.path}".rstrip("/")
    raise ValueError(
        "images: expected an array on a disk or an object store, got one in a "
        f"{type(store).__name__}"
    )


def store_of(array: "Array") -> str:
    """The path or URL of the whole store that contains an array.

    **Raises:** as [`place_of`][] does.
    """
    return place_of(array).removesuffix(array.path).rstrip("/")


def fingerprint(array: "Array") -> str:
    """Checksum of the names, sizes and times or tags of an array's chunks.

    Chunks are not read, since they may be petabytes.
    """
    import fsspec

    path = place_of(array)
    with _blaming(path, "read"):
        files, root = fsspec.url_to_fs(path)
        files.invalidate_cache()
        found = files.find(root, detail=True)
    digest = hashlib.sha256()
    for name in sorted(found):
        entry = found[name]
        stamps = ("ETag", "mtime", "LastModified")
        when = next((entry[stamp] for stamp in stamps if stamp in entry), "")
        digest.update(f"{name.removeprefix(root)} {entry['size']} {when}".encode())
    return digest.hexdigest()


def read_window(array: "Array", window: Window) -> np.ndarray:
    """A part of an array.

    **Raises:** `OSError` or `ValueError` that names the store.
    """
    sides = [len(range(n)[part]) for n, part in zip(array.shape, window, strict=False)]
    count = math.prod((*sides, *array.shape[len(window) :]))
    with _blaming(place_of(array), "read"):
        afford(count * array.dtype.itemsize, f"{' × '.join(map(str, sides))} numbers")
        return np.asarray(array[window])


def cut(array: Any, window: Window) -> np.ndarray:
    """A part of an array in memory, or as [`read_window`][] of one in a store."""
    if hasattr(array, "store"):
        return read_window(array, window)
    return np.asarray(array[window])


def write_window(array: "Array", window: Window, values: np.ndarray) -> None:
    """Write a rectangle of whole chunks.

    **Raises:** `OSError` that names the store.
    """
    with _blaming(place_of(array), "written"):
        array[window] = values


def make_array(
    group: "Group",
    name: str,
    shape: Sequence[int],
    dtype: Any,
    chunks: Sequence[int],
    fill: Any = 0,
    compressed: bool = True,
) -> "Array":
    """Make an array in a group, replacing an existing one.

    **Raises:** `OSError` that names the store.
    """
    from zarr.codecs import BloscCodec

    # Blosc groups the high bytes of numbers, which noise hardly changes: maps take
    # about as much space as with zstd alone, in a quarter of the time.
    compressor = BloscCodec(cname="lz4", clevel=1) if compressed else None
    with _blaming(str(group.store_path), "written"):
        return group.create_array(
            name,
            shape=tuple(shape),
            dtype=dtype,
            chunks=tuple(chunks),
            fill_value=fill,
            compressors=compressor,
            overwrite=True,
            # Write chunks of fill values too: a file marks its chunk as written.
            config={"write_empty_chunks": True},
        )


def keep_array(
    group: "Group", name: str, array: np.ndarray, chunks: Sequence[int]
) -> None:
    """Make an array in a group, and write its values.

    **Arguments:** `chunks`: lengths of a chunk along the first axes.
    """
    chunks = (*chunks, *array.shape[len(chunks) :])
    made = make_array(group, name, array.shape, array.dtype, chunks)
    write_window(made, (slice(None),) * array.ndim, array)


def writable(group: "Group", name: str) -> "Array":
    """An array of a group, opened so that chunks of fill values are written too.

    **Raises:** `ValueError` that names the store, if it lacks the array.
    """
    import zarr

    with _blaming(str(group.store_path), "read"):
        found: Any = group[name]
        if not isinstance(found, zarr.Array):
            raise ValueError(f"expected an array {name}, got a group")
    return found.with_config({"write_empty_chunks": True})


def holds(
    group: "Group", name: str, shape: Sequence[int], dtype: Any, chunks: Sequence[int]
) -> bool:
    """True if a group has a readable array of this shape, type and chunks."""
    try:
        found = writable(group, name)
    except ValueError:
        return False
    made = found.shape, found.chunks, found.dtype
    return made == (tuple(shape), tuple(chunks), np.dtype(dtype))


def attributes(node: "Array | Group") -> dict[str, Any]:
    """Attributes of an array or a group.

    **Raises:** `ValueError` that names the store, if they cannot be read.
    """
    with _blaming(str(node.store_path), "read"):
        return dict(node.attrs)


def write_attributes(group: "Group", values: dict[str, Any]) -> None:
    """Add attributes to a group.

    **Raises:** `OSError` that names the store.
    """
    with _blaming(str(group.store_path), "written"):
        group.update_attributes(values)


def exists(path: str | os.PathLike[str]) -> bool:
    """True if there is anything at a path or URL.

    **Raises:** `OSError` or `ValueError` that names it.
    """
    import fsspec

    path = address(path)
    with _blaming(path, "read"):
        files, root = fsspec.url_to_fs(path)
        files.invalidate_cache()
        return bool(files.exists(root))


def erase(path: str | os.PathLike[str]) -> None:
    """Remove a store and all its contents.

    **Raises:** `OSError` that names the store.
    """
    import fsspec

    path = address(path)
    with _blaming(path, "removed"):
        files, root = fsspec.url_to_fs(path)
        files.rm(root, recursive=True)
