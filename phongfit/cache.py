"""A cache of compiled programs, with which later processes start three times faster."""

import contextlib
import os
import time
import warnings
import zlib
from pathlib import Path

import jax

from phongfit.codes import warn

SWITCH = "PHONGFIT_CACHE"
# Bytes of compiled programs, above which the oldest half goes.
MOST = 2**30
# Written when all older entries had been looked at; and seconds that one may take to
# be written.
LOOKED_AT, WRITING = ".looked-at", 60.0


def cache_folder() -> Path | None:
    """Folder of compiled programs; `None` if caching is switched off."""
    wanted = os.environ.get(SWITCH)
    if wanted == "off":
        return None
    if wanted:
        return Path(wanted)
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path("~/.cache").expanduser()) / "phongfit"


def keep_compiled() -> None:
    """Switch on JAX's cache of compiled programs, if its folder can be written to.

    A cache folder that JAX is already configured with is kept. A folder that cannot be
    written to raises nothing: the programs are compiled again in each process.
    """
    folder = cache_folder()
    if folder is None or jax.config.values["jax_compilation_cache_dir"] is not None:
        return
    try:
        # Programs are run as they are found: nobody else may put any there.
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
            stacklevel=2,
        )
        return
    # Another process may be tidying the folder at the same time.
    with contextlib.suppress(OSError):
        tidy(folder)
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation")
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _is_private(folder: Path) -> bool:
    """Whether only this user and root may write to a folder."""
    found = folder.stat()
    users = {getattr(os, "geteuid", lambda: found.st_uid)(), 0}
    return found.st_uid in users and not found.st_mode & 0o022


def tidy(folder: Path) -> None:
    """Remove entries that are damaged, and the oldest where there are too many.

    JAX writes them where they lie: one whose process was killed meanwhile stays as it
    is, can never be read, and is never written again. Each is looked at once.
    """
    before, stamp = time.time() - WRITING, folder / LOOKED_AT
    since = stamp.stat().st_mtime if stamp.exists() else 0.0
    entries = {path: path.stat() for path in folder.glob("*-cache")}
    for path, found in list(entries.items()):
        if since <= found.st_mtime < before and not _is_whole(path.read_bytes()):
            path.unlink(missing_ok=True)
            del entries[path]
    size = sum(found.st_size for found in entries.values())
    if size > MOST:
        for path, found in sorted(entries.items(), key=lambda e: e[1].st_mtime):
            path.unlink(missing_ok=True)
            size -= found.st_size
            if size <= MOST // 2:
                break
    stamp.touch()
    os.utime(stamp, (before, before))


def _is_whole(entry: bytes) -> bool:
    """Whether a compressed cache entry can be decompressed."""
    if entry.startswith(b"\x28\xb5\x2f\xfd"):
        # Compressed by zstandard, which is not installed everywhere: not checked.
        return True
    try:
        zlib.decompress(entry)
    except zlib.error:
        return False
    return True
