"""Arrays that no memory need hold: zarr's, version 3, on a disk or an object store.

With zarr and fsspec, which `phongfit[cluster]` brings.
"""

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
"""Of a group that holds more than the images."""

Window = tuple[slice, ...]
"""Rows and columns."""


def require(*names: str) -> None:
    """Are these libraries installed?

    **Raises:** `ValueError` that says how they would be.
    """
    missing = [name for name in names if importlib.util.find_spec(name) is None]
    if missing:
        raise ValueError(
            f"{' and '.join(missing)} not installed: pip install 'phongfit[cluster]'"
        )


def is_store(path: Any) -> bool:
    """Whether a path or address is that of zarr's arrays, by its end."""
    return isinstance(path, str | os.PathLike) and os.fspath(path).rstrip("/").endswith(
        ".zarr"
    )


def address(path: str | os.PathLike[str]) -> str:
    """The path or the URL of a store as zarr takes it."""
    # A path makes one slash of a URL's two.
    return re.sub(r"^([a-z0-9]{2,}):/(?=[^/])", r"\1://", os.fspath(path))


def is_remote(path: str | os.PathLike[str]) -> bool:
    """Whether an address is that of an object store."""
    return "://" in address(path)


@contextlib.contextmanager
def _blaming(path: str, doing: str) -> Iterator[None]:
    """Say of which store it is that zarr or a file system complains."""
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
    """An array to read.

    **Raises:** `ValueError` that names the store: it is missing, broken, has chunks
    larger than may be read at all, or zarr is not installed.
    """
    require("zarr", "fsspec")
    import zarr

    path = address(path)
    inside: Any = {"path": name} if name else {}
    with _blaming(path, "read"):
        array: Any = zarr.open_array(path, mode="r", zarr_format=3, **inside)
        afford(math.prod(array.chunks) * array.dtype.itemsize, "a chunk")
    return array


def open_group(path: str | os.PathLike[str], mode: Any = "r") -> "Group":
    """A group, to read (`"r"`), to write to (`"r+"`), or one that is made (`"a"`).

    **Raises:** as [`open_array`][] does; `OSError` if it cannot be made.
    """
    require("zarr", "fsspec")
    import zarr

    path = address(path)
    with _blaming(path, "read" if mode == "r" else "written"):
        return zarr.open_group(path, mode=mode, zarr_format=3)


def find_images(path: str | os.PathLike[str]) -> "Array":
    """The images of a store: it is an array itself, or a group with `images`.

    **Raises:** `ValueError` that names the store, and what is wrong with it.
    """
    require("zarr", "fsspec")
    import zarr

    with _blaming(address(path), "read"):
        node = zarr.open(address(path), mode="r", zarr_format=3)
    found = open_array(path, "" if isinstance(node, zarr.Array) else IMAGES)
    check_images(found, address(path))
    return found


def check_images(array: "Array", path: str) -> None:
    """Are these images?

    **Raises:** `ValueError` that says what was expected.
    """
    if array.ndim != 4 or array.shape[-1] != 3 or 0 in array.shape:
        raise ValueError(
            f"{path}: expected images of shape (light, y, x, 3), got {array.shape}"
        )
    if array.dtype not in (np.uint8, np.uint16) and array.dtype.kind != "f":
        raise ValueError(
            f"{path}: expected floats, or whole numbers of 8 or 16 bits without a "
            f"sign, got {array.dtype}"
        )


def place_of(array: "Array") -> str:
    """Where other processes find an array: its path or URL.

    **Raises:** `ValueError` for one that is in this process's memory.
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
    """The path or URL of the store that an array is in, whole.

    **Raises:** as [`place_of`][] does.
    """
    return place_of(array).removesuffix(array.path).rstrip("/")


def fingerprint(array: "Array") -> str:
    """Of an array, by the names, sizes and times or tags of its chunks.

    Without reading them: there may be petabytes.
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


def read_window(
    array: "Array", window: Window, size: tuple[int, int], first: int = 0
) -> np.ndarray:
    """A rectangle of an array, with zeros where it reaches beyond its edges.

    **Arguments:**

    - `window`: rows and columns.
    - `size`: of what is given back, pixels.
    - `first`: axes before those of rows and columns.

    **Raises:** `OSError` or `ValueError` that names the store.
    """
    count = math.prod((*array.shape[:first], *size, *array.shape[first + 2 :]))
    with _blaming(place_of(array), "read"):
        afford(count * array.dtype.itemsize, f"{size[0]} × {size[1]} pixels")
        part = np.asarray(array[(*[slice(None)] * first, *window)])
    rows, columns = part.shape[first : first + 2]
    if (rows, columns) == size:
        return part
    whole = np.zeros((*part.shape[:first], *size, *part.shape[first + 2 :]), part.dtype)
    whole[(*[slice(None)] * first, slice(rows), slice(columns))] = part
    return whole


def write_window(array: "Array", window: Window, values: np.ndarray) -> None:
    """Write a rectangle, of which chunks are whole.

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
    """An array in a group, which takes the place of one that is there.

    **Raises:** `OSError` that names the store.
    """
    from zarr.codecs import BloscCodec

    # It puts the high bytes of numbers together, of which noise changes few: maps take
    # about as much room as by zstd alone, in a quarter of the time.
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
            # Whatever a chunk holds, its file shows that it was written.
            config={"write_empty_chunks": True},
        )


def keep_array(
    group: "Group", name: str, array: np.ndarray, chunk: tuple[int, int]
) -> None:
    """An array of rows and columns, written as a whole."""
    chunks = (*chunk, *array.shape[2:])
    made = make_array(group, name, array.shape, array.dtype, chunks)
    write_window(made, (slice(None), slice(None)), array)


def writable(group: "Group", name: str) -> "Array":
    """An array of a group, whose chunks are written whatever they hold.

    **Raises:** `ValueError` that names the store, if it has no such array.
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
    """Whether a group has such an array, which can be read."""
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
    """Attributes of a group, besides those that it has.

    **Raises:** `OSError` that names the store.
    """
    with _blaming(str(group.store_path), "written"):
        group.update_attributes(values)


def erase(path: str | os.PathLike[str]) -> None:
    """Remove a store and all that is in it.

    **Raises:** `OSError` that names the store.
    """
    import fsspec

    path = address(path)
    with _blaming(path, "removed"):
        files, root = fsspec.url_to_fs(path)
        files.rm(root, recursive=True)
