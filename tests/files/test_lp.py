"""Lists of lights, as domes and RTIBuilder write them and as people send them."""

import numpy as np
import pytest

import phongfit as pf


def written(tmp_path, text):
    path = tmp_path / "dome.lp"
    path.write_text(text, encoding="utf-8")
    return path


def test_round_trip(tmp_path):
    vectors = np.array([[0.1, 0.2, 0.97], [-0.5, 0.5, 0.7]])
    pf.write_lp(tmp_path / "a.lp", ["1.jpg", "my photo.jpg"], vectors)
    found = pf.read_lp(tmp_path / "a.lp")
    assert found.names == ("1.jpg", "my photo.jpg")
    assert found.vectors == pytest.approx(vectors)


@pytest.mark.parametrize(
    "names, vectors, message",
    [
        ("ab", [[0, 0, 1], [0, 0, 1]], "names: expected a list of names, got 'ab'"),
        (["a"], [[0, 0, 1], [0, 0, 1]], r"vectors: expected .* of shape \(1, 3\)"),
        (["a"], [[0, np.nan, 1]], "vectors: expected finite numbers"),
        (["a"], [["x", 0, 1]], "vectors: expected finite numbers"),
        (["a"], [[0, 0, 0]], "vectors: expected one to each lamp, got zeros for a"),
        (["a\nb"], [[0, 0, 1]], "names: expected one line each"),
    ],
)
def test_no_list_is_written_that_cannot_be_read(tmp_path, names, vectors, message):
    with pytest.raises(ValueError, match=message):
        pf.write_lp(tmp_path / "a.lp", names, vectors)
    assert list(tmp_path.iterdir()) == []


def test_as_people_send_them(tmp_path):
    text = (
        "\ufeff3\r\nC:\\rti\\IMG 01.JPG 0,5 0,25 0,8\r\n\r\n"
        "/home/me/b.jpg\t1 0 2\r\nc.jpg -1e-1 0 3\r\n"
    )
    found = pf.read_lp(written(tmp_path, text))
    assert found.base_names == ("IMG 01.JPG", "b.jpg", "c.jpg")
    assert found.vectors[0] == pytest.approx([0.5, 0.25, 0.8])


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "expected a count and as many lights, got nothing"),
        ("a.jpg 0 0 1\n", "line 1: expected the number of lights"),
        ("1\na.jpg 0 0 0\n", "line 2: a.jpg: expected a vector to the lamp, got zeros"),
        (
            "1\na.jpg 0 1\n",
            "line 2: expected a name and three numbers, got 'a.jpg 0 1'",
        ),
        ("1\na.jpg 0 nan 1\n", "line 2: expected a name and three numbers"),
        ("2\na.jpg 0 0 1\nx/a.jpg 1 0 1\n", "line 3: x/a.jpg comes twice"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        pf.read_lp(written(tmp_path, text))


def test_a_wrong_count_is_a_warning(tmp_path):
    path = tmp_path / "dome.lp"
    path.write_text("2\na.jpg 0 0 1\n")
    with pytest.warns(UserWarning, match=r"counts 2 lights, and 1 follow.*list-count"):
        assert pf.read_lp(path).names == ("a.jpg",)
