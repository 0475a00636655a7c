"""The photographs of the benchmark are those of the scene beside them."""

import numpy as np
import pytest

import phongfit as pf
from experiments.benchmark import photographs


@pytest.mark.extended
def test_both_kinds_come_to_the_maps_of_the_ball(tmp_path, monkeypatch):
    here = {"_read": photographs._read, "_fit": photographs._fit}

    def at_once(function: str, *arguments: str) -> tuple[float, int]:
        here[function](*arguments)
        return 2.0, 3_000_000_000

    monkeypatch.setattr(photographs, "_process", at_once)
    photographs.make_photographs(tmp_path, 0.004, 24)
    found = photographs.measure(tmp_path)
    assert {*found} == {"jpeg", "zarr"}
    for row in found.values():
        assert row["ratio"] == 1 and row["gigabytes_to_fit"] == 3
        assert row["identified"] > 0.5
    maps = [pf.StoredMaps(tmp_path / f"{k}_maps.zarr").load() for k in found]
    for one in maps:
        fine = one.identified
        # Paint is 0.35 and a stripe of 0.1; the exponent between 10 and 30.
        assert np.median(one.diffuse[fine]) == pytest.approx(0.35, abs=0.03)
        assert 10 < np.median(one.shininess[fine]) < 30
