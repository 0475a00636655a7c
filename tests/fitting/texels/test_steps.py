"""Texels of exponents: one joint system of all channels, and steps that are damped."""

import dataclasses

import numpy as np
import pytest

import phongfit as pf
from phongfit.fitting import texture_fit
from phongfit.fitting.texels import equations, steps
from phongfit.fitting.texels.job import State
from phongfit.fitting.texels.result import TextureFit
from phongfit.fitting.texels.solve import Preconditioned
from phongfit.fitting.texels.stencil import Stencil
from tests.fitting.texels.checkers import (
    DIFFUSE,
    EXPONENT,
    INSIDE,
    SPECULAR,
    painted,
    scenes,
    unit,
)
from tests.fitting.texels.scenes import SIZE, photographs, plate
from tests.helpers import near

ALL = ("diffuse", "specular", "shininess")


def bare() -> pf.Material:
    """Of which nothing is known."""
    return pf.Material(0.0, 0.0, 32.0, 0.0)


def fitted(count: int = 12, noise: float = 0.01, **options) -> TextureFit:
    truth = painted(count, diffuse=DIFFUSE, specular=SPECULAR, shininess=EXPONENT)
    images = photographs(truth, unit(), noise)
    given = {"unknowns": [f"{name}.texture" for name in ALL], "known": bare()}
    return pf.fit_texture(scenes(count), images, size=SIZE, **(given | options))


@pytest.fixture(scope="module")
def fit():
    return fitted()


def pulls(fit: TextureFit, name: str, true) -> np.ndarray:
    """Of texels that are identified; of exponents those of their logarithms."""
    values, errors = fit.values[name][0], fit.stderr[name][0]
    true = np.broadcast_to(true, values.shape)
    if name == "shininess":
        values, errors, true = np.log(values), errors / values, np.log(true)
    return ((values - true) / errors)[np.isfinite(errors)]


@pytest.mark.extended
def test_checkered_exponents(fit):
    assert fit.converged and not fit.warnings, fit
    assert fit.values["shininess"].shape == fit.stderr["shininess"].shape
    assert fit.values["shininess"].shape == (1, *SIZE, 1)
    exponents = pulls(fit, "shininess", EXPONENT)
    assert 0.9 < np.sqrt(np.mean(exponents**2)) < 1.1 and abs(exponents).max() < 4.5
    # Where nothing shines there is no exponent; elsewhere there is, to some percent.
    errors = (fit.stderr["shininess"] / fit.values["shininess"])[0, ..., 0]
    assert np.isinf(errors[INSIDE]).all()
    assert np.isfinite(errors).mean() > 0.8
    shiny = SPECULAR[..., 0] > 0
    assert np.isfinite(errors[shiny]).mean() > 0.98 and np.median(errors[shiny]) < 0.05
    shine = fit.values["specular"][0] - SPECULAR
    for name, true in (("diffuse", DIFFUSE), ("specular", SPECULAR)):
        errors = fit.stderr[name][0]
        assert np.isfinite(errors).all()
        off = ((fit.values[name][0] - true) / errors)[shiny]
        assert 0.9 < np.sqrt(np.mean(off**2)) < 1.1, name
    # At its bound, and within its error of it.
    assert (abs(shine) < 4.5 * fit.stderr["specular"][0])[INSIDE].all()
    near(fit.material.shininess, np.ones((1, 1)))
    assert "shininess: " in str(fit)


@pytest.mark.extended
def test_what_was_found_is_a_scene(fit):
    truth = painted(diffuse=DIFFUSE, specular=SPECULAR, shininess=EXPONENT)
    for plain, true in list(zip(scenes(), truth, strict=True))[:4]:
        again = pf.render(fit.scene(plain), fit.material)
        near(np.asarray(again), np.asarray(pf.render(true, unit())), 0.04)
    # What is not identified is filled from the nearest that is.
    filled = fit.filled("shininess")[0, ..., 0]
    known = np.isfinite(fit.stderr["shininess"][0, ..., 0])
    assert np.isin(filled[~known], filled[known]).all()


@pytest.mark.extended
def test_no_step_costs_more(monkeypatch):
    costs, taken = [], []

    def watched(job, state, sigma, damping):
        before = equations.cost_of(job, state, sigma).whole
        stepped, more = descend(job, state, sigma, damping)
        costs.append(equations.cost_of(job, stepped.state, sigma).whole - before)
        taken.append(stepped.state is not state)
        return stepped, more

    descend = steps.descend
    monkeypatch.setattr(steps, "descend", watched)
    # Two photographs hardly tell f from ρ_s.
    fitted(2, noise=0.005)
    assert len(costs) > 5 and max(costs) <= 0 and min(costs) < -100
    assert not all(taken)


def job_of(monkeypatch, **options):
    """The job that `fit_texture` makes, and where it starts."""
    found = []

    def caught(job, start, sigma, *rest):
        found.append((job, start, sigma))
        raise InterruptedError

    monkeypatch.setattr(texture_fit, "solve", caught)
    with pytest.raises(InterruptedError):
        fitted(3, **options)
    return found[0]


def test_the_right_side_is_the_slope_of_what_is_minimised(monkeypatch):
    job, start, sigma = job_of(monkeypatch, smoothness=0.5)
    rng = np.random.default_rng(1)
    # Some way off, so that no term is small.
    logs = start.exponents + rng.normal(0, 0.4, start.exponents.shape)
    state = State(rng.uniform(0.2, 0.8, start.texels.shape), start.numbers, logs)
    right = np.concatenate(steps.linearise(job, state, sigma).right)
    vector = np.concatenate(job.vectors(state))
    for way in rng.normal(size=(3, len(vector))):
        # Of reflectances alone, of exponents alone, of both.
        for part in (slice(0, -144), slice(-144, None), slice(None)):
            move = np.zeros_like(way)
            move[part] = 1e-5 * way[part]
            ends = [
                equations.cost_of(job, job.at([vector + s * move], state), sigma).whole
                for s in (1, -1)
            ]
            near((ends[0] - ends[1]) / 2, -2 * right @ move, 1e-6 * abs(right @ move))


def test_systems_of_three_channels_are_one_with_exponents(monkeypatch):
    job, start, sigma = job_of(monkeypatch)
    linear = job.without_exponents()
    assert [len(own) for own in linear.systems] == [2, 2, 2]
    assert [len(own) for own in job.systems] == [7]
    joint = equations.sum_up(job, start, sigma)
    apart = equations.sum_up(linear, start, sigma)
    for c, own in enumerate(apart.blocks):
        for (p, q), block in own.items():
            near(joint.blocks[0][2 * c + p, 2 * c + q], block, 1e-4 * abs(block).max())
    # None between colours, and all with the exponent.
    assert (0, 2) not in joint.blocks[0] and (1, 4) not in joint.blocks[0]
    assert all((p, 6) in joint.blocks[0] for p in range(7))
    near(np.stack(apart.right).ravel(), joint.right[0][:-144], 1e-4)


def test_a_stencil_is_the_matrix(monkeypatch):
    """With units, damping and what is expected between neighbours."""
    job, start, sigma = job_of(monkeypatch, smoothness=0.5)
    sums = equations.sum_up(job, start, sigma)
    rng = np.random.default_rng(0)
    damping = rng.uniform(0, 1, job.grid.texels)
    right = rng.normal(size=(len(sums.right[0]), 1))
    matrix = equations.make_matrix(job, sums, 0, damping)
    assert isinstance(matrix, Preconditioned)
    monkeypatch.setattr(equations, "DIRECT", 0)
    stencil = equations.make_matrix(job, sums, 0, damping)
    assert isinstance(stencil, Stencil)
    near(stencil.scale, matrix.scale, 1e-5)
    # In units of what is known of each.
    solved = (matrix.solve(right, 1e-6) / matrix.scale[:, None])[:, 0]
    near(
        stencil.solve(right, 1e-6)[:, 0] / matrix.scale,
        solved,
        1e-2 * abs(solved).max(),
    )


def test_exponents_alone_beside_numbers_of_each_material():
    diffuse, specular = (0.4, 0.3, 0.2), 0.5
    truth = painted(4, shininess=EXPONENT)
    images = photographs(truth, pf.Material(diffuse, specular, 1.0, 0.0), 0.01)
    fit = pf.fit_texture(
        scenes(4),
        images,
        size=SIZE,
        unknowns=("shininess.texture", "diffuse", "specular"),
        per_channel=("diffuse",),
        known=bare(),
    )
    assert fit.converged, fit
    for one, true in zip(fit.shared, (*diffuse, specular), strict=True):
        assert abs(one.value - true) < 4 * one.stderr < 0.05, one
    found = pulls(fit, "shininess", EXPONENT)
    assert len(found) > 130 and 0.85 < np.sqrt(np.mean(found**2)) < 1.15


@pytest.mark.extended
def test_exponents_of_each_material():
    true = [np.full((*SIZE, 1), f) for f in (15.0, 150.0)]
    mesh = plate(
        [pf.Textures(shininess=pf.Texture(one)) for one in true], material_index=[0, 1]
    )
    images = photographs(scenes(4, mesh), pf.Material(0.3, 0.4, 1.0, 0.0), 0.01)
    fit = pf.fit_texture(
        scenes(4, plate(material_index=[0, 1])),
        images,
        size=SIZE,
        unknowns=("shininess.texture",),
        known=pf.Material(0.3, 0.4, 32.0, 0.0),
        separate=True,
    )
    for layer, one in enumerate(true):
        known = np.isfinite(fit.stderr["shininess"][layer])
        assert 0.3 < known.mean() < 0.8
        off = (fit.values["shininess"][layer] - one) / fit.stderr["shininess"][layer]
        assert abs(off[known]).max() < 5


def test_what_exponents_do_not_go_with():
    images = np.zeros((2, 32, 32, 3))
    shaded = [
        dataclasses.replace(scene, shading=pf.GouraudShading()) for scene in scenes(2)
    ]
    names = ("shininess.texture",)
    given = {"size": SIZE, "known": bare()}
    with pytest.raises(ValueError, match="exponent needs Phong shading, got Gouraud"):
        pf.fit_texture(shaded, images, unknowns=names, **given)
    with pytest.raises(ValueError, match="unknowns: expected shininess or sh"):
        pf.fit_texture(scenes(2), images, unknowns=(*names, "shininess"), **given)
