"""A whole [`Fit`][] in one file, to be looked at and gone on from elsewhere."""

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

    For numbers alone, which every program reads, there is [`Fit`][]`.to_dict`.

    **Arguments:** `path`: the file; `.npz` by custom.

    **Raises:** `OSError` that names the file; `ValueError` that names what cannot be
    saved: a function, as the one that an [`ImplicitSurface`][] of one's own has.
    """
    whole = dataclasses.replace(fit, region=fit.region.evaluated())
    made_with = importlib.metadata.version("phongfit")
    write_packed(Path(path), {**header(), "made_with": made_with}, whole)


@checked
def load_fit(path: str | os.PathLike[str]) -> Fit:
    """The fit that [`save_fit`][] wrote: it prints, draws and predicts as it did then.

    Classes of one's own, such as a light, must have been imported. The file holds no
    code.

    **Raises:** `ValueError` that names the file, what was expected and what was got:
    another version of the format, or the other floating-point precision.
    """
    found = read_packed(Path(path), header(), _REMEDIES)
    if not isinstance(found, Fit):
        raise ValueError(f"{path}: expected a Fit, got a {type(found).__name__}")
    return found


def header() -> dict[str, object]:
    """What stands at the head of a fit that this program writes."""
    precision = str(jnp.result_type(float))
    return {"format": FORMAT, "version": VERSION, "precision": precision}
