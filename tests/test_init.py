"""The public names: all there, each imported when it is first asked for."""

import importlib
import pickle
import subprocess
import sys
from pathlib import Path

import pytest

import phongfit as pf
from phongfit.moved import MOVED

NAMES = dir(pf)


def test_every_name_is_there():
    assert 70 < len(NAMES) <= 90
    for name in NAMES:
        value = getattr(pf, name)
        origin = getattr(value, "__module__", getattr(value, "__name__", "phongfit"))
        assert origin.split(".")[0] in ("phongfit", "builtins"), name
    with pytest.raises(AttributeError, match="Sfere"):
        pf.Sfere  # noqa: B018  # pyright: ignore


@pytest.mark.parametrize("module", MOVED)
def test_names_that_moved_warn(module):
    for name in MOVED[module].split():
        expected = f"from phongfit.{module} import {name}"
        with pytest.warns(DeprecationWarning, match=expected):
            value = getattr(pf, name)
        assert value is getattr(importlib.import_module(f"phongfit.{module}"), name)
        assert name not in NAMES


def test_all_names_of_version_0_2_are_there():
    """It had 138 names; `geometry`, `rendering` and `open_data` are new."""
    moved = {name for names in MOVED.values() for name in names.split()}
    assert len(moved | set(NAMES)) == 141


def test_modules_have_the_names_of_their_stubs():
    assert pf.geometry.trace is importlib.import_module("phongfit.geometry").trace
    for module in (pf.geometry, pf.rendering):
        assert all(hasattr(module, name) for name in dir(module))


def test_a_star_imports_them_all():
    names = {}
    exec("from phongfit import *", names)
    assert set(NAMES) <= set(names)
    assert names["Sphere"] is pf.Sphere


def test_classes_can_be_pickled():
    assert pickle.loads(pickle.dumps(pf.Sphere)) is pf.Sphere
    assert pickle.loads(pickle.dumps(pf.Film(bits=8))) == pf.Film(bits=8)


def test_help_needs_no_jax():
    code = (
        "import sys, phongfit, phongfit.cli; assert phongfit.cli.main(['--help']) == 0;"
        "sys.exit(any(name in sys.modules for name in ('jax', 'numpy', 'pydantic')))"
    )
    root = Path(__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True)
    assert done.returncode == 0, done
