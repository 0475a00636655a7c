"""Data sets from their folders, whatever the layout."""

import os
from pathlib import Path

from phongfit.files.dataset import Dataset as Dataset
from phongfit.files.diligent import is_diligent, read_diligent as read_diligent
from phongfit.files.scenes import SCENE_FILE, read_scene_dataset


def read_dataset(folder: str | os.PathLike[str]) -> Dataset:
    """A data set from its folder, in our own layout or in DiLiGenT's.

    Ours has a `scene.json`: see [`read_scene_dataset`][]. DiLiGenT's has a
    `filenames.txt`: see [`read_diligent`][].

    **Raises:** `ValueError` that names the file that is missing or wrong.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(f"{folder}: there is no such folder")
    if (folder / SCENE_FILE).exists():
        return read_scene_dataset(folder)
    if is_diligent(folder):
        return read_diligent(folder)
    raise ValueError(
        f"{folder}: is no data set: it has neither a {SCENE_FILE} nor, as DiLiGenT "
        "has, a filenames.txt"
    )
