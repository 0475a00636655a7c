"""What comes from outside."""

import pytest

from phongfit.files.inputs import inside, read_bytes, read_table, reason, recording


@pytest.mark.parametrize(
    "name",
    ["", "/etc/passwd", "..", "../a", "a/../../b", "C:\\a", "C:a", "a\\b", "a\0b", "."],
)
def test_names_that_lead_elsewhere(tmp_path, name):
    with pytest.raises(ValueError, match="the name of a file in this folder"):
        inside(tmp_path, name)


@pytest.mark.parametrize("name", ["a.png", "views/a.png", "a..b", "ä ö.png"])
def test_names_inside(tmp_path, name):
    assert inside(tmp_path, name) == tmp_path / name


def test_links(tmp_path):
    folder = tmp_path / "set"
    folder.mkdir()
    (tmp_path / "secret.png").write_text("secret")
    (folder / "a.png").symlink_to("../secret.png")
    (folder / "views").symlink_to(tmp_path)
    (folder / "round.png").symlink_to("round.png")
    (folder / "good.png").write_text("good")
    (folder / "b.png").symlink_to("good.png")
    for name in ("a.png", "views/secret.png"):
        with pytest.raises(ValueError, match="a link that leads out"):
            inside(folder, name)
    assert inside(folder, "b.png").read_text() == "good"
    with pytest.raises(ValueError):
        read_bytes(inside(folder, "round.png"))


def test_size_limit(tmp_path):
    (tmp_path / "a").write_bytes(b"12345")
    assert read_bytes(tmp_path / "a", 5) == b"12345"
    with pytest.raises(ValueError, match="expected at most 4 bytes, got 5"):
        read_bytes(tmp_path / "a", 4)


@pytest.mark.parametrize(
    "text, message",
    [
        ("1 2 3\n4 5\n", "line 2: expected 3 finite numbers.*got '4 5'"),
        ("1 2 x\n", "line 1: could not convert"),
        ("1 2 nan\n", "line 1: expected.*got '1 2 nan'"),
    ],
)
def test_tables(tmp_path, text, message):
    path = tmp_path / "a.txt"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_table(path, 3)
    path.write_text("1 2 3\n\n4 5 6e-1\n")
    assert read_table(path, 3).tolist() == [[1, 2, 3], [4, 5, 0.6]]


def test_a_file_that_changes_is_named(tmp_path):
    (tmp_path / "a").write_bytes(b"one")
    with recording() as outer:
        with recording() as inner:
            read_bytes(tmp_path / "a")
        assert outer == inner and len(inner) == 1
        (tmp_path / "a").write_bytes(b"two")
        with pytest.raises(ValueError, match="a: has changed since it was read"):
            read_bytes(tmp_path / "a")
    assert read_bytes(tmp_path / "a") == b"two"


def test_reasons_are_one_line_of_some_length():
    assert reason(ValueError("a\n  b")) == "a b"
    assert reason(KeyError()) == "KeyError"
    assert len(reason(ValueError("x" * 5000))) == 300
