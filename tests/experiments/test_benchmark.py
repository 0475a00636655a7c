import dataclasses
import importlib.util
from typing import Any

import jax
import numpy as np
import pytest
import scipy.special
from rich.console import Console

import phongfit as pf
from experiments.benchmark import (
    map_peers,
    maps,
    normal_peers,
    single,
    single_peers,
    texture_peers,
    textures,
)
from experiments.benchmark.__main__ import (
    Ratio,
    figure,
    main,
    map_details,
    map_ratios,
    normal_details,
    normal_ratio,
    single_details,
    single_ratios,
    table,
    texture_details,
    texture_ratios,
)
from experiments.benchmark.stack import UNKNOWNS, make_stack
from experiments.textured_object import TRUTH, Size, checkered, vase, views
from phongfit.fitting.fit import fit


@pytest.mark.extended
def test_all_ways_end_at_one_answer():
    """What is measured, not how fast it is."""
    # optax is not written for strict promotion.
    with jax.numpy_dtype_promotion("standard"):
        found = single.rows(24, 1, Console())
    assert {"fit", "search", "lm", "lm_normal", "lmfit"} <= {row.key for row in found}
    assert all(row.distance < 0.1 for row in found if "adam" not in row.key)
    assert len(single_details(found).splitlines()) == 2 + len(found)
    seconds = {row.key: row.seconds for row in found}
    for ratio in single_ratios(found):
        ours, theirs = ratio.key.split("_over_")[::-1]
        assert ratio.value == pytest.approx(seconds[theirs] / seconds[ours])


@pytest.mark.extended
def test_residuals_written_out_are_the_problems():
    scene, image = single.target(24)
    problem = fit(scene, image).solution.problem
    y = single.start(problem)
    used = np.asarray(problem.samples.weight)[0] > 0
    expected = np.asarray(problem.residual(y))[:, used]
    found = single_peers.written_out(problem).residual(
        np, np.asarray(y, float), lambda z: scipy.special.ndtr(-z)
    )
    assert (np.asarray(problem.light(y)) > 1).any()
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)


@pytest.mark.extended
@pytest.mark.skipif(
    importlib.util.find_spec("torch") is None, reason="PyTorch is not installed"
)
def test_adam_of_pytorch_comes_near():
    scene, image = single.target(24)
    found = fit(scene, image).solution
    y, answer = np.asarray(single.start(found.problem)), np.asarray(found.y)
    problem = single_peers.written_out(found.problem)
    end, steps = single_peers.torch_adam(problem, y, answer)()
    assert 10 < steps < single_peers.ADAM_MOST
    np.testing.assert_allclose(end, answer, atol=0.02)


def test_a_peer_that_is_absent_is_left_out_with_a_word():
    console = Console(width=200)
    with console.capture() as caught:
        assert not single.installed("no_such_module", "It", "pip install a[b]", console)
    assert caught.get() == "It is left out: pip install a[b]\n"


@pytest.fixture(scope="module")
def stack():
    return make_stack(100, 24)


@pytest.mark.extended
def test_the_stack_is_what_a_map_takes_it_for(stack):
    """The peers' model is the library's: a map finds the truth it was made of."""
    values, errors = map_peers.as_rows(maps.fit_stack(stack))
    pulls = (values - stack.truth.reshape(-1, UNKNOWNS)) / errors
    identified = np.isfinite(errors).all(axis=1)
    assert identified.mean() > 0.95 and np.mean(np.abs(pulls[identified]) < 4) > 0.99


@pytest.mark.extended
def test_peers_of_a_map_end_at_its_answer(stack):
    values, errors = map_peers.as_rows(maps.fit_stack(stack))
    truth = stack.truth.reshape(-1, UNKNOWNS)
    methods = {
        "vmapped_lm": map_peers.vmapped_lm(stack, 40),
        "scipy_loop": map_peers.scipy_loop(stack, 10),
    }
    rows = [
        map_peers.judge(key, key, found, values, errors, truth)
        for key, found in methods.items()
    ]
    assert [row.pixels for row in rows] == [40, 10]
    for row in rows:
        assert row.seconds > 0 and row.converged > 0.9
        assert row.as_map > 0.9 and 0.9 < row.near_truth < 1
    shifted = dataclasses.replace(
        methods["scipy_loop"], values=values[:10] + errors[:10]
    )
    assert map_peers.judge("", "", shifted, values, errors, truth).as_map == 0
    ours = dataclasses.replace(rows[0], key="map", seconds=rows[0].seconds / 9)
    lm, _ = map_ratios([ours, *rows])
    assert lm.key == "vmapped_lm_over_map" and lm.value == pytest.approx(9)
    assert map_details(rows).count("| 40 |") == 1


@pytest.mark.extended
def test_normals_and_their_peer_end_at_one_answer():
    rows = normal_peers.rows(100, 24)
    ours, peer = rows
    assert ours.pixels == peer.pixels == 100 and min(ours.seconds, peer.seconds) > 0
    # 0.2°: 1 % of noise in 72 samples.
    assert 0.05 < ours.degrees < 0.6 and peer.degrees == pytest.approx(
        ours.degrees, rel=0.1
    )
    slower = dataclasses.replace(peer, seconds=9 * ours.seconds)
    assert normal_ratio([ours, slower]).value == pytest.approx(9)
    assert normal_details(rows).count("| 100 |") == 2


TEXELS = Size(8, 16, 12, 6, 2)


@pytest.mark.extended
def test_texels_without_a_peer(monkeypatch):
    monkeypatch.setattr(texture_peers, "mitsuba_works", lambda: False)
    rows = textures.rows(TEXELS)
    (ours,) = rows
    assert ours.seconds > 0 and ours.arrived and 0 < ours.error < 0.03
    assert texture_ratios(rows) == [] and "libllvm" in texture_details(rows)
    peer = textures.Row("Adam", "adam", 30 * ours.seconds, 9, 0.1, False)
    (ratio,) = texture_ratios([ours, peer])
    assert ratio.key == "adam_over_texture" and ratio.value == pytest.approx(30)
    assert "not converged" in texture_details([ours, peer])


@pytest.fixture(scope="module")
def mitsuba():
    if not texture_peers.mitsuba_works():
        pytest.skip("Mitsuba 3 does not render here")
    return texture_peers.Mitsuba(views(vase(12, 6), TEXELS), TEXELS.texels)


@pytest.mark.extended
def test_mitsuba_renders_what_we_render(mitsuba):
    """Its own cameras, shapes and textures; the lobe is the one thing of ours."""
    texels = checkered(TEXELS.texels)
    mesh = vase(12, 6).with_textures(pf.Textures(diffuse=pf.Texture(texels)))
    few = np.concatenate([TRUTH.specular, TRUTH.shininess], axis=1)
    for which, scene in enumerate(views(mesh, TEXELS)):
        found = mitsuba.picture(which, texels, few)
        light = np.asarray(pf.render(scene, TRUTH, film=pf.Film(clamp=False)))
        apart = np.abs(found - light).max(axis=-1)
        # Along the outline, and where two materials meet, a ray may go either way.
        assert np.mean(apart < 1e-4) > 0.98, which


@pytest.mark.extended
def test_adam_of_mitsuba_comes_near(mitsuba):
    texels = checkered(TEXELS.texels)
    few = np.concatenate([TRUTH.specular, TRUTH.shininess], axis=1)
    images = [mitsuba.picture(k, texels, few) for k in range(4)]

    def distance(found: np.ndarray) -> float:
        return float(np.median(np.abs(found - texels)))

    end = mitsuba.descend(images, lambda found: distance(found) < 0.01, 400)
    assert 10 < end.steps < 400 and end.seconds > 0 and distance(end.texels) < 0.01


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


def test_nothing_to_time():
    with pytest.raises(
        ValueError, match="resolution, runs: expected whole numbers ≥ 1"
    ):
        main(runs=0)


@pytest.mark.parametrize("option", ["picture", "json"])
def test_where_the_result_goes_is_looked_at_first(tmp_path, monkeypatch, option):
    monkeypatch.setattr(single, "rows", None)
    (tmp_path / "file").touch()
    place: dict[str, Any] = {option: tmp_path / "file" / "a.png"}
    with pytest.raises(OSError, match="is a file, expected a folder"):
        main(**place)
