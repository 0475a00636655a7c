"""The notebooks: what they show is what they give, and nothing in them fails."""

import os
import re
from pathlib import Path

import pytest
from nbformat import NotebookNode

from experiments.run_notebooks import execute, notebooks, read

# Which of several equal correlations come first, rounding decides.
CORRELATION = re.compile(r"^\s+\S+\s+\S+\s+[+-][01]\.\d+$")
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


def environment(**changes: str) -> dict[str, str]:
    """As a user has it: single precision, and no photographs unless they are named.

    A kernel that is stopped while it keeps a program leaves half of it.
    """
    without = ("PHONGFIT_PHOTOS", "JAX_COMPILATION_CACHE_DIR")
    plain = {name: v for name, v in os.environ.items() if name not in without}
    return plain | {"JAX_ENABLE_X64": "0"} | changes


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


def test_no_photograph_is_passed_on():
    stored = read(notebooks()[1])
    assert "a synthetic stand-in, no photographs: 12 images" in printed(stored)


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


@pytest.mark.slow
def test_with_real_photographs():
    beside = Path(__file__).parents[2] / ".." / "shared" / "photos"
    folder = Path(os.environ.get("PHONGFIT_PHOTOS", beside)).resolve()
    if not (folder / "diligent_ball").is_dir():
        pytest.skip(f"there are no photographs at {folder}")
    lines = printed(execute(notebooks()[1], environment(PHONGFIT_PHOTOS=str(folder))))
    assert "real photographs: diligent_ball, 96 of them" in lines
    scores = {line.split()[0]: line.split()[1:] for line in lines[-2:]}
    for fitted, matte in zip(scores["Blinn-Phong"], scores["matte"], strict=True):
        assert float(fitted) < float(matte) < 0.3
