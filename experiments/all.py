"""`python -m experiments.all OUT`: run every experiment, and put all on one page.

OUT becomes a folder with `contents.html`, which shows each experiment's question, its
answer and its figure, and beside it the figures (NAME.png, NAME.gif) and the numbers
(NAME.json). The exit status is 1 if a check fails.
"""

import re
import time
from pathlib import Path
from typing import Annotated, NamedTuple

import jinja2
import markupsafe
import tyro
from rich.console import Console
from rich.progress import track

from experiments import (
    adding_light,
    day_to_night,
    highlights,
    how_well,
    light_kinds,
    model,
    shading_methods,
    wrong_model,
)
from experiments.finding import Experiment, Finding, save_animation
from experiments.output import print_warnings
from phongfit.cli import run
from phongfit.files.outputs import replacing_folder, write_json

EXPERIMENTS = tuple(
    module.EXPERIMENT
    for module in (
        model,
        highlights,
        adding_light,
        shading_methods,
        light_kinds,
        day_to_night,
        how_well,
        wrong_model,
    )
)
# Name of the page in the folder.
PAGE = "contents.html"
TEMPLATE = Path(__file__).with_name("contents.html.jinja")
FILES = {PAGE} | {
    f"{one.name}.{suffix}" for one in EXPERIMENTS for suffix in ("png", "gif", "json")
}
"""Names of the files in the folder: an older run's may be replaced, no others."""


class Entry(NamedTuple):
    """One experiment on the page: with its finding, and the seconds that it took."""

    experiment: Experiment
    finding: Finding
    seconds: float


def save(folder: Path, entry: Entry) -> None:
    """Write the figure, animation (if there is one) and numbers of one experiment."""
    name, finding = entry.experiment.name, entry.finding
    finding.figure.savefig(folder / f"{name}.png")
    if finding.frames is not None:
        save_animation(folder / f"{name}.gif", finding.frames)
    write_json(folder / f"{name}.json", finding.numbers)


def contents(entries: list[Entry], small: bool) -> str:
    """HTML of the page; its links lead to files in the same folder.

    **Arguments:** `small`: whether the experiments were run quick and coarse, for a
    note.
    """
    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["indexed"] = indexed
    template = environment.from_string(TEMPLATE.read_text(encoding="utf-8"))
    return template.render(entries=entries, small=small)


def indexed(text: str) -> markupsafe.Markup:
    """Escape text for HTML, with ρ_d and the like as subscripts."""
    safe = str(markupsafe.escape(text))
    return markupsafe.Markup(re.sub(r"ρ_(\w)", r"ρ<sub>\1</sub>", safe))


def main(
    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")],
    small: bool = False,
) -> int:
    """Make every experiment, and a page of contents with all figures and answers.

    Exit status 1 if a check fails.

    Args:
        out: Folder to make; one that was made like this is replaced.
        small: Few pixels and few draws: quick and coarse.
    """
    console = Console()
    entries: list[Entry] = []
    # The folder is checked first, since all results would be lost if it is refused.
    with replacing_folder(out, may_replace=FILES.__contains__) as folder:
        for experiment in track(
            EXPERIMENTS,
            "experiments",
            console=console,
            disable=not console.is_terminal,
        ):
            begin = time.perf_counter()
            finding = experiment.find(small)
            entry = Entry(experiment, finding, time.perf_counter() - begin)
            save(folder, entry)
            entries.append(entry)
            console.print(f"{experiment.name}: {entry.seconds:.0f} s", highlight=False)
            print_warnings(console, finding.failed_checks)
        (folder / PAGE).write_text(contents(entries, small), encoding="utf-8")
    print(f"{len(entries)} experiments: {out / PAGE}")
    return 1 if any(entry.finding.failed_checks for entry in entries) else 0


if __name__ == "__main__":
    raise SystemExit(run(main, prog="python -m experiments.all"))
