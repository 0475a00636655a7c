import jax
import numpy as np
import pytest
from rich.console import Console

import phongfit as pf
from experiments.benchmark import costs, maps, single
from experiments.benchmark.__main__ import (
    Ratio,
    details,
    figure,
    main,
    single_ratios,
    spread,
    table,
)
from phongfit.fitting.fit import fit


def test_all_ways_end_at_one_answer():
    """What is measured, not how fast it is."""
    # optax is not written for strict promotion.
    with jax.numpy_dtype_promotion("standard"):
        found = single.rows(24, 1, Console())
    assert {"fit", "search", "lm", "lm_normal"} <= {row.key for row in found}
    assert all(row.off < 0.1 for row in found if row.key != "adam")
    assert len(details(found).splitlines()) == 2 + len(found)
    seconds = {row.key: row.seconds for row in found}
    for ratio in single_ratios(found):
        ours, theirs = ratio.key.split("_over_")[::-1]
        assert ratio.value == pytest.approx(seconds[theirs] / seconds[ours])


def test_the_start_is_the_peers():
    scene, image = single.target(24)
    problem = fit(scene, image).found.problem
    material = problem.unknowns.material(single.start(problem))
    assert float(material.shininess) == pytest.approx(8)
    assert material.diffuse.tolist() == [0.5, 0.5, 0.5]


def test_the_stack_is_what_a_map_takes_it_for():
    """The peers' model is the library's: a map finds the truth it was made of."""
    stack = maps.make_stack(100, 24)
    found = pf.fit_maps(stack.scenes, stack.images, film=maps.FREE)
    off = np.asarray(found.material.diffuse) - stack.truth[..., 3:6]
    pulls = off / np.asarray(found.stderr.diffuse)
    assert np.mean(np.abs(pulls[found.told]) < 4) > 0.99


def test_a_row_says_whether_its_aim_is_met():
    rows = [
        Ratio("fit", "LM", "a", 12, 10),
        Ratio("fit", "Adam", "b", 80, 100),
        Ratio("render", "itself", "c", 1.6, 1.5, at_most=True),
    ]
    assert [row.met for row in rows] == [True, False, False]
    text = table(rows).splitlines()
    assert text[2] == "| fit | LM | ≥ 10× | 12× |"
    assert text[3].endswith("80× (short) |") and "≤ 1.5×" in text[4]
    grown = {name: {"1": 1.0, "2": 2.0} for name in "abcd"}
    assert len(figure(rows, grown).axes) == 2


def test_costs_are_of_what_they_say():
    rendered = costs.render_costs((16, 32))
    assert set(rendered) == {"16", "32"} and spread({"a": 2.0, "b": 3.0}) == 1.5
    assert len(costs.scene_of(8, lights=4).lights) == 4


def test_nothing_to_time():
    with pytest.raises(ValueError, match="resolution, runs: whole numbers ≥ 1"):
        main(runs=0)
