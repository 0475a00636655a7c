"""Data flows one way: who may import whom, read from the source."""

import ast
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# From left to right; each may import those to its left. A name of several parts that
# share a place may import one another.
ORDER = [
    {"codes", "moved"},
    {"cache"},
    {"edge", "plain", "programs"},
    {"checks", "vectors"},
    {"presets"},
    {"material", "reflectance", "lights", "environment", "testing", "textures"},
    {"microfacets"},
    {"geometry"},
    {"scene"},
    {"rendering"},
    {"fitting"},
    {"calibration"},
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
    "mapbox_earcut": "files",
    "embreex": "geometry",
    "starlette": "lab",
    "rawpy": "files",
    "uvicorn": "lab",
    "zarr": "files",
    "dask": "maps",
    "distributed": "maps",
}
# The exceptions, inside a function: what shows or saves itself asks `report` or `files`
# how, since that is no part of it; and a command makes data sets where `data_synth` is
# installed.
LATER = {
    "phongfit/material.py": ("phongfit.report.",),
    "phongfit/scene.py": ("phongfit.report.",),
    "phongfit/fitting/result.py": ("phongfit.report.", "phongfit.files.saved."),
    "phongfit/fitting/problem/specification.py": ("phongfit.files.fits.",),
    "phongfit/commands/synth.py": ("data_synth.",),
}
SOURCES = {
    path.relative_to(ROOT): path.read_text(encoding="utf-8")
    for top in ("phongfit", "data_synth", "experiments")
    for path in sorted((ROOT / top).rglob("*.py*"))
    if path.suffix in (".py", ".pyi")
}


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


def test_imports_go_left():
    wrong = [violations(path, source) for path, source in SOURCES.items()]
    assert sum(wrong, []) == []


def test_no_import_is_hidden():
    # A name made at run time is not seen above.
    hidden = re.compile("import_module|__import__")
    package = [path for path in SOURCES if path.parts[0] == "phongfit"]
    assert [path for path in package if hidden.search(SOURCES[path])] == []


def test_strata_of_fitting_rest_on_those_below():
    def stratum(parts: Sequence[str]) -> int:
        return STRATA.index(parts[2]) if parts[2] in STRATA else len(STRATA)

    fitting = [p for p in SOURCES if p.parts[:2] == ("phongfit", "fitting")]
    assert len(fitting) > 40
    wrong = [
        f"{path} imports {name}"
        for path in fitting
        for name in imported(SOURCES[path], ".".join(path.parts[:-1]))
        if name.startswith("phongfit.fitting.")
        and stratum(name.split(".")) > stratum(path.parts)
    ]
    assert wrong == []


def test_every_part_has_its_place():
    parts = {
        path.parts[1].removesuffix(path.suffix)
        for path in SOURCES
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
        ("phongfit/lab/server.py", "from phongfit.cli import run"),
        ("data_synth/dataset.py", "from optimistix import least_squares"),
        ("data_synth/dataset.py", "import experiments"),
        ("data_synth/dataset.py", "import tests.helpers"),
    ],
)
def test_a_wrong_import_is_seen(path, source):
    assert len(violations(Path(path), source)) == 1


def unheld(
    modules: set[str], tests: set[str], table: dict[str, list[str]]
) -> list[str]:
    """What is wrong with who tests what, in words.

    A module is held by the test file of its name, or by the one line of the table that
    names it.

    **Arguments:**

    - `modules`, `tests`: files without their suffix, such as `geometry/cameras` and
        `geometry/test_cameras`.
    - `table`: test file → the modules that it holds beside that of its own name.
    """
    named = [module for held in table.values() for module in held]
    own = {module for module in modules if _own_test(module) in tests}
    return [
        *(f"{test}: there is no such test file" for test in sorted(set(table) - tests)),
        *(f"{name}: there is no such module" for name in sorted({*named} - modules)),
        *(
            f"{name}: no test file holds it"
            for name in sorted(modules - own - {*named})
        ),
        *(f"{name}: named, and has its own test" for name in sorted(own & {*named})),
        *(f"{name}: named twice" for name in sorted({*named}) if named.count(name) > 1),
    ]


def test_an_import_does_not_start_jax():
    # Half a second, and no fork after it.
    names = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in sorted((ROOT / "phongfit").rglob("*.py"))
        if not path.stem.startswith("__") and path.parent.name != "commands"
    ]
    program = (
        f"import importlib, sys; [importlib.import_module(n) for n in {names}]; "
        "from jax._src.xla_bridge import backends_are_initialized as started; "
        "sys.exit(started())"
    )
    assert subprocess.run([sys.executable, "-c", program], cwd=ROOT).returncode == 0


def _own_test(module: str) -> str:
    folder, _, name = module.rpartition("/")
    return f"{folder}/test_{name}".lstrip("/")


def test_a_test_holds_every_module():
    modules, tests = (
        {path.relative_to(ROOT / top).with_suffix("").as_posix() for path in paths}
        for top, paths in (
            ("phongfit", (ROOT / "phongfit").rglob("*.py")),
            ("tests", (ROOT / "tests").rglob("test_*.py")),
        )
    )
    rows = re.findall(
        r"^\| `([\w/]*test_\w+)` \| (.+) \|$",
        (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"),
        re.MULTILINE,
    )
    table = {test: re.findall(r"`([^`]+)`", held) for test, held in rows}
    assert len(table) == len(rows) > 10
    modules = {name for name in modules if not name.endswith("__init__")}
    assert unheld(modules, tests, table) == []


@pytest.mark.parametrize(
    "modules, table, words",
    [
        ({"a/b", "c"}, {"a/test_b": ["c"]}, []),
        ({"a/b", "c"}, {}, ["c: no test file holds it"]),
        ({"a/b"}, {"a/test_b": ["c"]}, ["c: there is no such module"]),
        ({"a/b", "c"}, {"test_d": ["c"]}, ["test_d: there is no such test file"]),
        ({"a/b"}, {"test_e": ["a/b"]}, ["a/b: named, and has its own test"]),
        ({"c"}, {"a/test_b": ["c"], "test_e": ["c"]}, ["c: named twice"]),
    ],
)
def test_what_no_test_holds_is_seen(modules, table, words):
    assert unheld(modules, {"a/test_b", "test_e"}, table) == words
