"""What all experiments share: where their numbers and pictures go."""

from pathlib import Path
from typing import Annotated, Any

import tyro
from matplotlib.figure import Figure

from phongfit.files.outputs import replacing, write_json

JsonFile = Annotated[Path | None, tyro.conf.arg(metavar="FILE")]
PictureFile = Annotated[Path, tyro.conf.arg(metavar="FILE")]


def save_numbers(path: Path | None, numbers: Any) -> None:
    """Write what was printed as JSON, if a file was asked for."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, numbers)


def save_picture(path: Path, figure: Figure) -> None:
    """Write a figure, and say where it is."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=150)
    print(f"picture: {path}")
