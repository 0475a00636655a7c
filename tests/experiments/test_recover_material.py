import json
import types
from typing import Any

import numpy as np
import pytest

from experiments import recover_material
from experiments.recover_material import cases, main, numbers, truth_values


@pytest.mark.extended
def test_a_material_comes_back(tmp_path, capsys, monkeypatch):
    """The first two of eight targets, which share what is compiled."""
    few = cases()[:2]
    monkeypatch.setattr(recover_material, "cases", lambda: few)
    picture, file = tmp_path / "new" / "a.png", tmp_path / "a.json"
    assert main(24, picture=picture, json=file) == 0
    printed = capsys.readouterr().out
    assert "2 targets, 20 parameters identified: all within 4 standard" in printed
    assert picture.stat().st_size > 1000
    for case, found in zip(few, json.loads(file.read_text()), strict=True):
        assert found["name"] == case.name and found["converged"]
        assert found["truth"] == truth_values(case.material, found["labels"]).tolist()
        off = np.abs(np.subtract(found["estimate"], found["truth"]))
        assert np.all(off < 4 * np.array(found["stderr"])) and not found["wrong"]


def test_what_is_wrong_is_named():
    """Of a matte target: an estimate, an error bar where there can be none."""
    matte = cases()[-1]
    fit: Any = types.SimpleNamespace(
        labels=("diffuse.red", "shininess"),
        values=np.array([0.6, 20.0]),
        errors=np.array([0.01, 5.0]),
        converged=False,
        steps=9,
        noise=0.01,
        warnings=(),
    )
    assert numbers(matte, fit)["wrong"] == [
        "diffuse.red is 0.25 off, 25.0 standard errors",
        "shininess has an error bar, though there is no highlight",
        "not converged",
    ]
