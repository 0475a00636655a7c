"""lights.json gives back the calibration that wrote it."""

import dataclasses
import json
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.calibration.outlines import View
from phongfit.calibration.result import CalibratedSphere, Calibration, Lamp

UNKNOWN = np.full(3, np.nan)


def calibration(near=False, fov=20.0):
    direction = np.array([0.6, 0.0, 0.8])
    lamp = Lamp(
        "1.jpg",
        direction,
        5 * direction if near else None,
        1e-4 * np.eye(3),
        0.2,
        np.array([1.1, 1.0, 0.9]),
        np.array([0.01, 0.01, 0.02]),
        np.array([[3.5, 4.5], [np.nan, np.nan]]),
    )
    dim = dataclasses.replace(
        lamp, photograph="2.jpg", intensity=UNKNOWN, intensity_error=UNKNOWN
    )
    return Calibration(
        View(64, 48, fov),
        (lamp, dim),
        (CalibratedSphere("chrome", np.array([20.0, 20, 9]), np.eye(3)),),
        0.5,
        np.zeros(3),
        1.0 if near else 0.0,
        np.array([0.01, 0.02, 0.03]),
        {"3.jpg": "no highlight"},
        ("look at the picture",),
        None if fov else 2.5,
        1e-4 * np.eye(6) if fov else None,
        0.1 if near else 0.0,
    )


@pytest.mark.parametrize("near", [False, True])
@pytest.mark.parametrize("fov", [20.0, None])
def test_round_trip(tmp_path, near, fov):
    made = calibration(near, fov)
    pf.save_calibration(tmp_path / "lights.json", made)
    for path in (tmp_path, tmp_path / "lights.json"):
        found = pf.load_calibration(path)
        assert found.to_dict() == made.to_dict()
        assert str(found) == str(made)
        assert repr(found.camera) == repr(made.camera)
        for a, b in zip(found.lights, made.lights, strict=True):
            assert repr(a) == repr(b)


def test_a_joint_covariance_of_another_number_of_lamps(tmp_path):
    made = dataclasses.replace(calibration(), covariance=np.eye(5))
    pf.save_calibration(tmp_path / "lights.json", made)
    with pytest.raises(ValueError, match="lights.json: covariance: expected 6 rows"):
        pf.load_calibration(tmp_path)


@pytest.mark.parametrize(
    "place, value, words",
    [
        (("lights", 1, "covariance"), [[1, 0, 0], [0, -1, 0], [0, 0, 1]], "negative"),
        (("lights", 0, "covariance"), [[1, 9, 0], [0, 1, 0], [0, 0, 1]], "symmetric"),
        (("spheres", 0, "covariance"), [[1, 9, 0], [9, 1, 0], [0, 0, 1]], "negative"),
        (("covariance", 0, 0), -1, "covariance: expected a covariance, got a negative"),
        (("lights", 0, "intensity"), [1, -1, 1], "intensity: expected finite numbers"),
        (("camera", "fov_y_degrees"), None, "either fov_y_degrees or view_height"),
        (("camera", "view_height"), 2.5, "either fov_y_degrees or view_height"),
    ],
)
def test_what_cannot_be(tmp_path, place, value, words):
    data = calibration().to_dict()
    *above, last = place
    holder: Any = data
    for step in above:
        holder = holder[step]
    holder[last] = value
    head = {"format": "phongfit lights", "version": 1}
    (tmp_path / "lights.json").write_text(json.dumps(head | data))
    with pytest.raises(ValueError, match=f"lights.json: .*{words}"):
        pf.load_calibration(tmp_path)


def test_lamps_are_near_or_distant_all_of_them(tmp_path):
    near, distant = calibration(near=True), calibration()
    both = dataclasses.replace(near, lamps=(near.lamps[0], distant.lamps[0]))
    pf.save_calibration(tmp_path / "lights.json", both)
    with pytest.raises(ValueError, match="lights: expected directions alone, or"):
        pf.load_calibration(tmp_path)


def test_lights_are_of_strength_one_where_none_is_known():
    lights: Any = calibration().lights
    assert np.asarray(lights[0].intensity) == pytest.approx([1.1, 1.0, 0.9])
    assert np.asarray(lights[1].intensity) == pytest.approx([1, 1, 1])


def test_near_lights_have_their_strength_at_the_reference_point():
    light = calibration(near=True).lights[0]
    arriving = light.illuminate(jnp.zeros(3))
    assert np.asarray(arriving.intensity) == pytest.approx([1.1, 1.0, 0.9], rel=1e-5)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"position": [0, 0, 1]}, "expected either direction or position"),
        ({"direction": [0, 0, 0]}, "expected a direction, got zeros"),
        ({"direction": [0, 1]}, r"lights\[0\].direction: expected three numbers"),
        ({"intensities": 1}, "did you mean 'intensity'"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, change, message):
    path = tmp_path / "lights.json"
    pf.save_calibration(path, calibration())
    data = json.loads(path.read_text())
    data["lights"][0] |= change
    path.write_text(json.dumps(data))
    with pytest.raises(ValueError, match=message) as error:
        pf.load_calibration(path)
    assert str(path) in str(error.value)
