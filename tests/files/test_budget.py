"""How much memory a file may take."""

import numpy as np
import pytest

from phongfit.files.arrays import read_array
from phongfit.files.budget import SWITCH, afford, in_words, most, parse_size


def test_sizes():
    assert parse_size("x", "1.5k") == 1536
    assert parse_size("x", " 100 ") == 100
    assert parse_size("x", "2GB") == 2**31
    for wrong in ("", "-1G", "much", "0", "1" * 400, "G"):
        with pytest.raises(ValueError, match="x: expected a size such as 4G"):
            parse_size("x", wrong)
    assert [in_words(n) for n in (5, 2048, 3 * 2**29)] == ["5 bytes", "2 KB", "1.5 GB"]


def test_the_limit_is_lifted(tmp_path, monkeypatch):
    np.save(tmp_path / "a.npy", np.zeros(2000))
    monkeypatch.setenv(SWITCH, "20K")
    assert most() == 20 * 2**10
    with pytest.raises(ValueError, match=r"a\.npy.*at most 20 KB.*MEMORY=2G"):
        read_array(tmp_path / "a.npy", "a")
    monkeypatch.setenv(SWITCH, "40K")
    assert read_array(tmp_path / "a.npy", "a").shape == (2000,)
    afford(most(), "all of it")
    monkeypatch.setenv(SWITCH, "plenty")
    with pytest.raises(ValueError, match=f"{SWITCH}: expected a size"):
        most()
