"""Compiled programs are kept where the user's cache is, unless that is not wanted."""

import os
import subprocess
import sys
import time
import zlib
from pathlib import Path

import jax
import pytest

from phongfit.cache import (
    SETTINGS,
    STAMP_FILE,
    WRITE_SECONDS,
    cache_environment,
    cache_folder,
    cache_programs,
    tidy,
)


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
    before = {name: jax.config.values[name] for name in SETTINGS}
    jax.config.update("jax_compilation_cache_dir", None)
    yield lambda: jax.config.values["jax_compilation_cache_dir"]
    for name, value in before.items():
        jax.config.update(name, value)


def test_it_is_told_to_jax_unless_it_has_one(tmp_path, monkeypatch, setting):
    monkeypatch.setenv("PHONGFIT_CACHE", "off")
    cache_programs()
    assert setting() is None
    monkeypatch.setenv("PHONGFIT_CACHE", str(tmp_path / "cache"))
    jax.config.update("jax_compilation_cache_dir", "/elsewhere")
    cache_programs()
    assert setting() == "/elsewhere"
    jax.config.update("jax_compilation_cache_dir", None)
    cache_programs()
    assert setting() == str(tmp_path / "cache")
    # What lies there is run: it is nobody else's to write.
    assert (tmp_path / "cache").stat().st_mode & 0o077 == 0


def test_one_that_others_may_write_to_is_not_used(tmp_path, monkeypatch, setting):
    folder = tmp_path / "cache"
    folder.mkdir()
    folder.chmod(0o777)
    monkeypatch.setenv("PHONGFIT_CACHE", str(folder))
    with pytest.warns(UserWarning, match="cache: is not used, since others may write"):
        cache_programs()
    assert setting() is None


def test_one_that_cannot_be_written_is_no_error(tmp_path, monkeypatch, setting):
    (tmp_path / "file").write_text("in the way")
    for name in ("file", "file/below"):
        monkeypatch.setenv("PHONGFIT_CACHE", str(tmp_path / name))
        cache_programs()
        assert setting() is None


def entry(folder: Path, name: str, age: float, content: bytes) -> Path:
    """A file as JAX keeps it, written so many seconds ago."""
    path = folder / f"jit_{name}-cache"
    path.write_bytes(content)
    set_age(path, age)
    return path


def set_age(path: Path, age: float) -> None:
    """As if it had been written so many seconds ago."""
    written = time.time() - age
    os.utime(path, (written, written))


def test_damaged_entries_go_and_each_is_looked_at_once(tmp_path):
    whole = zlib.compress(bytes(1000))
    kept = [
        entry(tmp_path, "whole", 2 * WRITE_SECONDS, whole),
        # It may be that its process is writing it just now.
        entry(tmp_path, "young", 0, whole[:10]),
        entry(tmp_path, "zstandard", 2 * WRITE_SECONDS, b"\x28\xb5\x2f\xfd"),
    ]
    damaged = entry(tmp_path, "damaged", 2 * WRITE_SECONDS, whole[:10])
    empty = entry(tmp_path, "empty", 2 * WRITE_SECONDS, b"")
    tidy(tmp_path)
    assert all(path.exists() for path in kept)
    assert not damaged.exists() and not empty.exists()
    # The young one is looked at when it is older, what was whole not again.
    entry(tmp_path, "whole", 2 * WRITE_SECONDS, b"")
    entry(tmp_path, "young", WRITE_SECONDS + 1, whole[:10])
    set_age(tmp_path / STAMP_FILE, 1.5 * WRITE_SECONDS)
    tidy(tmp_path)
    assert [path.exists() for path in kept] == [True, False, True]


def test_where_there_are_too_many_the_oldest_go(tmp_path, monkeypatch):
    monkeypatch.setattr("phongfit.cache.MAX_BYTES", 40)
    paths = [entry(tmp_path, str(age), age, zlib.compress(b"")) for age in range(8)]
    tidy(tmp_path)
    assert [path.exists() for path in paths] == [True] * 2 + [False] * 6


def test_other_processes_can_share_the_folder(tmp_path, setting):
    assert cache_programs(tmp_path / "cache") == tmp_path / "cache"
    environment = cache_environment()
    assert environment["JAX_COMPILATION_CACHE_DIR"] == str(tmp_path / "cache")
    shown = f"import jax; print([jax.config.values[n] for n in {tuple(SETTINGS)}])"
    done = subprocess.run(
        [sys.executable, "-c", shown],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == str([jax.config.values[name] for name in SETTINGS])


def test_fitting_changes_no_setting_of_jax():
    program = """
import jax
before = dict(jax.config.values)
import phongfit as pf
light = pf.DirectionalLight((0, 0, 1))
scene = pf.Scene(pf.Sphere(), pf.OrthographicCamera(8, 8), light)
image = pf.render(scene, pf.Material(0.5, 0.2, 9.0, 0.1))
pf.fit(scene, image, unknowns=["diffuse"])
assert dict(jax.config.values) == before
"""
    subprocess.run([sys.executable, "-c", program], check=True)


PROGRAM = """
import phongfit as pf
pf.cache_programs()
light = pf.DirectionalLight((0, 0, 1))
scene = pf.Scene(pf.Sphere(), pf.OrthographicCamera(8, 8), light)
print(pf.render(scene, pf.Material(0.1, 0.5, 0.2, 9.0)).mean())
"""


def test_programs_are_kept_and_damaged_entries_compiled_again(tmp_path):
    cache = tmp_path / "cache"
    others = {k: v for k, v in os.environ.items() if "COMPILATION_CACHE" not in k}
    environment = others | {"JAX_PLATFORMS": "cpu", "PHONGFIT_CACHE": str(cache)}

    def run() -> str:
        done = subprocess.run(
            [sys.executable, "-W", "error::UserWarning", "-c", PROGRAM],
            env=environment,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0 and done.stderr == "", done.stderr
        return done.stdout

    first = run()
    kept = {path: path.read_bytes() for path in cache.glob("jit_*-cache")}
    assert kept
    for path, content in kept.items():
        # As a process leaves it that was killed a minute ago.
        path.write_bytes(content[: len(content) // 2])
        set_age(path, 2 * WRITE_SECONDS)
    os.utime(cache / STAMP_FILE, (0, 0))
    assert run() == first
    # Written anew, and whole.
    assert all(zlib.decompress(path.read_bytes()) for path in kept)
