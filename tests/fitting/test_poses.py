"""Where a calibrated camera stood, and its focal length, as unknowns of a fit."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.fitting.problem.charts import turned
from tests.helpers import floats

SIZE = 32
NOISE = 0.005
TRUTH = pf.Material(0.5, 0.3, 20.0, 0.5)
LIGHTS = (
    pf.DirectionalLight((1, 1, 2), 0.6),
    pf.PointLight((-1.5, 0.8, 1.2), 0.8, attenuation=(0, 0, 0.6)),
)
PLACE = (0.4, 0.3, 2.2)
TURN = (1.0, -1.5, 2.0)


def view(position=PLACE, degrees=(0.0, 0.0, 0.0), **lens):
    aim = jax.jit(turned)(pf.geometry.look_at(PLACE, (0, 0, 0)), floats(degrees))
    given: dict[str, Any] = dict(fx=34.0, fy=33.0, cx=17, cy=15) | lens
    camera = pf.PinholeCamera(
        SIZE, SIZE, **given, position=position, rotation=np.asarray(aim)
    )
    return pf.Scene(pf.Sphere(), camera, LIGHTS, ambient=0.2)


@pytest.fixture(scope="module")
def photograph():
    image = np.asarray(pf.render(view(degrees=TURN), TRUTH))
    noise = np.random.default_rng(4).normal(size=image.shape)
    return image + NOISE * noise


def off(fit, expected):
    """Of each unknown, in standard errors."""
    return {
        label: (fit[label].value - value) / fit[label].error
        for label, value in expected.items()
    }


@pytest.mark.extended
def test_pose_and_focal_length(photograph):
    """From half a unit and some degrees away; fy is known, and cx and cy."""
    start = view(position=(0.5, 0.2, 2.1), fx=36.0)
    fit = pf.fit(
        start,
        photograph,
        unknowns=(
            "diffuse",
            "scene.camera.rotation",
            "scene.camera.position",
            "scene.camera.fx",
        ),
        per_channel=(),
        known=TRUTH,
    )
    assert fit.converged, fit.warnings
    # Turned about its own axes from where it was: to where the photograph's was.
    angles = dict(zip("xyz", TURN, strict=True))
    expected = {f"scene.camera.rotation.{axis}": angles[axis] for axis in "xyz"}
    places = dict(zip("xyz", PLACE, strict=True))
    expected |= {f"scene.camera.position.{axis}": places[axis] for axis in "xyz"}
    expected |= {"scene.camera.fx": 34.0, "diffuse": 0.5}
    found = off(fit, expected)
    assert all(abs(sigmas) < 4 for sigmas in found.values()), found
    assert fit["scene.camera.fx"].error < 0.5
    assert jnp.isfinite(fit.covariance).all()


@pytest.mark.slow
def test_principal_point_and_lens(photograph):
    lens = pf.geometry.BrownDistortion(0.02)
    fit = pf.fit(
        view(degrees=TURN, cx=16.4, cy=15.5, distortion=lens),
        photograph,
        unknowns=(
            "diffuse",
            "scene.camera.cx",
            "scene.camera.cy",
            "scene.camera.distortion.k1",
        ),
        per_channel=(),
        known=TRUTH,
    )
    assert fit.converged, fit.warnings
    expected = {"scene.camera.cx": 17, "scene.camera.cy": 15, "diffuse": 0.5}
    found = off(fit, expected | {"scene.camera.distortion.k1": 0.0})
    assert all(abs(sigmas) < 4 for sigmas in found.values()), found
