"""The result of an experiment, and the command that shows it."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import rich.table
from jaxtyping import Float
from matplotlib.figure import Figure
from rich.console import Console
from rich.markup import escape

from experiments.output import (
    JsonFile,
    PictureFile,
    check_outputs,
    print_warnings,
    save_numbers,
    save_picture,
)
from phongfit.cli import run
from phongfit.files.images import to_levels
from phongfit.files.outputs import replacing


@dataclasses.dataclass(frozen=True)
class Table:
    """Rows of text under a heading; the first column names them."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclasses.dataclass(frozen=True)
class Finding:
    """An experiment's answer, and what it rests on.

    **Fields:**

    - `answer`: a few sentences, with the numbers that were measured.
    - `numbers`: those of the answer and more, for a JSON file.
    - `figure`; `alt`: a description of it, for readers who cannot see it.
    - `table`: the numbers as rows; `None` if there is no table.
    - `frames`: an animation in linear light; `None` if there is none.
    - `failed_checks`: a sentence for each check that failed.
    """

    answer: str
    numbers: dict[str, Any]
    figure: Figure
    alt: str
    table: Table | None = None
    frames: Float[np.ndarray, "frames height width 3"] | None = None
    failed_checks: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Experiment:
    """A question, and how to find its answer.

    **Arguments:**

    - `name`: name of its module and of its files.
    - `docstring`: that module's docstring: the question, an empty line, what is done.
    - `find`: the function that runs it; `find(True)` is quick and coarse.
    """

    name: str
    docstring: str | None
    find: Callable[[bool], Finding]

    @property
    def question(self) -> str:
        """The question: the first paragraph of the docstring, in one line."""
        words = self._parts[0].removeprefix("Question: ")
        return words[:1].upper() + words[1:]

    @property
    def method(self) -> str:
        """The rest of the module's docstring, as one paragraph."""
        return self._parts[1]

    @property
    def _parts(self) -> tuple[str, str]:
        """The docstring before and after its first empty line, without line breaks."""
        first, _, rest = (self.docstring or "").partition("\n\n")
        return " ".join(first.split()), " ".join(rest.split())

    def command(self) -> Callable[..., int]:
        """A function for [`run`][] whose parameters are the options of the command.

        It runs the experiment, writes its files, and returns the exit status.
        """

        def main(
            small: bool = False,
            picture: PictureFile = Path(f"out/{self.name}.png"),
            json: JsonFile = None,
        ) -> int:
            check_outputs(picture, json)
            console = Console()
            with console.status(escape(self.question)):
                finding = self.find(small)
            show(console, finding)
            save_picture(picture, finding.figure)
            if finding.frames is not None:
                animation = picture.with_name(f"{picture.stem}_animation.gif")
                save_animation(animation, finding.frames)
                print(f"animation: {animation}")
            save_numbers(json, finding.numbers)
            return 1 if finding.failed_checks else 0

        main.__doc__ = HELP.format(question=self.question, method=self.method)
        return main

    def run(self) -> int:
        """Run the experiment with the options of the command line; the exit status."""
        return run(self.command(), prog=f"python -m experiments.{self.name}")


HELP = """{question}

{method} Exit status 1 if a check fails.

Args:
    small: Few pixels and few draws: quick and coarse.
    picture: Where the figure goes; an animation, if there is one, goes beside it.
    json: Where the numbers go.
"""


def show(console: Console, finding: Finding) -> None:
    """Print the table, the answer, and failed checks."""
    if finding.table is not None:
        table = rich.table.Table()
        for at, column in enumerate(finding.table.columns):
            table.add_column(escape(column), justify="right" if at else "left")
        for row in finding.table.rows:
            table.add_row(*map(escape, row))
        console.print(table)
    console.print(finding.answer, markup=False, highlight=False)
    print_warnings(console, finding.failed_checks)


# Duration of a frame of an animation, milliseconds.
FRAME = 90


def save_animation(
    path: Path, frames: Float[np.ndarray, "frames height width 3"]
) -> None:
    """Write frames of linear light as a GIF that repeats for ever."""
    write = functools.partial(iio.imwrite, plugin="pillow", duration=FRAME, loop=0)
    with replacing(path) as temporary:
        write(temporary, to_levels(frames, "srgb", 8))
