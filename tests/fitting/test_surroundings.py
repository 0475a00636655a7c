"""Light from all around, known and unknown, in fits."""

import numpy as np
import pytest

import phongfit as pf

pytestmark = pytest.mark.extended

SIZE = 24
NOISE = 0.005
TRUTH = pf.Material((0.5, 0.4, 0.3), 0.3, 20.0, 0.0)
SKY = np.array([1.2, 0.3, 0.2, -0.2, 0.1, 0.05, -0.1, 0.1, 0.15])
LAMP = pf.DirectionalLight((1, 1, 2), 0.5)
SURROUND = "scene.lights[1].coefficients"


def scene(sky):
    camera = pf.OrthographicCamera(SIZE, SIZE)
    return pf.Scene(pf.Sphere(), camera, (LAMP, pf.HarmonicLight(sky)))


@pytest.fixture(scope="module")
def photograph():
    image = np.asarray(pf.render(scene(SKY), TRUTH))
    noise = np.random.default_rng(6).normal(size=image.shape)
    return image + NOISE * noise


UNKNOWNS = ("diffuse", "specular", "shininess")


def test_a_known_sky(photograph):
    fit = pf.fit(scene(SKY), photograph, unknowns=UNKNOWNS)
    expected = dict(zip(("red", "green", "blue"), (0.5, 0.4, 0.3), strict=True))
    for channel, value in expected.items():
        found = fit[f"diffuse.{channel}"]
        assert abs(found.value - value) < 4 * found.error
        assert found.error < 0.002


def test_an_unknown_sky(photograph):
    """Nine numbers for all channels, told apart from ρ_d by the lamp that is known."""
    fit = pf.fit(
        scene(0.8 * SKY * (np.arange(9) < 4)),
        photograph,
        unknowns=("diffuse", SURROUND),
        per_channel=("diffuse",),
        known=TRUTH,
        ties={
            f"{SURROUND}[{k},{channel}]": f"{SURROUND}[{k},0]"
            for k in range(9)
            for channel in (1, 2)
        },
    )
    assert fit.converged, fit.warnings
    found = [fit[f"{SURROUND}[{k},0]"] for k in range(9)]
    off = [(one.value - true) / one.error for one, true in zip(found, SKY, strict=True)]
    assert np.abs(off).max() < 4, off
    assert abs(fit["diffuse.red"].value - 0.5) < 4 * fit["diffuse.red"].error


def test_a_sky_alone_is_degenerate_with_what_it_shines_on(photograph):
    """Twice the light and half the reflectance: neither gets a finite error."""
    camera = pf.OrthographicCamera(SIZE, SIZE)
    alone = pf.Scene(pf.Sphere(), camera, pf.HarmonicLight(SKY))
    image = np.asarray(pf.render(alone, TRUTH))
    noise = np.random.default_rng(7).normal(size=image.shape)
    name = "scene.lights[0].coefficients"
    fit = pf.fit(
        alone,
        image + NOISE * noise,
        unknowns=("diffuse", name),
        per_channel=(),
        known=pf.Material(0.4, 0.0, 20.0, 0.0),
    )
    assert not np.isfinite(fit["diffuse"].error)
    assert any("diffuse" in warning for warning in fit.warnings), fit.warnings
