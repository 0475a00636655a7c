"""Outputs: whole or not at all."""

import contextlib
import errno
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from phongfit.files import outputs
from phongfit.files.outputs import (
    WORK,
    alone_in,
    replacing,
    replacing_folder,
    write_json,
)


def test_replaces_when_all_went_well(tmp_path):
    path = tmp_path / "out.txt"
    path.write_text("old")
    with replacing(path) as temporary:
        temporary.write_text("new")
        assert temporary.name == "out.txt" and temporary != path
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert os.listdir(tmp_path) == ["out.txt"]


@pytest.mark.parametrize("stop", [KeyboardInterrupt, SystemExit, ValueError, OSError])
def test_an_interrupt_leaves_the_old_file_and_nothing_else(tmp_path, stop):
    path = tmp_path / "out.txt"
    path.write_text("old")
    with pytest.raises(stop), replacing(path) as temporary:
        temporary.write_text("half of the n")
        raise stop
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["out.txt"]


@pytest.mark.parametrize("make", [replacing, replacing_folder])
def test_folders_above_are_made_and_go_if_nothing_comes_of_it(tmp_path, make):
    path = tmp_path / "new" / "newer" / "out"
    with pytest.raises(ZeroDivisionError), make(path):
        raise ZeroDivisionError
    assert not list(tmp_path.iterdir())
    with make(path) as place:
        (place if make is replacing else place / "out").write_text("made")
    assert path.exists() and len(list(tmp_path.rglob("*"))) == 3 + path.is_dir()


@pytest.mark.parametrize("make", [replacing, replacing_folder])
def test_file_in_place_of_a_folder_above_is_named(tmp_path, make):
    (tmp_path / "file").touch()
    words = f"{tmp_path / 'file'} is a file, expected a folder"
    with pytest.raises(OSError, match=words):
        with make(tmp_path / "file" / "new" / "out"):
            pytest.fail("the block must not be entered")


def test_folder_in_place_of_a_file_is_named(tmp_path):
    with pytest.raises(OSError, match="is a folder"), replacing(tmp_path):
        pytest.fail("the block must not be entered")


def test_full_disk_names_the_users_file(tmp_path):
    path = tmp_path / "out.txt"
    with pytest.raises(OSError, match=r"out\.txt: cannot be written: No space"):
        with replacing(path):
            raise OSError(28, "No space left on device")
    assert not os.listdir(tmp_path)


def test_folder_appears_whole(tmp_path):
    out = tmp_path / "set"
    with replacing_folder(out) as folder:
        (folder / "a.txt").write_text("a")
        assert os.listdir(out) == [WORK]
    assert os.listdir(out) == ["a.txt"] and os.listdir(tmp_path) == ["set"]


def test_interrupted_folder_leaves_the_old_one(tmp_path):
    out = tmp_path / "set"
    out.mkdir()
    (out / "old.txt").write_text("old")
    with pytest.raises(KeyboardInterrupt):
        with replacing_folder(out, lambda name: True) as folder:
            (folder / "a.txt").write_text("a")
            raise KeyboardInterrupt
    assert os.listdir(out) == ["old.txt"] and os.listdir(tmp_path) == ["set"]


def test_old_folder_is_replaced_only_as_a_whole(tmp_path):
    out = tmp_path / "set"
    out.mkdir()
    (out / "old.txt").write_text("old")
    with pytest.raises(OSError, match="not empty"), replacing_folder(out):
        pytest.fail("the block must not be entered")
    with pytest.raises(OSError, match=r"it holds old\.txt"):
        with replacing_folder(out, lambda name: name != "old.txt"):
            pytest.fail("the block must not be entered")
    with replacing_folder(out, lambda name: True) as folder:
        (folder / "new.txt").write_text("new")
    assert os.listdir(out) == ["new.txt"] and os.listdir(tmp_path) == ["set"]


def everything(name: str) -> bool:
    del name
    return True


@pytest.mark.parametrize("may_replace", [None, everything])
def test_files_that_came_meanwhile_stay(tmp_path, may_replace):
    out = tmp_path / "set"
    out.mkdir()
    ours = None if may_replace is None else (lambda name: name == "a.txt")
    with replacing_folder(out, ours) as folder:
        (folder / "a.txt").write_text("new")
        (out / "notes.txt").write_text("mine")
    assert (out / "notes.txt").read_text() == "mine"
    assert sorted(os.listdir(out)) == ["a.txt", "notes.txt"]


def test_neither_a_file_that_came_meanwhile_nor_the_results_are_lost(tmp_path):
    out = tmp_path / "set"
    with pytest.raises(OSError, match=r"a\.txt appeared .* results are in .*set-2"):
        with replacing_folder(out) as folder:
            (folder / "a.txt").write_text("new")
            (out / "a.txt").write_text("mine")
    assert (out / "a.txt").read_text() == "mine"
    assert (out / "set-2" / "a.txt").read_text() == "new"
    assert sorted(os.listdir(out)) == ["a.txt", "set-2"]


def test_files_beside_a_file_move_with_it(tmp_path):
    path = tmp_path / "lock"
    for stop in (True, False):
        with contextlib.suppress(KeyboardInterrupt), replacing(path) as temporary:
            temporary.write_text("made")
            temporary.with_name("other").write_text("too")
            if stop:
                raise KeyboardInterrupt
        assert sorted(os.listdir(tmp_path)) == ([] if stop else ["lock", "other"])


def test_one_run_at_a_time(tmp_path):
    out = tmp_path / "set"
    with replacing_folder(out, everything) as folder:
        (folder / "a.txt").write_text("first")
        with pytest.raises(OSError, match="set: another run is writing there"):
            with replacing_folder(out, everything):
                pytest.fail("the block must not be entered")
        with pytest.raises(OSError, match="another run"), alone_in(out):
            pytest.fail("the block must not be entered")
    assert (out / "a.txt").read_text() == "first" and os.listdir(out) == ["a.txt"]


def test_a_file_waits_for_its_turn(tmp_path, monkeypatch):
    path, begun = tmp_path / "out.txt", threading.Event()

    def write(text, pause):
        with replacing(path) as temporary:
            temporary.write_text(text)
            begun.set()
            time.sleep(pause)

    first = threading.Thread(target=write, args=("first", 0.3))
    first.start()
    assert begun.wait(10)
    write("second", 0)
    first.join()
    assert path.read_text() == "second" and os.listdir(tmp_path) == ["out.txt"]
    monkeypatch.setattr(outputs, "PATIENCE", 0.05)
    with replacing(path) as temporary:
        temporary.write_text("third")
        with pytest.raises(OSError, match="another run is writing"), replacing(path):
            pytest.fail("the block must not be entered")
    assert path.read_text() == "third"


PROGRAM = """
import os, signal, sys
from phongfit.files import outputs
path, moment = sys.argv[1:]
def stop(*args):
    os.kill(os.getpid(), signal.SIGKILL)
if moment == "while it moves":
    move = os.replace
    def replace(source, target):
        move(source, target)
        if str(target).endswith("a.txt"):
            stop()
    os.replace = replace
make = outputs.replacing if path.endswith(".txt") else outputs.replacing_folder
with make(path) as place:
    if path.endswith(".txt"):
        place.write_text("half")
    else:
        (place / "a.txt").write_text("a")
        (place / "b.json").write_text("b")
    if moment == "while it writes":
        stop()
"""


@pytest.mark.extended
@pytest.mark.parametrize("moment", ["while it writes", "while it moves"])
def test_a_killed_run_leaves_nothing_after_the_next(tmp_path, moment):
    out = tmp_path / "set"
    command = [sys.executable, "-c", PROGRAM, str(out), moment]
    assert subprocess.run(command).returncode == -signal.SIGKILL
    assert WORK in os.listdir(out)
    if moment == "while it moves":
        # What was made is there, the next run sees to it.
        with pytest.raises(OSError, match="not empty"), replacing_folder(out):
            pytest.fail("the block must not be entered")
        assert sorted(os.listdir(out)) == ["a.txt", "b.json"]
    else:
        with replacing_folder(out) as folder:
            assert not os.listdir(folder)
            (folder / "c.txt").write_text("c")
        assert os.listdir(out) == ["c.txt"]


@pytest.mark.extended
def test_a_killed_run_leaves_no_file_after_the_next(tmp_path):
    path = tmp_path / "out.txt"
    path.write_text("old")
    command = [sys.executable, "-c", PROGRAM, str(path), "while it writes"]
    assert subprocess.run(command).returncode == -signal.SIGKILL
    assert path.read_text() == "old" and len(os.listdir(tmp_path)) == 2
    with replacing(path) as temporary:
        assert not temporary.exists()
        temporary.write_text("new")
    assert path.read_text() == "new" and os.listdir(tmp_path) == ["out.txt"]


def test_the_folder_itself_is_never_moved(tmp_path):
    """It may be a mount point, somebody's working directory, or private."""
    out = tmp_path / "set"
    out.mkdir(mode=0o700)
    before = out.stat()
    with replacing_folder(out) as folder:
        (folder / "a.txt").write_text("a")
    after = out.stat()
    assert (before.st_ino, before.st_mode) == (after.st_ino, after.st_mode)


def test_a_file_that_is_a_mount_point_is_written_into(tmp_path, monkeypatch):
    path = tmp_path / "out.txt"
    path.write_text("something longer")
    move = os.replace

    def busy(source, target):
        if Path(target) == path:
            raise OSError(errno.EBUSY, "Device or resource busy", str(target))
        move(source, target)

    monkeypatch.setattr(os, "replace", busy)
    with replacing(path) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "new" and os.listdir(tmp_path) == ["out.txt"]


def test_links_are_followed_and_rights_stay(tmp_path):
    path, link = tmp_path / "out.txt", tmp_path / "link.txt"
    path.write_text("old")
    path.chmod(0o640)
    link.symlink_to(path)
    with replacing(link) as temporary:
        temporary.write_text("new")
    assert link.is_symlink() and path.read_text() == "new"
    assert path.stat().st_mode & 0o777 == 0o640


def test_a_pipe_is_written_to(tmp_path):
    path = tmp_path / "pipe"
    os.mkfifo(path)
    with pytest.raises(OSError, match="pipe: cannot be written: No such device"):
        # Nobody reads it.
        with replacing(path) as temporary:
            temporary.write_text("lost")
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        with replacing(path) as temporary:
            temporary.write_text("told")
        assert os.read(reader, 99) == b"told"
    finally:
        os.close(reader)
    assert os.listdir(tmp_path) == ["pipe"] and not path.is_file()


def test_devices_are_written_to_and_sockets_refused(tmp_path):
    null = Path(os.devnull)
    before = null.stat()
    with replacing(null) as temporary:
        temporary.write_text("gone")
    assert null.stat().st_ino == before.st_ino and null.is_char_device()
    with pytest.raises(OSError, match="expected a file, since others go beside"):
        with replacing(null) as temporary:
            temporary.write_text("gone")
            temporary.with_name("other").touch()
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "socket"))
        with pytest.raises(OSError, match="is a device or a socket, expected a file"):
            with replacing(tmp_path / "socket"):
                pytest.fail("the block must not be entered")
    assert (tmp_path / "socket").is_socket()


def test_a_folder_of_somebody_else_is_not_cleared(tmp_path):
    """In a folder that all may write to, the name could be a trap."""
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "a.txt").write_text("a")
    path = tmp_path / "out.txt"
    (tmp_path / f".out.txt{WORK}").symlink_to(precious)
    with pytest.raises(OSError, match=re.escape(f".out.txt{WORK} is in the way")):
        with replacing(path):
            pytest.fail("the block must not be entered")
    assert os.listdir(precious) == ["a.txt"]


def test_names_that_are_no_text_survive(tmp_path):
    name = os.fsdecode(b"caf\xe9.png")
    write_json(tmp_path / "a.json", {name: name})
    assert json.loads((tmp_path / "a.json").read_text("utf-8")) == {name: name}


def test_json_is_strict_and_readable(tmp_path):
    path = tmp_path / "a.json"
    data = {
        "b": jnp.array([0.1, jnp.nan, jnp.inf]),
        "a": [{"float32": np.float32(0.1)}],
        "flag": np.True_,
        "count": np.int64(3),
        "path": tmp_path / "x",
        "none": None,
    }
    write_json(path, data)
    text = path.read_text()
    assert json.loads(text) == {
        "b": [0.1, None, None],
        "a": [{"float32": 0.1}],
        "flag": True,
        "count": 3,
        "path": str(tmp_path / "x"),
        "none": None,
    }
    assert text.startswith('{\n  "b": [0.1, null, null],\n')


def test_json_keeps_every_bit(tmp_path):
    path = tmp_path / "a.json"
    for dtype in (np.float32, np.float64):
        numbers = np.random.default_rng(1).normal(size=200).astype(dtype)
        write_json(path, numbers)
        assert np.array_equal(np.array(json.loads(path.read_text()), dtype), numbers)


def test_json_refuses_what_it_does_not_know(tmp_path):
    with pytest.raises(TypeError, match="object cannot be written as JSON"):
        write_json(tmp_path / "a.json", {"a": object()})
    assert not os.listdir(tmp_path)
