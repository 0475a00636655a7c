"""Data sets from their folders, whatever the layout."""

import os
from pathlib import Path

from phongfit.files.dataset import Dataset as Dataset
from phongfit.files.diligent import is_diligent, read_diligent as read_diligent


def read_dataset(folder: str | os.PathLike[str]) -> Dataset:
    """A data set from its folder; so far in DiLiGenT's layout: [`read_diligent`][].

    **Raises:** `ValueError` that names the file that is missing or wrong.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(f"{folder}: there is no such folder")
    if is_diligent(folder):
        return read_diligent(folder)
    raise ValueError(f"{folder}: is no data set: it has no filenames.txt")
