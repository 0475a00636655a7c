"""A cache of compiled programs, with which later processes start faster."""

import contextlib
import os
import time
import warnings
import zlib
from pathlib import Path

import jax

from phongfit.codes import warn

SWITCH = "PHONGFIT_CACHE"
# JAX's options: the cache folder, and the least compile time and size of an entry.
SETTINGS = (
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)
# Limit of the cache in bytes. Above it the oldest entries are deleted, down to half.
MAX_BYTES = 2**30
# A file whose time stamp is the time of the last check: entries older than it have been
# checked. And the longest time that writing an entry may take, seconds.
STAMP_FILE, WRITE_SECONDS = ".looked-at", 60.0


def cache_folder() -> Path | None:
    """Folder of compiled programs, by default; `None` if `PHONGFIT_CACHE` is `off`."""
    setting = os.environ.get(SWITCH)
    if setting == "off":
        return None
    if setting:
        return Path(setting)
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path("~/.cache").expanduser()) / "phongfit"


def cache_programs(folder: str | os.PathLike[str] | None = None) -> Path | None:
    """Keep compiled programs in a folder, so that later processes start faster.

    The commands of phongfit do this; importing phongfit or fitting from Python does
    not. The function changes JAX's configuration (`jax_compilation_cache_dir` and the
    two thresholds of what is kept), for the programs of other libraries, too. A cache
    folder that JAX is already configured with stays as it is.

    **Arguments:**

    - `folder`: default the one that the commands use: the environment variable
        `PHONGFIT_CACHE` (`off` for none), else `phongfit` in `$XDG_CACHE_HOME`, else
        `~/.cache/phongfit`. It may be deleted at any time.

    **Returns:** the folder that JAX uses now; `None` if there is none, also where the
    folder cannot be written to. A folder that others may write to is not used, with a
    warning, since its programs would be run.
    """
    configured = jax.config.values["jax_compilation_cache_dir"]
    if configured is None:
        _configure(cache_folder() if folder is None else Path(folder))
        configured = jax.config.values["jax_compilation_cache_dir"]
    return None if configured is None else Path(configured)


def cache_environment() -> dict[str, str]:
    """Environment variables with which another process uses the same cache."""
    return {
        name.upper(): str(value)
        for name in SETTINGS
        if (value := jax.config.values[name]) is not None
    }


def _configure(folder: Path | None) -> None:
    """Create a folder and set JAX's options to use it.

    Nothing is set for `None`, nor if the folder cannot be created or written to; nor,
    with a warning, if others may write to it.
    """
    if folder is None:
        return
    try:
        # Cached programs are run unchecked, so only this user may write to the folder.
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError:
        return
    if not os.access(folder, os.R_OK | os.W_OK | os.X_OK):
        return
    if not _is_private(folder):
        warn(
            "shared-cache",
            f"{folder}: is not used, since others may write programs into it that "
            "would be run",
            stacklevel=3,
        )
        return
    # Another process may be tidying the folder at the same time.
    with contextlib.suppress(OSError):
        tidy(folder)
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation")
    # 0 s and −1 byte: programs of any compile time and any size are kept.
    for name, value in zip(SETTINGS, (str(folder), 0.0, -1), strict=True):
        jax.config.update(name, value)


def _is_private(folder: Path) -> bool:
    """Whether only this user and root may write to a folder."""
    status = folder.stat()
    # Windows has no `geteuid`: there the owner counts as this user.
    users = {getattr(os, "geteuid", lambda: status.st_uid)(), 0}
    return status.st_uid in users and not status.st_mode & 0o022


def tidy(folder: Path) -> None:
    """Remove damaged entries, and the oldest ones of a cache above `MAX_BYTES`.

    JAX writes an entry in place. If the process is killed meanwhile, the damaged entry
    can never be read and is never replaced. Each entry is checked once.
    """
    # Younger entries may still be being written: the next call checks them.
    before, stamp = time.time() - WRITE_SECONDS, folder / STAMP_FILE
    since = stamp.stat().st_mtime if stamp.exists() else 0.0
    entries = {path: path.stat() for path in folder.glob("*-cache")}
    for path, status in list(entries.items()):
        if since <= status.st_mtime < before and not _is_whole(path.read_bytes()):
            path.unlink(missing_ok=True)
            del entries[path]
    size = sum(status.st_size for status in entries.values())
    if size > MAX_BYTES:
        for path, status in sorted(entries.items(), key=lambda e: e[1].st_mtime):
            path.unlink(missing_ok=True)
            size -= status.st_size
            if size <= MAX_BYTES // 2:
                break
    stamp.touch()
    os.utime(stamp, (before, before))


def _is_whole(entry: bytes) -> bool:
    """Whether a cache entry is undamaged: whether zlib can decompress it.

    Entries compressed by zstandard count as undamaged without a check.
    """
    if entry.startswith(b"\x28\xb5\x2f\xfd"):
        # The mark of zstandard, which is not installed everywhere.
        return True
    try:
        zlib.decompress(entry)
    except zlib.error:
        return False
    return True
