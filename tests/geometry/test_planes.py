"""A plane before a camera."""

import numpy as np

import phongfit as pf
from phongfit.geometry.planes import plane_before
from tests.helpers import near

TURNED = {"target": (1.0, 2.0, -3.0), "position": (0.5, 0.0, 1.0)}


def test_a_pinhole_sees_it_at_distance_1():
    camera = pf.PerspectiveCamera.look_at(fov_y=50, width=6, height=4, **TURNED)
    plane = plane_before(camera)
    axis = np.asarray(camera.rotation)[:, 2]
    near(np.asarray(plane.normals), np.broadcast_to(axis, (4, 6, 3)))
    off = np.asarray(plane.positions) - TURNED["position"]
    near(off @ axis, np.full((4, 6), -1.0))
    # Each pixel sees its own point.
    rays = np.asarray(camera.rays().direction)
    near(off / np.linalg.norm(off, axis=-1, keepdims=True), rays)


def test_parallel_rays_meet_it_in_the_origin_or_a_given_point():
    camera = pf.OrthographicCamera(6, 4)
    for same_rays in (camera, camera.finer(2)):
        assert np.allclose(np.asarray(plane_before(same_rays).positions)[..., 2], 0)
    moved = plane_before(camera, (7.0, 8.0, -2.0))
    assert np.allclose(np.asarray(moved.positions)[..., 2], -2)
