"""Stores of maps: zarr groups that are written block by block, with a ledger.

A block is one chunk of every array. The ledger has a checksum of each finished block,
written after its arrays; a block whose arrays match it is not computed again.
"""

import contextlib
import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from phongfit.files.outputs import WORK, alone_in
from phongfit.files.zarrs import (
    Window,
    address,
    attributes,
    erase,
    exists,
    holds,
    is_remote,
    make_array,
    open_group,
    read_window,
    writable,
    write_attributes,
    write_window,
)
from phongfit.maps.pixel.settings import MAP_PARAMETERS
from phongfit.maps.result import FAULTS, PLAIN, Layer
from phongfit.maps.stored import STORE_FORMAT

if TYPE_CHECKING:
    from phongfit.files.zarrs import Group

LEDGER, GIVEN, PLAN, HEAD = "ledger", "given", "plan", "zarr.json"
"""Names in a store: checksums of blocks, input arrays, the plan, and the attributes."""

OWN = {
    *MAP_PARAMETERS,
    *(f"stderr_{name}" for name in MAP_PARAMETERS),
    *(*PLAIN, "noise_given", LEDGER, GIVEN, PLAN, WORK, HEAD),
    *(*FAULTS, "matte", "strengths", "stderr_strengths"),
}
"""Names of the files and folders that a run writes into a store on a disk."""

PARTIAL = r"zarr\.[0-9a-f]+\.partial"
"""Names of a file that a killed run was writing."""

OTHERS = re.compile(rf"pass_\d+|materials_\w+|{PARTIAL}")
"""Names of the stores of earlier passes, of arrays of shared materials, and of a file
that a killed run was writing."""

DIGEST = 16
"""Bytes of a checksum."""


@dataclass(frozen=True)
class BlockStore:
    """Arrays over pixels in a zarr group, read and written block by block.

    - `group`: see [`open_store`][].
    - `job`: checksums and settings that identify the job.
    - `size`: of the arrays, as rows and columns, or as a number of pixels.
    - `block`: size of a block.
    """

    group: "Group"
    job: Mapping[str, str]
    size: tuple[int, ...]
    block: tuple[int, ...]

    @property
    def grid(self) -> tuple[int, ...]:
        """Number of blocks along each axis."""
        sides = zip(self.size, self.block, strict=True)
        return tuple(-(-side // step) for side, step in sides)

    def window(self, number: int) -> Window:
        """The part of the arrays in a block."""
        first = np.multiply(np.unravel_index(number, self.grid), self.block)
        last = np.minimum(first + self.block, self.size)
        return tuple(map(slice, first.tolist(), last.tolist()))

    def make(self, layers: Mapping[str, Layer], floats: Any) -> None:
        """Make the arrays that the group lacks, or has in another shape or type."""
        for name, layer in layers.items():
            shape, chunks = ((*n, *layer.channels) for n in (self.size, self.block))
            dtype = floats if layer.dtype == "float" else layer.dtype
            if not holds(self.group, name, shape, dtype, chunks):
                make_array(self.group, name, shape, dtype, chunks, layer.outside)
        shape, chunks = (*self.grid, DIGEST), (*(1 for _ in self.grid), DIGEST)
        if not holds(self.group, LEDGER, shape, "uint8", chunks):
            # Uncompressed, so that a truncated chunk raises an error when it is read.
            make_array(self.group, LEDGER, shape, "uint8", chunks, compressed=False)

    def load(self, number: int, names: Iterable[str]) -> dict[str, np.ndarray] | None:
        """The arrays of a block, or `None` if it is not finished or is damaged."""
        window = self.window(number)
        try:
            noted = read_window(writable(self.group, LEDGER), self._entry(number))
            if not noted.any():
                return None
            arrays = {
                name: read_window(writable(self.group, name), window) for name in names
            }
        except ValueError:
            return None
        return arrays if self._checksum(number, arrays) == noted.tobytes() else None

    def save(self, number: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Write the arrays of a finished block, then its checksum.

        **Raises:** `OSError` that names the store.
        """
        kept = {name: writable(self.group, name) for name in arrays}
        # Checksums are of what is read again: flags of a tile may have more bits.
        arrays = {
            name: arrays[name].astype(array.dtype, copy=False)
            for name, array in kept.items()
        }
        for name, array in kept.items():
            write_window(array, self.window(number), arrays[name])
        digest = np.frombuffer(self._checksum(number, arrays), np.uint8)
        entry = digest.reshape(*(1 for _ in self.grid), DIGEST)
        write_window(writable(self.group, LEDGER), self._entry(number), entry)

    def _entry(self, number: int) -> Window:
        return tuple(slice(k, k + 1) for k in np.unravel_index(number, self.grid))

    def _checksum(self, number: int, arrays: Mapping[str, np.ndarray]) -> bytes:
        """Checksum of the job, the block's number and its arrays."""
        job = json.dumps(dict(self.job), sort_keys=True)
        # SHA-256 is fast, since processors have instructions for it.
        found = hashlib.sha256(f"{job} {number}".encode())
        for name in sorted(arrays):
            array = arrays[name]
            found.update(f"{name} {array.dtype.str} {array.shape}".encode())
            found.update(np.ascontiguousarray(array).data.cast("B"))
        return found.digest()[:DIGEST]


class Anew(os.PathLike[str]):
    """The place of a store whose older maps are removed before new ones are written."""

    def __init__(self, path: str | os.PathLike[str]):
        """**Arguments:** `path`: path or URL of the store."""
        self.path = os.fspath(path)

    def __fspath__(self) -> str:
        return self.path


@contextlib.contextmanager
def alone_at(
    output: str | os.PathLike[str], images: str | None = None
) -> Iterator[str]:
    """The address of an output, into which no other run writes meanwhile.

    A folder on a disk is made if it is missing. Object stores have no locks.

    **Arguments:**

    - `output`: path or URL; [`Anew`][] to remove older maps first.
    - `images`: as for [`check_place`][].

    **Raises:** as [`check_place`][]; `OSError` if another run writes there.
    """
    anew = isinstance(output, Anew)
    if is_remote(output):
        place = address(output)
        if anew and exists(place):
            _check_maps(place)
            erase(place)
        yield place
        return
    place = os.path.abspath(output)
    check_place(place, images)
    Path(place).mkdir(parents=True, exist_ok=True)
    with alone_in(Path(place)):
        if anew:
            _clear(Path(place))
        yield place


def _clear(folder: Path) -> None:
    """Remove older maps from a folder of which [`check_place`][] has approved.

    The attributes go last: maps of which a part is gone are still known as such.
    """
    if not (folder / HEAD).exists():
        return
    write_attributes(open_group(str(folder), "r+"), {"counts": None})
    names = {entry.name for entry in folder.iterdir()} - {HEAD, WORK}
    try:
        for name in [*sorted(names), HEAD]:
            part = folder / name
            shutil.rmtree(part) if part.is_dir() else part.unlink()
    except OSError as error:
        raise OSError(f"{folder}: cannot be removed: {error.strerror}") from error


def _check_maps(output: str) -> None:
    """Check that a store has maps.

    **Raises:** `OSError` that names it.
    """
    try:
        found = attributes(open_group(output)).get("format")
    except ValueError:
        found = None
    if found != STORE_FORMAT:
        raise OSError(f"{output}: is not replaced, since it holds no maps")


def check_place(output: str | os.PathLike[str], images: str | None) -> None:
    """Check that maps can be written to a path on a disk, before anything is written.

    **Arguments:** `images`: path or URL of the store of the images, if there is one.

    **Raises:** `OSError` if the images are there, or files that are not part of a store
    of maps.
    """
    place = Path(output).resolve()
    source = None if images is None else Path(images).resolve()
    if source is not None and (
        place.is_relative_to(source) or source.is_relative_to(place)
    ):
        raise OSError(f"{output}: the images are there, expected another place")
    if not place.is_dir():
        return
    for name in sorted(entry.name for entry in place.iterdir()):
        if name not in OWN and not OTHERS.fullmatch(name):
            raise OSError(f"{output}: is not replaced, since it holds {name}")
    # A run that was killed early has left no more than these.
    early = re.compile(rf"{re.escape(WORK)}|{re.escape(HEAD)}|{PARTIAL}")
    if not all(early.fullmatch(entry.name) for entry in place.iterdir()):
        _check_maps(str(output))


def open_store(output: str, head: Mapping[str, Any]) -> "Group":
    """Open a group for the blocks of a job; it is new, or of the same job.

    **Arguments:** `head`: its attributes, with `format` and `job`.

    **Raises:** `ValueError` if it holds another job or something else; `OSError` if it
    cannot be written.
    """
    group = open_group(output, "a")
    held = attributes(group)
    if held.get("format") == head["format"]:
        found, job = held.get("job"), head["job"]
        if found != job:
            known = found if isinstance(found, dict) else {}
            differing = [key for key in job if known.get(key) != job[key]]
            raise ValueError(
                f"out: {output} holds results of another job (its "
                f"{', '.join(differing) or 'list of inputs'} differs); give another "
                "folder"
            )
    elif held:
        raise ValueError(
            f"out: {output} holds something else, or a run of an older version; give "
            "another name"
        )
    if held | dict(head) != held:
        write_attributes(group, dict(head))
    return group
