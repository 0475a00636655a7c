"""Question: do the notebooks still run, and what do they show today?

Runs every notebook of `experiments/notebooks/` in a fresh kernel and writes it back
with its outputs. Photographs are those of `docs/how-to/psbox`, whose licence is there.
"""

import os
from collections.abc import Mapping
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode

from phongfit.cli import run
from phongfit.files.outputs import replacing

FOLDER = Path(__file__).parent / "notebooks"
SECONDS = 300


def notebooks() -> list[Path]:
    """All notebooks, in the order of their names."""
    return sorted(FOLDER.glob("*.ipynb"))


def read(path: Path) -> NotebookNode:
    """Read a notebook file."""
    return nbformat.read(path, as_version=4)


def execute(path: Path, environment: Mapping[str, str]) -> NotebookNode:
    """A notebook with the outputs of a new run, in a kernel with this environment.

    **Raises:** `nbclient.exceptions.CellExecutionError` with the cell that fails.
    """
    notebook = read(path)
    for cell in notebook.cells:
        cell.metadata = NotebookNode()
    client = NotebookClient(
        notebook,
        timeout=SECONDS,
        kernel_name="python3",
        # A kernel of this machine alone need not warn that nothing is encrypted.
        extra_arguments=["--log-level=ERROR"],
        # Times would differ in every run.
        record_timing=False,
        resources={"metadata": {"path": str(path.parent)}},
    )
    client.execute(env=dict(environment))
    return notebook


def main() -> None:
    """Run the notebooks and write their outputs into them."""
    for path in notebooks():
        notebook = execute(path, os.environ)
        with replacing(path) as temporary:
            nbformat.write(notebook, temporary)
        print(f"{path.name}: {path.stat().st_size // 1024} kB")


if __name__ == "__main__":
    raise SystemExit(run(main, prog="python -m experiments.run_notebooks"))
