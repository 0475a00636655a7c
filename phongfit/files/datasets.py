"""Data sets from folders of either layout."""

import os
from pathlib import Path
from typing import Any, Literal

from phongfit.edge import checked
from phongfit.files.dataset import Dataset as Dataset, Photographs
from phongfit.files.diligent import is_diligent, open_diligent
from phongfit.files.scenes import SCENE_FILE, open_scene_dataset


@checked
def open_dataset(
    folder: str | os.PathLike[str],
    *,
    min_cosine: float = -1.0,
    min_facing: float = -1.0,
    normals: Literal["given", "fit"] = "given",
) -> Photographs:
    """A data set from its folder, in our own layout or in DiLiGenT's, images unread.

    Ours has a `scene.json`: see [`open_scene_dataset`][]. DiLiGenT's has a
    `filenames.txt`: see [`open_diligent`][], which has these options.

    **Raises:** `ValueError` that names the file that is missing or wrong.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(f"{folder}: there is no such folder")
    if (folder / SCENE_FILE).exists():
        return open_scene_dataset(folder)
    if is_diligent(folder):
        return open_diligent(
            folder, min_cosine=min_cosine, min_facing=min_facing, normals=normals
        )
    raise ValueError(
        f"{folder}: is no data set: it has neither a {SCENE_FILE} nor, as DiLiGenT "
        "has, a filenames.txt"
    )


@checked
def read_dataset(folder: str | os.PathLike[str], **options: Any) -> Dataset:
    """A data set from its folder, with all images in memory.

    Options and errors are those of [`open_dataset`][].
    """
    return open_dataset(folder, **options).load()
