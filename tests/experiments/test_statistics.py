import json

import numpy as np
import pytest

import phongfit as pf
from experiments.statistics import BOUND, Spread, main, random_problem


@pytest.mark.extended
def test_few_draws(tmp_path, capsys):
    numbers = tmp_path / "statistics.json"
    assert main(draws=25, problems=2, starts=8, json=numbers) == 0
    printed = capsys.readouterr().out
    assert "all free, 25 draws" in printed and "all as it should be" in printed
    found = json.loads(numbers.read_text())
    assert len(found["all free"]["ratio"]) == 10
    # The one on its bound is not judged; the others are.
    assert "ambient.red" not in found["a bound binds"]["labels"]
    assert len(found["a bound binds"]["labels"]) == 9
    # What trades with it is one-sided where it binds; nothing else is.
    binds = found["a bound binds"]
    one_sided = np.array(binds["labels"])[binds["one_sided"]]
    assert list(one_sided) == ["diffuse.red"]
    assert not any(found["all free"]["one_sided"])
    assert len(found["global"]["excess"]) == 2


def test_wrong_error_bars_are_seen():
    labels = ("good", "too narrow", "never inside")
    ratio, coverage = np.array([1.01, 1.2, 1.0]), np.array([0.95, 0.95, 0.5])
    two_sided = np.zeros(3, bool)
    many, few = (Spread(labels, ratio, coverage, two_sided, n) for n in (4000, 40))
    assert many.failed_checks() == list(labels[1:])
    assert few.failed_checks() == ["never inside"]


def test_one_sided_errors_may_be_wide_and_not_narrow():
    labels = ("wide", "wide, one-sided", "narrow, one-sided")
    ratio, coverage = np.array([0.87, 0.87, 1.1]), np.full(3, 0.95)
    spread = Spread(labels, ratio, coverage, np.array([False, True, True]), 4000)
    assert spread.failed_checks() == ["wide", "narrow, one-sided"]


def test_the_bound_binds():
    assert float(np.asarray(BOUND.ambient)[0]) == 0


@pytest.mark.extended
def test_random_problems_are_of_all_kinds():
    surfaces, lights, clipped = set(), set(), []
    for seed in range(12):
        scene, image = random_problem(seed)
        surfaces.add(type(scene.surface))
        lights.add(len(scene.lights))
        clipped.append(np.mean(image[image > 0] >= 1))
    assert surfaces == {pf.Sphere, pf.Mesh} and lights == {1, 2, 3}
    assert min(clipped) < 0.05 and 0.1 < max(clipped) < 0.25


def test_draws_below_one():
    with pytest.raises(ValueError, match="draws, starts: expected whole numbers ≥ 1"):
        main(draws=0)
