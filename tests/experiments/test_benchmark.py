import json

import jax
import pytest

from experiments.benchmark import main, start, target
from phongfit.fitting.fit import fit


def test_a_table_of_ratios(tmp_path, capsys):
    """What is measured, not how fast it is: all ways end at one answer."""
    numbers = tmp_path / "benchmark.json"
    # optax is not written for strict promotion.
    with jax.numpy_dtype_promotion("standard"):
        main(resolution=24, runs=1, json=numbers)
    printed = capsys.readouterr().out
    rows = [line for line in printed.splitlines() if line.startswith("| ")]
    found = json.loads(numbers.read_text())
    seconds = found["seconds"]
    assert len(rows) == 1 + len(seconds) and "24 × 24 pixels" in printed
    for key in ("lm", "lm_normal"):
        assert found[f"{key}_over_fit"] == pytest.approx(seconds[key] / seconds["fit"])
        (row,) = [row for row in rows if f"{1e3 * seconds[key]:.1f} ms" in row]
        off = float(row.split("|")[4].strip().removesuffix("σ"))
        assert off < 0.1


def test_the_start_is_the_peers():
    scene, image = target(24)
    problem = fit(scene, image).found.problem
    material = problem.unknowns.material(start(problem))
    assert float(material.shininess) == pytest.approx(8)
    assert material.diffuse.tolist() == [0.5, 0.5, 0.5]


def test_nothing_to_time():
    with pytest.raises(ValueError, match="resolution, runs: whole numbers ≥ 1"):
        main(runs=0)
