"""What JAX compiles is kept, so that the next run starts in a third of the time."""

import os
import warnings
from pathlib import Path

import jax

SWITCH = "PHONGFIT_CACHE"


def cache_folder() -> Path | None:
    """Where compiled programs are kept; `None` if they are not to be."""
    wanted = os.environ.get(SWITCH)
    if wanted == "off":
        return None
    if wanted:
        return Path(wanted)
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path("~/.cache").expanduser()) / "phongfit"


def _is_private(folder: Path) -> bool:
    """Whether nobody but this user, or the system's, may put files there."""
    found = folder.stat()
    users = {getattr(os, "geteuid", lambda: found.st_uid)(), 0}
    return found.st_uid in users and not found.st_mode & 0o022


def keep_compiled() -> None:
    """Let JAX keep what it compiles, if there is a folder for it to write to.

    A folder that JAX_COMPILATION_CACHE_DIR names stays; one that cannot be written to
    is no error, since nothing but time is lost.
    """
    folder = cache_folder()
    if folder is None or os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return
    try:
        # Programs are run as they are found: nobody else may put any there.
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError:
        return
    if not os.access(folder, os.R_OK | os.W_OK | os.X_OK):
        return
    if not _is_private(folder):
        warnings.warn(
            f"{folder}: is not used, since others may write programs into it that "
            f"would be run (chmod go-w, or {SWITCH}=off)",
            stacklevel=2,
        )
        return
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation")
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
