"""Output files of experiments, for their numbers and pictures."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import tyro
from matplotlib.backend_bases import FigureCanvasBase
from matplotlib.figure import Figure
from rich.console import Console

from phongfit.files.outputs import check_file, replacing, write_json

JsonFile = Annotated[Path | None, tyro.conf.arg(metavar="FILE")]
PictureFile = Annotated[Path, tyro.conf.arg(metavar="FILE")]


def check_outputs(picture: Path | None, json: Path | None) -> None:
    """Check that these files can be written, before a long computation.

    **Arguments:** `picture`, `json`: `None` for a file that is not wanted.

    **Raises:** `OSError` if a file cannot be written, `ValueError` if `picture` has a
    suffix that Matplotlib does not write; both name the file.
    """
    for path in (picture, json):
        if path is not None:
            check_file(path)
    known = FigureCanvasBase.get_supported_filetypes()
    if picture is not None and picture.suffix.removeprefix(".").lower() not in known:
        raise ValueError(
            f"{picture}: expected the suffix of a picture, such as .png or .pdf, got "
            f"{picture.suffix!r}"
        )


def print_warnings(console: Console, sentences: Iterable[str]) -> None:
    """Print warnings and failed checks, one a line."""
    # Without markup, since rich would take codes in brackets for it.
    for words in sentences:
        console.print(f"  ! {words}", markup=False, highlight=False)


def save_numbers(path: Path | None, numbers: Any) -> None:
    """Write numbers as JSON; nothing if `path` is `None`."""
    if path is not None:
        write_json(path, numbers)


def save_picture(path: Path, figure: Figure) -> None:
    """Write a figure, and print its path."""
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=150)
    print(f"picture: {path}")
