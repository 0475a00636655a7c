"""Store of finished tiles on disk, which are complete and of one job."""

import contextlib
import hashlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from phongfit.files.arrays import unpack
from phongfit.files.inputs import naming, read_bytes, read_text
from phongfit.files.outputs import alone_in, replacing, write_json
from phongfit.files.strict_json import parse_json

MANIFEST = "maps.json"
CHECK = "check"


class TileStore:
    """A folder with the finished tiles of a job."""

    def __init__(self, folder: str | os.PathLike[str], job: dict[str, Any]):
        """**Arguments:**

        - `folder`: an existing folder.
        - `job`: checksums and settings that identify the job: plain numbers and text.

        **Raises:** `ValueError` if the folder holds tiles of another job, or other
        files; `OSError` that names it.
        """
        self._folder = Path(folder)
        self._job = json.dumps(job, sort_keys=True)
        manifest = self._folder / MANIFEST
        if manifest.exists():
            _check(manifest, job)
        elif any(not name.name.startswith(".") for name in self._folder.iterdir()):
            raise ValueError(
                f"output: expected an empty folder, got {self._folder}, which holds "
                "other files"
            )
        else:
            write_json(manifest, job)

    def _path(self, tile: int) -> Path:
        return self._folder / f"tile_{tile:06d}.npz"

    def load(self, tile: int) -> dict[str, np.ndarray] | None:
        """The arrays of a tile, or `None` if it is not finished or not readable."""
        try:
            arrays = unpack(read_bytes(self._path(tile)))
            check = arrays.pop(CHECK).tobytes()
            return arrays if check == self._checksum(tile, arrays) else None
        except Exception:
            # The file is missing or damaged: the tile is fitted again.
            return None

    def save(self, tile: int, arrays: dict[str, np.ndarray]) -> None:
        """Keep the arrays of a finished tile."""
        check = np.frombuffer(self._checksum(tile, arrays), np.uint8)
        with replacing(self._path(tile)) as temporary:
            np.savez(temporary, allow_pickle=False, **arrays, **{CHECK: check})

    def _checksum(self, tile: int, arrays: dict[str, np.ndarray]) -> bytes:
        """Checksum of the job, the tile's number and its arrays."""
        found = hashlib.blake2b(f"{self._job} {tile}".encode(), digest_size=16)
        for name in sorted(arrays):
            array = arrays[name]
            found.update(f"{name} {array.dtype.str} {array.shape}".encode())
            found.update(np.ascontiguousarray(array).tobytes())
        return found.digest()


@contextlib.contextmanager
def tile_store(
    folder: str | os.PathLike[str], job: dict[str, Any]
) -> Iterator[TileStore]:
    """A [`TileStore`][] that is locked for this run; its folder is made if missing.

    **Raises:** as [`TileStore`][]; `OSError` if another run writes there.
    """
    Path(folder).mkdir(parents=True, exist_ok=True)
    with alone_in(Path(folder)):
        yield TileStore(folder, job)


def _check(manifest: Path, job: dict[str, Any]) -> None:
    with naming(f"output: {manifest}"):
        found = parse_json(read_text(manifest))
    check_job(str(manifest.parent), found, job)


def check_job(place: str, found: Any, job: dict[str, Any]) -> None:
    """Check that the tiles in a place are of this job.

    **Raises:** `ValueError` that names the differences.
    """
    if found != json.loads(json.dumps(job)):
        held = found if isinstance(found, dict) else {}
        differing = [key for key in job if held.get(key) != job[key]]
        raise ValueError(
            f"output: {place} holds tiles of another job (its "
            f"{', '.join(differing) or 'manifest'} differs); give another folder"
        )
