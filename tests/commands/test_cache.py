"""Compiled programs are kept where the user's cache is, if that is wanted."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from phongfit.commands.cache import cache_folder, keep_compiled
from phongfit.files.fits import read_fit_record


@pytest.mark.parametrize(
    "environment, folder",
    [
        ({"PHONGFIT_CACHE": "off"}, None),
        ({"PHONGFIT_CACHE": "/a/b"}, Path("/a/b")),
        ({"PHONGFIT_CACHE": "", "XDG_CACHE_HOME": "/c"}, Path("/c/phongfit")),
        ({"PHONGFIT_CACHE": "", "XDG_CACHE_HOME": "", "HOME": "/h"}, "/h/.cache"),
    ],
)
def test_where_it_is(monkeypatch, environment, folder):
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    found = cache_folder()
    assert found == (Path(folder) / "phongfit" if isinstance(folder, str) else folder)


@pytest.fixture
def setting(monkeypatch):
    """What JAX is told, which is told back afterwards."""
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    names = ["jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs",
             "jax_persistent_cache_min_entry_size_bytes"]  # fmt: skip
    before = {name: jax.config.values[name] for name in names}
    yield lambda: jax.config.values["jax_compilation_cache_dir"]
    for name, value in before.items():
        jax.config.update(name, value)


def test_it_is_told_to_jax_unless_it_has_one(tmp_path, monkeypatch, setting):
    before = setting()
    keep_compiled()  # switched off
    assert setting() == before
    monkeypatch.setenv("PHONGFIT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "/elsewhere")
    keep_compiled()
    assert setting() == before
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    keep_compiled()
    assert setting() == str(tmp_path / "cache")
    # What lies there is run: it is nobody else's to write.
    assert (tmp_path / "cache").stat().st_mode & 0o077 == 0


def test_one_that_others_may_write_to_is_not_used(tmp_path, monkeypatch, setting):
    folder = tmp_path / "cache"
    folder.mkdir()
    folder.chmod(0o777)
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("PHONGFIT_CACHE", str(folder))
    before = setting()
    with pytest.warns(UserWarning, match="cache: is not used, since others may write"):
        keep_compiled()
    assert setting() == before


def test_one_that_cannot_be_written_is_no_error(tmp_path, monkeypatch, setting):
    before = setting()
    (tmp_path / "file").write_text("in the way")
    for name in ("file", "file/below"):
        monkeypatch.setenv("PHONGFIT_CACHE", str(tmp_path / name))
        keep_compiled()
        assert setting() == before


def test_a_fit_in_a_process_of_its_own(brass, tmp_path):
    """As a user starts it, its output not a terminal: no bar, no colour, no traces."""
    cache, out = tmp_path / "cache", tmp_path / "out"
    command = [sys.executable, "-m", "phongfit", "fit", str(brass), "-o", str(out)]
    environment = {k: v for k, v in os.environ.items() if "COMPILATION_CACHE" not in k}
    done = subprocess.run(
        [*command, "--report", "none"],
        env=environment | {"JAX_PLATFORMS": "cpu", "PHONGFIT_CACHE": str(cache)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == "" and "\x1b" not in done.stdout and "\r" not in done.stdout
    assert "diffuse.red" in done.stdout and str(out) in done.stdout
    assert read_fit_record(out / "fit.json").converged
    assert sum(path.name.startswith("jit_") for path in cache.iterdir()) > 10
