"""Cameras of photographs, from files of COLMAP or of NeRF tools."""

import os
from pathlib import Path

from phongfit.edge import checked
from phongfit.files.colmap import is_colmap, load_colmap
from phongfit.files.transforms import load_transforms
from phongfit.geometry.cameras import PinholeCamera

TRANSFORMS = "transforms.json"


@checked
def load_cameras(path: str | os.PathLike[str]) -> dict[str, PinholeCamera]:
    """Cameras of photographs, from files of COLMAP or of NeRF tools.

    ```python
    cameras = phongfit.load_cameras("project")  # or "project/sparse/0"
    camera = cameras["IMG_0001.jpg"]
    ```

    **Arguments:** `path`: the folder of a COLMAP model (text or binary), of a COLMAP
    project with one in its `sparse/0`, or of a `transforms.json`; or that file. Camera
    models are COLMAP's pinholes, `RADIAL`, `OPENCV` and fisheyes with their simpler
    forms. Lengths are in the files' unit, which is arbitrary for COLMAP. COLMAP's
    cameras ignore the EXIF orientation of photographs, but [`read_image`][] turns
    images upright: remove the EXIF orientation of photographs that have one.

    **Returns:** a camera for each photograph, by its name in the files, including any
    folders there.

    **Raises:** `ValueError` that names the file: missing, broken, or of an unknown
    camera model.
    """
    path = Path(path)
    if not path.exists():
        raise ValueError(f"{path}: there is no such file or folder")
    if path.is_file():
        if path.suffix.lower() != ".json":
            raise ValueError(
                f"{path}: expected a transforms.json, or the folder of a COLMAP model"
            )
        return load_transforms(path)
    if not is_colmap(path) and (path / TRANSFORMS).exists():
        return load_transforms(path / TRANSFORMS)
    return load_colmap(path)
