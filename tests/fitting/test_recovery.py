"""The truth comes back: from noise-free floats, and from 8 bits with clipped pixels."""

from collections.abc import Iterator

import numpy as np
import pytest

import phongfit as pf
from tests.fitting.canonical import one_light_scene, three_lights_scene
from tests.fitting.scenes import (
    Case,
    as_vector,
    ball,
    photograph,
    random_case,
    truth,
    two_lights,
)
from tests.helpers import eps

TRUTH = truth()

EXPONENTS = (1.0, 2.0, 5.0, 20.0, 60.0, 200.0)
BALL, POINT = ball(), two_lights("point")[1]


def with_exponent(shininess: float, height: float = 1.0) -> pf.Material:
    specular = height * np.asarray(TRUTH.specular)
    return pf.Material(TRUTH.diffuse, specular, shininess, TRUTH.ambient)


def behind() -> pf.Scene:
    """A highlight that shines from behind the surface, too."""
    lights = (pf.DirectionalLight((1, 1, -0.3), 0.4), POINT)
    model = pf.Phong(gate=False)
    return pf.Scene(pf.Sphere(), BALL.camera, lights, 0.3, specular_model=model)


SCENES = {
    "two directional": (BALL, ()),
    "one light": (one_light_scene(), pytest.mark.extended),
    "each kind of light": (three_lights_scene(), ()),
    "normalized": (
        ball(specular_model=pf.BlinnPhong(normalized=True)),
        pytest.mark.extended,
    ),
    "without a gate": (behind(), pytest.mark.extended),
    # Each model and kind once; the other pairs take long, and hold what these do.
    "point, BlinnPhong": (ball("point"), pytest.mark.extended),
    "spot, Phong": (ball("spot", pf.Phong()), pytest.mark.extended),
    "spot, BlinnPhong": (ball("spot"), pytest.mark.slow),
    "directional, Phong": (ball("directional", pf.Phong()), pytest.mark.slow),
    "point, Phong": (ball("point", pf.Phong()), pytest.mark.slow),
}


@pytest.mark.parametrize(
    "kind", [pytest.param(name, marks=marks) for name, (_, marks) in SCENES.items()]
)
def test_noise_free(kind):
    """Every parameter to 1e-7, relatively, from soft to sharp highlights."""
    scene, _ = SCENES[kind]
    for shininess in EXPONENTS:
        height = 2 * np.pi / (shininess + 2) if kind == "normalized" else 1.0
        truth = with_exponent(shininess, height)
        image = np.asarray(pf.render(scene, truth))
        assert image.max() < 1
        fit = pf.fit(scene, image)
        assert fit.converged and not fit.unidentified.any()
        np.testing.assert_allclose(fit.values, as_vector(truth), rtol=1e-7)
        # Its error says so too: rounding of the arithmetic is all there is.
        assert np.all(fit.errors < 1e-8 * fit.values)
        assert fit.noise < 64 * eps()


def test_a_highlight_shines_from_behind_without_a_gate():
    truth, scene = with_exponent(20.0), behind()
    gated = pf.Scene(pf.Sphere(), BALL.camera, scene.lights, ambient=0.3)
    assert np.any(pf.render(scene, truth) != pf.render(gated, truth))


# Scenes whose lights and models are of four kinds, each of which is compiled: all three
# lights, alone and mixed, and both models are among them.
SEEDS = (2, 3, 4, 5, 6, 7, 8, 9, 10, 13, 15, 17, 18, 19, 20)
MANY = pytest.mark.parametrize(
    "count",
    [
        pytest.param(len(SEEDS), marks=pytest.mark.extended),
        pytest.param(500, marks=pytest.mark.slow),
    ],
)


def random_fits(count: int, noise: float) -> Iterator[tuple[Case, np.ndarray, pf.Fit]]:
    for seed in SEEDS if count == len(SEEDS) else range(count):
        case = random_case(seed)
        image = photograph(
            case.scene, case.material, noise=noise, film=case.film, seed=1000 + seed
        )
        fit = pf.fit(case.scene, image)
        assert fit.converged, f"seed {seed}: {fit}"
        assert np.all(np.isfinite(fit.values)) and not np.any(np.isnan(fit.errors))
        assert np.all(np.isfinite(fit.residuals))
        assert fit.film == f"clamped, 8-bit {case.film.encoding}"
        yield case, image, fit


def check_errors(
    offs: list[np.ndarray], fits: list[pf.Fit], least: float = 0.99
) -> None:
    """Most within 4 standard errors; few without an error, each for a reason."""
    identified = np.array([~fit.unidentified for fit in fits])
    within = np.abs(np.array(offs)[identified]) <= 4
    assert within.mean() >= least, f"{(~within).sum()} of {within.size} beyond 4 σ"
    assert identified.mean() >= 0.97, (
        f"{(~identified).sum()} of {identified.size} have no error"
    )
    for fit in fits:
        reasons = [w for w in fit.warnings if "not identifiable" in w]
        for label in np.array(fit.labels)[fit.unidentified]:
            assert any(label in reason for reason in reasons)
        assert np.array_equal(np.isinf(fit.errors), fit.unidentified)


@MANY
def test_random_scenes_with_noise(count):
    offs, fits, clipped = [], [], []
    for case, _, fit in random_fits(count, noise=0.01):
        offs.append((fit.values - as_vector(case.material)) / fit.errors)
        fits.append(fit)
        clipped.append(case.clipped)
        assert 0.009 < fit.noise < 0.011
    assert min(clipped) < 0.02 and 0.15 < max(clipped) < 0.21
    check_errors(offs, fits)
    # Nor are the errors too wide.
    identified = np.array([~fit.unidentified for fit in fits])
    typical = np.median(np.abs(np.array(offs)[identified]))
    assert 0.6 < typical < 0.75


@MANY
def test_random_scenes_without_noise(count):
    offs, fits = [], []
    for case, image, fit in random_fits(count, noise=0.0):
        offs.append((fit.values - as_vector(case.material)) / fit.errors)
        fits.append(fit)
        levels = [
            np.round(np.asarray(case.film.expose(light)) * 255)
            for light in (image, np.asarray(fit.fitted))
        ]
        assert np.abs(levels[0] - levels[1]).max() <= 1
    # Rounding errors are shared: in a scene that is off, several parameters are. So few
    # scenes may have more than their share.
    check_errors(offs, fits, least=0.98 if count < 500 else 0.99)
