"""Save a whole [`Fit`][] in one file, to view or continue it elsewhere."""

import dataclasses
import importlib.metadata
import os
from pathlib import Path

import jax.numpy as jnp

from phongfit.edge import checked
from phongfit.files import scenes as scenes  # all kinds that scenes are made of
from phongfit.files.packing import read_packed, write_packed
from phongfit.fitting.result import Fit

FORMAT = "phongfit saved fit"
VERSION = 1
_REMEDIES = {
    "version": "read it with the phongfit that wrote it",
    "precision": "set JAX_ENABLE_X64=1 for float64, 0 for float32",
}


@checked
def save_fit(path: str | os.PathLike[str], fit: Fit) -> None:
    """Write a fit with its images, geometry and statistics: see [`load_fit`][].

    For numbers that other programs read, use [`Fit`][]`.to_dict`.

    **Arguments:** `path`: the file; `.npz` by custom.

    **Raises:** `OSError` that names the file; `ValueError` that names a part that
    cannot be saved: a function, such as that of a custom [`ImplicitSurface`][].
    """
    whole = dataclasses.replace(fit, region=fit.region.evaluated())
    made_with = importlib.metadata.version("phongfit")
    write_packed(Path(path), {**header(), "made_with": made_with}, whole)


@checked
def load_fit(path: str | os.PathLike[str]) -> Fit:
    """Read a fit that [`save_fit`][] wrote; it prints, draws and predicts as before.

    Modules of custom classes, such as a light, must have been imported. The file holds
    no code.

    **Raises:** `ValueError` that names the file, what was expected and what was got:
    another version of the format, or the other floating-point precision.
    """
    found = read_packed(Path(path), header(), _REMEDIES)
    if not isinstance(found, Fit):
        raise ValueError(f"{path}: expected a Fit, got a {type(found).__name__}")
    return found


def header() -> dict[str, object]:
    """Header of a saved fit in this version and precision."""
    precision = str(jnp.result_type(float))
    return {"format": FORMAT, "version": VERSION, "precision": precision}
