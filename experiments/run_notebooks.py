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
# Time limit of one cell.
SECONDS = 300


def notebooks() -> list[Path]:
    """All notebooks, in the order of their names."""
    return sorted(FOLDER.glob("*.ipynb"))


def read(path: Path) -> NotebookNode:
    """Read a notebook file."""
    return nbformat.read(path, as_version=4)


def execute(path: Path, environment: Mapping[str, str]) -> NotebookNode:
    """Run a notebook in a new kernel, and return it with the outputs of this run.

    **Arguments:** `environment`: the kernel's environment variables.

    **Raises:** `nbclient.exceptions.CellExecutionError` with the cell that fails.
    """
    notebook = read(path)
    # Metadata of cells would differ from editor to editor.
    for cell in notebook.cells:
        cell.metadata = NotebookNode()
    client = NotebookClient(
        notebook,
        timeout=SECONDS,
        kernel_name="python3",
        # Hides ipykernel's warning that its connection is not encrypted: the connection
        # does not leave this machine.
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
