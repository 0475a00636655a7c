"""Data flows one way: who may import whom, read from the source."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# From left to right; each may import those to its left. A name of several parts that
# share a place may import one another.
ORDER = [
    {"checks", "plain", "programs", "vectors"},
    {"presets"},
    {"material", "reflectance", "lights", "environment", "testing"},
    {"geometry"},
    {"scene"},
    {"rendering"},
    {"fitting"},
    {"files"},
    {"maps"},
    {"report"},
    {"lab"},
    {"commands"},
    {"cli"},
    {"__main__"},
]
PLACE = {part: place for place, parts in enumerate(ORDER) for part in parts}
# Within `fitting`: what is asked, how it is solved, what is known of the answer.
STRATA = ["problem", "solve", "uncertainty"]
# What only one part may know.
KEPT = {
    "optimistix": "fitting",
    "imageio": "files",
    "imagecodecs": "files",
    "OpenEXR": "files",
    "trimesh": "files",
    "embreex": "geometry",
    "starlette": "lab",
    "uvicorn": "lab",
}
# The exceptions, inside a function: what shows or saves itself asks `report` or `files`
# how, since that is no part of it; and a command makes data sets where `data_synth` is
# installed.
LATER = {
    "phongfit/material.py": ("phongfit.report.",),
    "phongfit/scene.py": ("phongfit.report.",),
    "phongfit/fitting/result.py": ("phongfit.report.", "phongfit.files.saved."),
    "phongfit/commands/synth.py": ("data_synth.",),
}
MODULES = [
    path.relative_to(ROOT)
    for top in ("phongfit", "data_synth", "experiments")
    for path in sorted((ROOT / top).rglob("*.py*"))
    if path.suffix in (".py", ".pyi")
]


def imported(source: str, package: str, *, at_once: bool = False) -> set[str]:
    """Every module that a source imports, by its full name.

    Anywhere in it, or only what is imported with it `at_once`.
    """
    found, tree = set(), ast.parse(source)
    for node in tree.body if at_once else ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package.split(".")[: 1 - node.level or None] if node.level else []
            origin = ".".join([*base, *([node.module] if node.module else [])])
            found |= {f"{origin}.{alias.name}" for alias in node.names}
    return found


def violations(path: Path, source: str) -> list[str]:
    """What this module imports and may not, in words."""
    top, *parts = path.with_suffix("").parts
    package = ".".join(path.parts[:-1])
    wrong, names = [], imported(source, package)
    later = LATER.get(path.as_posix())
    if later is not None:
        at_once = imported(source, package, at_once=True)
        names = {name for name in names if not name.startswith(later)} | at_once
    for name in sorted(names):
        first, _, rest = name.partition(".")
        if first in ("tests", "experiments") and first != top:
            wrong.append(f"{path} imports {first}")
        elif first == "data_synth" and top == "phongfit":
            wrong.append(f"{path} imports data_synth")
        elif first in KEPT and top != "experiments":
            if (top, parts[0]) != ("phongfit", KEPT[first]):
                wrong.append(f"{path}: only phongfit/{KEPT[first]} may import {first}")
        elif first == top == "phongfit" and parts != ["__init__"]:
            # What starts a part from the command line is a command.
            importer = "__main__" if parts[-1] == "__main__" else parts[0]
            wrong += _to_the_right(path, importer, rest.split(".")[0])
    return wrong


def _to_the_right(path: Path, importer: str, part: str) -> list[str]:
    if part not in PLACE:
        # `import phongfit` or `from phongfit import Sphere` asks for all of it.
        return [f"{path} imports the whole of phongfit"]
    if importer != part and PLACE[importer] <= PLACE[part]:
        if not {importer, part} <= {"checks", "vectors"}:
            return [f"{path} imports phongfit.{part}, which is not to its left"]
    return []


@pytest.mark.parametrize("path", MODULES, ids=str)
def test_imports_go_left(path):
    assert violations(path, (ROOT / path).read_text()) == []


@pytest.mark.parametrize("path", MODULES, ids=str)
def test_no_import_is_hidden(path):
    # A name made at run time is not seen above.
    hidden = re.search("import_module|__import__", (ROOT / path).read_text())
    assert hidden is None or path.parts[0] != "phongfit"


@pytest.mark.parametrize("path", MODULES, ids=str)
def test_strata_of_fitting_rest_on_those_below(path):
    if path.parts[:2] != ("phongfit", "fitting"):
        return
    here = STRATA.index(path.parts[2]) if path.parts[2] in STRATA else len(STRATA)
    package = ".".join(path.parts[:-1])
    for name in imported((ROOT / path).read_text(), package):
        if name.startswith("phongfit.fitting."):
            other = name.split(".")[2]
            there = STRATA.index(other) if other in STRATA else len(STRATA)
            assert there <= here, f"{path} imports {name}"


def test_every_part_has_its_place():
    parts = {
        path.parts[1].removesuffix(path.suffix)
        for path in MODULES
        if path.parts[0] == "phongfit"
    }
    assert parts - {"__init__"} <= set(PLACE)


@pytest.mark.parametrize(
    "path, source",
    [
        ("phongfit/geometry/cameras.py", "from phongfit.scene import Scene"),
        ("phongfit/geometry/cameras.py", "from ..rendering.film import Film"),
        ("phongfit/geometry/cameras.py", "from .. import scene"),
        ("phongfit/material.py", "from phongfit import lights"),
        ("phongfit/scene.py", "from phongfit.report.notebook import of_scene"),
        ("phongfit/lights.py", "def f():\n    from phongfit.report.plots import plot"),
        ("phongfit/lights.py", "import phongfit.reflectance"),
        ("phongfit/rendering/film.py", "def f():\n    import phongfit.files.images"),
        ("phongfit/files/images.py", "import phongfit as pf"),
        ("phongfit/fitting/fit.py", "from phongfit import Sphere"),
        ("phongfit/fitting/fit.py", "import data_synth"),
        ("phongfit/fitting/fit.py", "from experiments.benchmark import adam"),
        ("phongfit/report/page.py", "import optimistix as optx"),
        ("phongfit/report/page.py", "import imageio.v3"),
        ("phongfit/report/page.py", "import uvicorn"),
        ("phongfit/lab/command.py", "from phongfit.cli import run"),
        ("data_synth/dataset.py", "from optimistix import least_squares"),
        ("data_synth/dataset.py", "import experiments"),
        ("data_synth/dataset.py", "import tests.helpers"),
    ],
)
def test_a_wrong_import_is_seen(path, source):
    assert len(violations(Path(path), source)) == 1


@pytest.mark.parametrize(
    "path, source",
    [
        ("phongfit/geometry/cameras.py", "from phongfit.lights import PointLight"),
        ("phongfit/geometry/cameras.py", "from .surfaces import Sphere"),
        ("phongfit/fitting/fit.py", "import optimistix as optx\nimport jax"),
        ("phongfit/__init__.pyi", "from .fitting.fit import fit as fit"),
        ("phongfit/scene.py", "def f():\n    from phongfit.report.plots import plot"),
        ("phongfit/commands/lab.py", "from phongfit.lab.command import lab"),
        ("data_synth/dataset.py", "import phongfit as pf"),
        ("experiments/benchmark/single.py", "import phongfit, data_synth, optimistix"),
    ],
)
def test_a_right_import_is_fine(path, source):
    assert violations(Path(path), source) == []
