"""The truth comes back: from noise-free floats, and from 8 bits with clipped pixels."""

from collections.abc import Iterator

import numpy as np
import pytest

import phongfit as pf
from tests.fitting.scenes import (
    SIZE,
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

DOUBLE = eps() < 1e-10
EXPONENTS = (1.0, 2.0, 5.0, 20.0, 60.0, 200.0)
KINDS = ("directional", "point", "spot")


def check_exact(scene: pf.Scene, truth: pf.Material) -> None:
    """Every parameter to 1e-4 in single precision, 1e-7 in double, relatively."""
    image = np.asarray(pf.render(scene, truth))
    assert image.max() < 1
    fit = pf.fit(scene, image)
    assert fit.converged and not fit.unidentified.any()
    np.testing.assert_allclose(
        fit.values, as_vector(truth), rtol=1e-7 if DOUBLE else 1e-4
    )
    # Its error says so too: rounding of the arithmetic is all there is.
    assert np.all(fit.errors < (1e-8 if DOUBLE else 1e-2) * fit.values)
    assert fit.noise < 64 * eps()


def with_exponent(shininess: float, height: float = 1.0) -> pf.Material:
    specular = height * np.asarray(TRUTH.specular)
    return pf.Material(TRUTH.diffuse, specular, shininess, TRUTH.ambient)


@pytest.mark.parametrize("shininess", EXPONENTS)
@pytest.mark.parametrize(
    "model, kind",
    [
        # Each of both once; the other pairs take long, and hold what these do.
        (pf.BlinnPhong(), "point"),
        (pf.Phong(), "spot"),
        *(
            pytest.param(model, kind, marks=pytest.mark.slow)
            for model in (pf.BlinnPhong(), pf.Phong())
            for kind in KINDS
            if (type(model), kind) not in ((pf.BlinnPhong, "point"), (pf.Phong, "spot"))
        ),
    ],
)
def test_noise_free(model, kind, shininess):
    check_exact(ball(kind, model), with_exponent(shininess))


@pytest.mark.parametrize("shininess", EXPONENTS)
def test_noise_free_normalized(shininess):
    scene = ball(specular_model=pf.BlinnPhong(normalized=True))
    check_exact(scene, with_exponent(shininess, 2 * np.pi / (shininess + 2)))


@pytest.mark.parametrize("shininess", EXPONENTS)
def test_noise_free_without_a_gate(shininess):
    lights = (pf.DirectionalLight((1, 1, -0.3), 0.4), two_lights("point")[1])
    model = pf.Phong(gate=False)
    scene = pf.Scene(
        pf.Sphere(), ball().camera, lights, ambient=0.3, specular_model=model
    )
    gated = pf.Scene(pf.Sphere(), ball().camera, lights, ambient=0.3)
    truth = with_exponent(shininess)
    assert np.any(pf.render(scene, truth) != pf.render(gated, truth))
    check_exact(scene, truth)


@pytest.mark.parametrize("shininess", EXPONENTS)
def test_noise_free_under_one_light(shininess):
    light = pf.DirectionalLight((1, 1, 2), 0.5)
    scene = pf.Scene(pf.Sphere(), ball().camera, light, ambient=0.3)
    check_exact(scene, with_exponent(shininess))


@pytest.mark.parametrize("shininess", EXPONENTS)
def test_noise_free_under_a_light_of_each_kind(shininess):
    lights = [two_lights(kind)[kind != "directional"] for kind in KINDS]
    camera = pf.PerspectiveCamera(SIZE, SIZE, position=(0.5, 0.2, 4.5), fov_y=28)
    scene = pf.Scene(pf.Sphere(), camera, lights, ambient=(0.3, 0.2, 0.4))
    check_exact(scene, with_exponent(shininess))


# Scenes whose lights and models are of four kinds, each of which is compiled: all three
# lights, alone and mixed, and both models are among them.
SEEDS = (2, 3, 4, 5, 6, 7, 8, 9, 10, 13, 15, 17, 18, 19, 20)
# These always; all with `-m slow`.
MANY = pytest.mark.parametrize(
    "count", [len(SEEDS), pytest.param(500, marks=pytest.mark.slow)]
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
