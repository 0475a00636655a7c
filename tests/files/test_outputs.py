"""Outputs: whole or not at all."""

import json
import os

import jax.numpy as jnp
import numpy as np
import pytest

from phongfit.files.outputs import replacing, replacing_folder, write_json


def test_replaces_when_all_went_well(tmp_path):
    path = tmp_path / "out.txt"
    path.write_text("old")
    with replacing(path) as temporary:
        temporary.write_text("new")
        assert temporary.suffix == ".txt" and temporary.parent == tmp_path
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


def test_absent_folder_is_named(tmp_path):
    with pytest.raises(OSError, match=r"there is no folder .*absent"):
        with replacing(tmp_path / "absent" / "out.txt"):
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
        assert not out.exists()
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
    with pytest.raises(TypeError, match="object has no place in JSON"):
        write_json(tmp_path / "a.json", {"a": object()})
    assert not os.listdir(tmp_path)
