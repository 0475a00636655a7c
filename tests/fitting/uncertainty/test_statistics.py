"""Stated errors against what really happens, and against lmfit's."""

from functools import lru_cache
from typing import Any

import lmfit
import numpy as np
import pytest

import phongfit as pf
from phongfit.fitting.problem.parameters import MATERIAL_PARAMETERS
from phongfit.fitting.uncertainty.identifiability import (
    find_unidentified,
    linked_groups,
)
from phongfit.fitting.uncertainty.statistics import Statistics
from tests.fitting import canonical
from tests.fitting.canonical import NOISE
from tests.fitting.scenes import (
    as_vector,
    ball,
    developed,
    photograph,
    truth,
    unknowns_of,
)

TRUTH = truth()

SCENE = ball()
DRAWS = 250


@lru_cache
def draws(encoding: str) -> tuple[np.ndarray, np.ndarray]:
    """(estimate − truth) / error of many noisy photographs, and the estimates."""
    bright, film = 1.0, pf.Film()
    if encoding != "none":
        # Exposed for some white pixels, and rounded.
        bright, film = 1.9, pf.Film(encoding="srgb", bits=8)
    lights = [
        pf.DirectionalLight(light.direction, bright * light.intensity)
        for light in SCENE.lights
        if isinstance(light, pf.DirectionalLight)
    ]
    scene = pf.Scene(pf.Sphere(), SCENE.camera, lights, ambient=0.3 * bright)
    light = np.asarray(pf.render(scene, TRUTH, film=pf.Film(clamp=False)), float)
    rng = np.random.default_rng(0)
    offs, values = [], []
    for _ in range(DRAWS):
        image = developed(light + NOISE * rng.normal(size=light.shape), film)
        if encoding != "none":
            assert 0.01 < np.mean(image[image > 0] >= 1) < 0.1
        fit = pf.fit(scene, image)
        offs.append((fit.values - as_vector(TRUTH)) / fit.errors)
        values.append(fit.values)
    return np.array(offs), np.array(values)


@pytest.mark.extended
@pytest.mark.parametrize("encoding", ["none", "srgb"])
def test_errors_are_what_happens(encoding):
    offs, _ = draws(encoding)
    # Of 250 draws the spread is known to 4.5 %: four times that is allowed.
    spread = np.sqrt(np.mean(offs**2, axis=0))
    assert np.all(np.abs(spread - 1) < 0.18), spread
    # All ten together are known better, though they are not independent.
    assert abs(np.sqrt(np.mean(offs**2)) - 1) < 0.07
    # No bias.
    assert np.all(np.abs(offs.mean(axis=0)) < 4 / np.sqrt(DRAWS))
    assert 0.935 < np.mean(np.abs(offs) < 2) < 0.97
    assert 0.64 < np.mean(np.abs(offs) < 1) < 0.725


@pytest.mark.extended
def test_correlations_are_what_happens():
    _, values = draws("none")
    fit = canonical.two_directional().fit
    assert np.allclose(fit.correlation, np.corrcoef(values.T), atol=0.25)
    assert np.max(np.abs(fit.correlation[~np.eye(10, dtype=bool)])) > 0.8


def lmfit_result(image: np.ndarray, scale_covar: bool) -> Any:
    """What lmfit says of the same image, with a model written out in NumPy."""
    buffer = SCENE.trace()
    seen = np.asarray(buffer.mask)
    terms = pf.terms(SCENE, buffer)
    ambient, diffuse, cosine, strength = (
        np.asarray(part, float)[seen]
        for part in (terms.ambient, terms.diffuse, terms.cosine, terms.strength)
    )

    def residual(parameters):
        values = np.array([p.value for p in parameters.values()])
        lobe = np.maximum(cosine, 1e-30)[..., None] ** values[9]
        highlight = np.sum(strength * lobe, axis=1)
        light = values[:3] * ambient + values[3:6] * diffuse + values[6:9] * highlight
        return ((light - image[seen]) / NOISE).ravel()

    parameters = lmfit.Parameters()
    for k, value in enumerate(as_vector(TRUTH)):
        parameters.add(f"p{k}", value=1.05 * value)
    return lmfit.minimize(
        residual, parameters, method="leastsq", scale_covar=scale_covar
    )


@pytest.mark.parametrize(
    "noise", [None, pytest.param(NOISE, marks=pytest.mark.extended)]
)
def test_errors_are_lmfits(noise):
    image = photograph(SCENE, TRUTH, noise=NOISE, seed=3)
    assert image.max() < 1
    fit = pf.fit(SCENE, image, noise=noise)
    expected = lmfit_result(image, scale_covar=noise is None)
    errors = [p.stderr for p in expected.params.values()]
    np.testing.assert_allclose(fit.errors, errors, rtol=0.01)
    values = np.array([p.value for p in expected.params.values()])
    assert np.all(np.abs(fit.values - values) < 0.01 * fit.errors)
    deviation = np.sqrt(np.diag(expected.covar))
    correlation = expected.covar / np.outer(deviation, deviation)
    np.testing.assert_allclose(fit.correlation, correlation, atol=0.01)
    if noise:
        assert fit.reduced_chi_squared == pytest.approx(expected.redchi, rel=1e-3)
    else:
        assert np.isnan(fit.reduced_chi_squared)
    assert fit.degrees_of_freedom == expected.nfree


@pytest.mark.extended
def test_more_noise_in_some_pixels():
    """Weights from known noise: better than without, and stated so."""
    rng = np.random.default_rng(5)
    light = photograph(SCENE, TRUTH)
    sigma = np.where(rng.random(light.shape[:2]) < 0.5, 0.03, 0.003)
    offs = []
    image, fit = light, None
    for _ in range(20):
        image = light + sigma[..., None] * rng.normal(size=light.shape)
        fit = pf.fit(SCENE, image, noise=sigma, film=pf.Film(clamp=False))
        offs.append((fit.values - as_vector(TRUTH)) / fit.errors)
        assert 0.85 < fit.reduced_chi_squared < 1.15
    assert 0.8 < np.sqrt(np.mean(np.square(offs))) < 1.2
    plain = pf.fit(SCENE, image, film=pf.Film(clamp=False))
    assert fit is not None and np.all(fit.errors < 0.4 * plain.errors)


LAYOUT = unknowns_of(MATERIAL_PARAMETERS[1:4], (), pf.Material(), {})


@pytest.mark.parametrize(
    "rows, unidentified, words",
    [
        ([[1, 0, 0], [0, 1, 0], [0, 0, 1]], [], None),
        (
            [[1, 0, 0], [0, 1, 0], [0, 0, 0]],
            [2],
            "shininess is not identifiable: there is",
        ),
        (
            [[1, 0, 0], [0, 0, 0], [0, 0, 1]],
            [1],
            "specular is not identifiable: no pixel",
        ),
        ([[1, 1, 0], [0, 0, 1]], [0, 1], "diffuse, specular are degenerate"),
        ([[1, 1, 2], [1, 1, 3]], [0, 1], "diffuse, specular are degenerate"),
        ([[1, 2, 3]], [0, 1, 2], "diffuse, specular, shininess are degenerate"),
        # Units do not decide: far smaller than the others, but alone.
        ([[1, 0, 0], [0, 1e-2, 0], [0, 0, 1e2]], [], None),
        # Nearly degenerate is not degenerate.
        ([[1, 1, 0], [0, 0.001, 0], [0, 0, 1]], [], None),
    ],
)
def test_who_is_not_identifiable(rows, unidentified, words):
    jacobian = np.array(rows, float)
    flags, reasons = find_unidentified(jacobian.T @ jacobian, LAYOUT, np.ones(3), 1e-7)
    assert np.flatnonzero(flags).tolist() == unidentified
    assert len(reasons) == (0 if words is None else 1)
    if words:
        assert reasons[0].startswith(words)


def test_linked_groups():
    linked = np.array(
        [[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=bool
    )
    groups = linked_groups(linked, np.array([True, True, True, False]))
    assert [group.tolist() for group in groups] == [[0, 1], [2]]


def test_a_variance_that_rounding_made_negative_is_an_infinite_error():
    none = np.zeros(2, bool)
    covariance = np.diag([4.0, -4e-3])
    sandwich: Any = None
    found = Statistics(sandwich, covariance, np.ones(2), none, none, 1.0, (), none)
    assert found.stderr.tolist() == [2, np.inf]
    assert found.scale == 0.25
