"""What a first fit is asked to measure compilers by."""

import numpy as np
import pytest

import phongfit as pf
from experiments.benchmark import compiling
from phongfit.fitting.fit import fit


@pytest.mark.extended
@pytest.mark.parametrize("kind", compiling.KINDS)
def test_each_image_but_the_first_has_its_own_unknown(kind):
    scenes, images, options = compiling.problem(3, kind, 16)
    problem = pf.make_problem(scenes, images, 0.003, **options)
    own = [label for label in problem.unknowns.y_labels if "[" in label]
    assert len({label.split("]")[0] for label in own}) == 2, own


@pytest.mark.extended
def test_what_is_measured_is_a_fit_that_ends_well():
    scenes, images, options = compiling.problem(2, "exposure", 16)
    found = fit(scenes, images, **options)
    assert found.converged
    np.testing.assert_allclose(found.exposure, [0.6, 0.8], rtol=0.05)


def test_a_table_of_them(monkeypatch, capsys):
    times = {"first": 6.0, "work": 8.0, "warm": 0.5}
    kept = times | {"first": 2.0}
    monkeypatch.setattr(compiling, "imports", lambda: 2.0)
    monkeypatch.setattr(
        compiling, "time_in_processes", lambda *_: {"empty": times, "kept": kept}
    )
    compiling.main(images=(4,))
    text = capsys.readouterr().out
    assert "| exposure | 4 | 6.0 s | 3.0 × | 8.0 s | 2.0 s | 0.50 s |" in text
    assert text.count("| 4 |") == len(compiling.KINDS)
