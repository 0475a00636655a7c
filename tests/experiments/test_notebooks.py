"""The notebooks: what they show is what they give, and nothing in them fails."""

import os
import re
from pathlib import Path

import pytest
from nbformat import NotebookNode

from experiments.run_notebooks import execute, notebooks, read

# Which of several equal correlations come first, rounding decides.
CORRELATION = re.compile(r"^\s+\S+\s+\S+\s+[+-][01]\.\d+$")
PSBOX = Path(__file__).parents[2] / "docs/how-to/psbox"
NUMBER = re.compile(r"\d+(?:\.\d*)?")


def printed(notebook: NotebookNode) -> list[str]:
    """All lines that its cells print."""
    lines = []
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            assert output.output_type != "error", output
            if output.output_type == "stream":
                assert output.name == "stdout", output.text
                lines += output.text.splitlines()
    # How many steps it takes, too, is a matter of rounding.
    lines = [re.sub(r"after \d+ steps", "after some steps", line) for line in lines]
    return [line for line in lines if not CORRELATION.match(line)]


def close(number: str, other: str) -> bool:
    """Equal but for 2 units in the last digit and 2 %: processors round differently."""
    last = 10.0 ** -len(number.partition(".")[2])
    return abs(float(number) - float(other)) <= 2 * last + 0.02 * float(number)


def environment() -> dict[str, str]:
    """As a user has it, in single precision.

    A kernel that is stopped while it keeps a program leaves half of it.
    """
    plain = {n: v for n, v in os.environ.items() if n != "JAX_COMPILATION_CACHE_DIR"}
    return plain | {"JAX_ENABLE_X64": "0"}


def test_there_are_two():
    assert [path.name for path in notebooks()] == [
        "first_fit.ipynb",
        "photographs.ipynb",
    ]


@pytest.mark.parametrize("path", notebooks(), ids=lambda path: path.stem)
def test_stored_outputs(path):
    stored = read(path)
    cells = [cell for cell in stored.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert len(printed(stored)) > 10
    pictures = [o for c in cells for o in c.outputs if "image/png" in o.get("data", {})]
    assert len(pictures) >= 4
    text = path.read_text(encoding="utf-8")
    assert len(text) < 2**20
    assert not re.search(r"/(home|root|tmp|work|Users)/", text)


def test_real_photographs_are_explained_better_by_a_highlight():
    """PSBox's, which are passed on under its licence."""
    lines = printed(read(notebooks()[1]))
    assert (PSBOX / "LICENSE.txt").is_file() and len(
        list(PSBOX.glob("cat/*.png"))
    ) == 12
    shiny, matte = ([float(v) for v in one.split()[1:]] for one in lines[-2:])
    assert len(shiny) == 3 and max(matte) < 0.2
    assert all(one < other for one, other in zip(shiny, matte, strict=True))


@pytest.mark.extended
@pytest.mark.parametrize("path", notebooks(), ids=lambda path: path.stem)
def test_running_again_gives_the_same(path):
    stored, again = printed(read(path)), printed(execute(path, environment()))
    assert [NUMBER.sub("#", line) for line in again] == [
        NUMBER.sub("#", line) for line in stored
    ]
    for line, other in zip(stored, again, strict=True):
        for number, new in zip(
            NUMBER.findall(line), NUMBER.findall(other), strict=True
        ):
            assert close(number, new), (line, other)
