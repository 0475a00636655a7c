"""Stacks of images, read piece by piece, so that they need not fit into memory."""

import abc
import copy
import dataclasses
import hashlib
import mmap
import os
import threading
from collections.abc import Callable, Iterable, Sequence
from typing import Any, final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from phongfit.checks import as_array
from phongfit.edge import checked
from phongfit.files.coded import Coded
from phongfit.files.dataset import Photographs
from phongfit.files.images import level_table
from phongfit.files.inputs import naming
from phongfit.files.photographs import open_photographs
from phongfit.files.zarrs import (
    Window,
    address,
    attributes,
    find_images,
    fingerprint,
    place_of,
    read_window,
)
from phongfit.maps.spool import UsedImage, spooled
from phongfit.rendering.film import Encoding, as_encoding
from phongfit.scene import Scene

Update = Callable[[bytes | memoryview], None]

READING = threading.RLock()
"""Held while samples are read: stacks of users may seek in an open file."""


class AbstractStack(abc.ABC):
    """Images of one size, of which some pixels are read at a time."""

    @property
    @abc.abstractmethod
    def shape(self) -> tuple[int, int, int]:
        """Number of images, height, width."""

    @abc.abstractmethod
    def take(
        self, pixels: Int[np.ndarray, " n"], order: Sequence[int]
    ) -> Float[np.ndarray, "images n 3"]:
        """Linear light of some pixels in all images.

        Fits of maps call this from several threads, but never from two at once.

        **Arguments:**

        - `pixels`: flat indices, row by row, rising.
        - `order`: numbers of the images, in the order of the result.

        **Returns:** an array; a masked array if some samples may not be used.

        **Raises:** `ValueError` that names the file that is missing or broken.
        """

    def take_coded(self, pixels: Int[np.ndarray, " n"], order: Sequence[int]) -> Coded:
        """Samples as stored: with a table of their light if they are whole numbers."""
        return Coded(self.take(pixels, order))

    @property
    def itemsize(self) -> int:
        """Bytes of a stored sample."""
        return _float_type().itemsize

    @abc.abstractmethod
    def identify(self, update: Update) -> None:
        """Feed the content of the images to a checksum."""


class AbstractCodedStack(AbstractStack):
    """Images that are read as stored, and decoded to light on request."""

    def take(
        self, pixels: Int[np.ndarray, " n"], order: Sequence[int]
    ) -> Float[np.ndarray, "images n 3"]:
        return self.take_coded(pixels, order).light

    @abc.abstractmethod
    def take_coded(
        self, pixels: Int[np.ndarray, " n"], order: Sequence[int]
    ) -> Coded: ...


class AbstractArrays(AbstractCodedStack):
    """Images as arrays, in memory or mapped to memory from a file."""

    _images: tuple[UsedImage, ...]
    _table: np.ndarray | None

    def _keep(self, images: Iterable[UsedImage]) -> None:
        self._images = tuple(images)
        self._table = _common_table([image.coded for image in self._images])

    @property
    def shape(self) -> tuple[int, int, int]:
        height, width, _ = self._images[0].coded.numbers.shape
        return len(self._images), height, width

    @property
    def _dtype(self) -> np.dtype:
        first = self._images[0].coded.numbers.dtype
        return _float_type() if self._table is None else first

    @property
    def itemsize(self) -> int:
        return self._dtype.itemsize

    def take_coded(self, pixels: Int[np.ndarray, " n"], order: Sequence[int]) -> Coded:
        taken = np.empty((len(order), len(pixels), 3), self._dtype)
        hidden = np.zeros(taken.shape, bool)
        for row, k in enumerate(order):
            (numbers, table), used = self._images[k]
            numbers = gather(numbers, pixels)
            if table is not None and self._table is None:
                numbers = table[numbers]
            taken[row] = numbers
            if used is not None:
                used = used.reshape(*used.shape[:2], -1)
                hidden[row] = ~gather(used, pixels)
        for image in self._images:
            _let_go(image.coded.numbers)
        table = self._table
        if table is not None and table.ndim == 2:
            table = table[list(order)]
        if not hidden.any():
            return Coded(taken, table)
        # Finite values remain: a clipped sample is a lower bound of the light.
        taken[hidden & ~np.isfinite(taken)] = 0
        return Coded(np.ma.MaskedArray(taken, hidden), table)

    def identify(self, update: Update) -> None:
        for (numbers, table), used in self._images:
            for array in (numbers, table, used):
                if array is None:
                    continue
                update(f"{array.dtype.str} {array.shape}".encode())
                # Rows of an image, since a copy may be needed; a table at once.
                for row in np.atleast_2d(array):
                    update(np.ascontiguousarray(row).data.cast("B"))
            _let_go(numbers)


def _common_table(images: Sequence[Coded]) -> np.ndarray | None:
    """The table of all images, or a row for each; `None` if they are read as light.

    Light is also read if whole numbers have different types, or 16 bits and different
    tables, which would be larger than the images of most tiles.
    """
    first = images[0]
    kind, tables = first.numbers.dtype, []
    for numbers, table in images:
        if table is None or numbers.dtype != kind:
            return None
        tables.append(table)
    if all(np.array_equal(table, tables[0]) for table in tables):
        return tables[0]
    return np.stack(tables) if kind.itemsize == 1 else None


class ArrayStack(AbstractArrays):
    """Arrays, in memory or memory-mapped (`np.load(path, mmap_mode="r")`)."""

    def __init__(self, images: Any):
        """**Arguments:** `images`: (L, H, W, 3), or a sequence of (H, W, 3): floats. Or
        [`Coded`][] images, (L, H, W, 3).

        **Raises:** `ValueError` that names the image: not floats, or another shape.
        """
        if isinstance(images, Coded):
            numbers, table = images
            tables = (
                [table] * len(numbers) if table is None or table.ndim == 1 else table
            )
            self._keep(map(_unmasked, numbers, tables))
            return
        if not isinstance(images, np.ndarray) or not images.ndim:
            try:
                images = list(images)
            except Exception as error:
                raise ValueError("images: expected a sequence of images") from error
        arrays = [
            image if isinstance(image, np.ndarray) else as_array(f"images[{k}]", image)
            for k, image in enumerate(images)
        ]
        if not arrays:
            raise ValueError("images: expected at least one, got none")
        first = arrays[0].shape
        for k, array in enumerate(arrays):
            if array.dtype.kind != "f":
                raise ValueError(
                    f"images[{k}]: expected linear light as floats, where white is 1 "
                    f"(see read_image), got {array.dtype}"
                )
            if array.ndim != 3 or array.shape[-1] != 3 or 0 in array.shape:
                raise ValueError(
                    f"images[{k}]: expected shape (height, width, 3), got {array.shape}"
                )
            if array.shape != first:
                raise ValueError(
                    f"images[{k}]: expected shape {first}, as of images[0], got "
                    f"{array.shape}"
                )
        self._keep(_unmasked(array, None) for array in arrays)


def _unmasked(numbers: np.ndarray, table: np.ndarray | None) -> UsedImage:
    used = ~np.ma.getmaskarray(numbers) if np.ma.is_masked(numbers) else None
    return UsedImage(Coded(np.ma.getdata(numbers), table), used)


@final
class PhotographStack(AbstractArrays):
    """Image files as a stack of photographs, each decoded once, to a temporary file.

    If their exposures differ, all are scaled to the shortest exposure, samples clipped
    at white are masked, and `notes` has a message about it.
    """

    @checked
    def __init__(
        self,
        paths: Sequence[str | os.PathLike[str]],
        encoding: Encoding,
        *,
        white: int | None = None,
    ):
        """**Arguments:**

        - `paths`: one file for each image.
        - `encoding`, `white`: see [`read_image`][].

        **Raises:** `ValueError` that names the file that cannot be read, has another
        size, or has no exposure while others have one.
        """
        series = open_photographs(paths, encoding, white=white)
        relative = series.relative_exposures
        shares = relative.min() / relative
        self.notes = series.notes

        def scaled(number: int) -> UsedImage:
            photo = series.read(number)
            if (shares == 1).all():
                return UsedImage(photo.coded, photo.usable)
            return UsedImage(photo.coded.times(shares[number]), photo.unsaturated)

        self._keep(spooled(scaled, len(series)))


@final
class DatasetStack(AbstractArrays):
    """A data set's photographs, each decoded once: see [`open_dataset`][].

    Samples that the data set leaves out are masked. `mask` is true for pixels with at
    least one sample: if it is given to [`fit_maps`][], the others count as outside.

        data = pf.open_dataset("ballPNG")
        stack = pf.DatasetStack(data)
        maps = pf.fit_maps(data.scenes, stack, mask=stack.mask, film=data.film)
    """

    @checked
    def __init__(self, photographs: Photographs):
        """**Arguments:** `photographs`: a data set, of which each file is read once.

        **Raises:** `ValueError` that names the file that is missing or wrong.
        """
        camera = photographs.scenes[0].camera
        self.photographs = photographs
        self.mask = np.zeros((camera.height, camera.width), bool)

        def read(number: int) -> UsedImage:
            return UsedImage(*photographs.read(number))

        self._keep(spooled(read, len(photographs.names)))
        for _, used in self._images:
            # Without a mask every sample may be used.
            shape = (*self.mask.shape, -1)
            self.mask |= True if used is None else used.reshape(shape).any(axis=-1)

    def with_scenes(self, scenes: Sequence[Scene]) -> "DatasetStack":
        """The stack with other scenes, without decoding the photographs again."""
        other = copy.copy(self)
        other.photographs = dataclasses.replace(self.photographs, scenes=tuple(scenes))
        return other


@final
class KeptStack(AbstractCodedStack):
    """A stack that keeps the samples of all requests in memory."""

    def __init__(self, stack: AbstractStack):
        """**Arguments:** `stack`: a stack of which few pixels are read, repeatedly."""
        self._stack = stack
        self._taken: dict[tuple[bytes, tuple[int, ...]], Coded] = {}

    @property
    def shape(self) -> tuple[int, int, int]:
        return self._stack.shape

    def take_coded(self, pixels: Int[np.ndarray, " n"], order: Sequence[int]) -> Coded:
        asked = pixels.tobytes(), tuple(order)
        if asked not in self._taken:
            self._taken[asked] = self._stack.take_coded(pixels, order)
        return self._taken[asked]

    def identify(self, update: Update) -> None:
        self._stack.identify(update)


@final
class ZarrStack(AbstractCodedStack):
    """Images of a zarr array, version 3, on a disk or an object store.

    Its shape is (light, y, x, 3), of linear floats where white is 1, or whole numbers
    of 8 or 16 bits in an encoding. Chunks or shards may have any shape; the pixels of
    one are read together.

        stack = pf.ZarrStack("dome/stack.zarr")
        stack = pf.ZarrStack("s3://museum/vase.zarr")
    """

    @checked
    def __init__(self, path: str | os.PathLike[str], encoding: Encoding | None = None):
        """**Arguments:**

        - `path`: path or fsspec URL of the array, or of a group in which it is called
            `images`.
        - `encoding`: default the attribute `encoding` of the array, else `"linear"`.

        **Raises:** `ValueError` that names the store and its fault.
        """
        self.array = find_images(path)
        told = attributes(self.array).get("encoding", "linear")
        with naming(address(path)):
            self.encoding: Encoding = as_encoding(
                told if encoding is None else encoding
            )
            if self.array.dtype.kind == "f" and self.encoding != "linear":
                raise ValueError(
                    f"encoding: expected 'linear', as floats are, got {self.encoding!r}"
                )

    def __reduce__(self) -> Any:
        # Workers open the store themselves.
        return ZarrStack, (place_of(self.array), self.encoding)

    @property
    def shape(self) -> tuple[int, int, int]:
        count, height, width, _ = self.array.shape
        return count, height, width

    def read_coded(self, window: Window) -> Coded:
        """Rows and columns of all images as stored."""
        numbers = read_window(self.array, (slice(None), *window))
        if numbers.dtype.kind == "f":
            light = numbers.astype(_float_type(), copy=False)
            if not np.isfinite(light).all():
                raise ValueError(f"{place_of(self.array)}: has NaN or infinite pixels")
            return Coded(light)
        return Coded(numbers, level_table(numbers.dtype, self.encoding))

    def take_coded(self, pixels: Int[np.ndarray, " n"], order: Sequence[int]) -> Coded:
        width = self.array.shape[2]
        first, last = int(pixels[0]) // width, int(pixels[-1]) // width + 1
        rows = ArrayStack(self.read_coded((slice(first, last), slice(width))))
        return rows.take_coded(pixels - first * width, order)

    @property
    def itemsize(self) -> int:
        whole = self.array.dtype.kind != "f"
        return self.array.dtype.itemsize if whole else _float_type().itemsize

    def identify(self, update: Update) -> None:
        update(f"{fingerprint(self.array)} {self.encoding}".encode())


def as_stack(images: Any) -> AbstractStack:
    """Stack of `images`: a stack, a zarr store or arrays; else `ValueError`."""
    if isinstance(images, str | os.PathLike):
        return ZarrStack(images)
    return images if isinstance(images, AbstractStack) else ArrayStack(images)


def identify_stack(stack: AbstractStack) -> str:
    """Checksum of the content of the images."""
    checksum = hashlib.blake2b(digest_size=16)
    stack.identify(checksum.update)
    return checksum.hexdigest()


def read_rectangle(stack: AbstractStack, window: Window) -> Coded:
    """Rows and columns of all images: (L, H, W, 3)."""
    if isinstance(stack, ZarrStack):
        return stack.read_coded(window)
    count, height, width = stack.shape
    rows, columns = (
        np.arange(n)[w] for n, w in zip((height, width), window, strict=True)
    )
    pixels = np.add.outer(width * rows, columns)
    numbers, table = take_alone(stack, pixels.ravel(), range(count))
    return Coded(numbers.reshape(count, *pixels.shape, 3), table)


def take_alone(
    stack: AbstractStack, pixels: Int[np.ndarray, " n"], order: Sequence[int]
) -> Coded:
    """Samples as stored, read while no other thread reads."""
    with READING:
        return stack.take_coded(pixels, order)


def gather(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Some pixels of an image, by their flat indices, row by row."""
    height, width = image.shape[:2]
    if image.flags.c_contiguous:
        return image.reshape(height * width, -1)[as_index(pixels)]
    return image[pixels // width, pixels % width]


def as_index(pixels: np.ndarray) -> np.ndarray | slice:
    """Index of some pixels: a slice if they are consecutive, which is faster."""
    if len(pixels) and pixels[-1] - pixels[0] + 1 == len(pixels):
        return slice(pixels[0], pixels[-1] + 1)
    return pixels


def _let_go(array: np.ndarray) -> None:
    """Drop the pages of a memory-mapped array from memory; they can be read again."""
    mapping = _mapping(array)
    if mapping is not None and hasattr(mmap, "MADV_DONTNEED"):
        mapping.madvise(mmap.MADV_DONTNEED)


def _mapping(array: np.ndarray) -> mmap.mmap | None:
    """The memory map that an array is a view of, if its pages can be read again.

    `None` for maps that may be private, whose pages would come back without changes.
    """
    base: Any = array
    shared = False
    while isinstance(base, np.ndarray | memoryview):
        shared |= isinstance(base, np.memmap) and base.mode in ("r", "r+")
        base = base.base if isinstance(base, np.ndarray) else base.obj
    return base if shared and isinstance(base, mmap.mmap) else None


def _float_type() -> np.dtype:
    return np.dtype(jnp.result_type(float))
