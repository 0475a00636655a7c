import math

import jax
import numpy as np
import pytest

import phongfit as pf
from tests.helpers import CLOSE, check_camera, floats, near, random_rotation

ROTATION = random_rotation(7)


@pytest.mark.parametrize(
    "camera",
    [
        pf.OrthographicCamera(6, 4),
        pf.OrthographicCamera(3, 5, view_height=0.7, rotation=ROTATION),
        pf.OrthographicCamera.look_at((1, 2, 3), (0, 1, 0), width=4, height=4),
        pf.PerspectiveCamera(6, 4, fov_y=50),
        pf.PerspectiveCamera(3, 5, position=(1, 2, 3), rotation=ROTATION),
        pf.PerspectiveCamera.look_at((1, 2, 3), up=(0, 0, 1), width=4, height=2),
    ],
)
def test_contract(camera):
    check_camera(camera)


# A view 4 units high and 8 × 4 pixels: a pixel is one unit wide.
@pytest.mark.parametrize(
    "row, column, origin",
    [
        (0, 0, (-3.5, 1.5, 5)),
        (0, 7, (3.5, 1.5, 5)),
        (3, 0, (-3.5, -1.5, 5)),
        (1, 4, (0.5, 0.5, 5)),
    ],
)
def test_orthographic_rays(row, column, origin):
    rays = pf.OrthographicCamera(8, 4, view_height=4).rays()
    near(rays.origin[row, column], origin)
    near(rays.direction[row, column], (0, 0, -1))


# 90° high: the image plane at distance 1 is 2 units high, a pixel half a unit wide.
@pytest.mark.parametrize(
    "row, column, through",
    [
        (0, 0, (-1.75, 0.75, -1)),
        (0, 7, (1.75, 0.75, -1)),
        (3, 0, (-1.75, -0.75, -1)),
        (1, 4, (0.25, 0.25, -1)),
    ],
)
def test_perspective_rays(row, column, through):
    rays = pf.PerspectiveCamera(8, 4, fov_y=90, position=(1, 2, 3)).rays()
    near(rays.origin[row, column], (1, 2, 3))
    near(rays.direction[row, column], np.array(through) / np.linalg.norm(through))


def test_field_of_view():
    camera = pf.PerspectiveCamera(2, 2, fov_y=60)
    top = camera.ray(floats(1), floats(0))
    near(top.direction, (0, math.sin(math.pi / 6), -math.cos(math.pi / 6)))


# position, target, up, then the camera's axes x, y, z in the world.
@pytest.mark.parametrize(
    "position, target, up, axes",
    [
        ((0, 0, 5), (0, 0, 0), (0, 1, 0), [(1, 0, 0), (0, 1, 0), (0, 0, 1)]),
        ((0, 0, -5), (0, 0, 0), (0, 1, 0), [(-1, 0, 0), (0, 1, 0), (0, 0, -1)]),
        ((5, 1, 0), (0, 1, 0), (0, 9, 0), [(0, 0, -1), (0, 1, 0), (1, 0, 0)]),
        ((0, 3, 0), (0, 0, 0), (0, 1, -1), [(1, 0, 0), (0, 0, -1), (0, 1, 0)]),
        ((0, 0, 5), (0, 0, 0), (0, 1e-9, 0), [(1, 0, 0), (0, 1, 0), (0, 0, 1)]),
    ],
)
def test_look_at(position, target, up, axes):
    near(pf.look_at(position, target, up), np.array(axes).T)


@pytest.mark.parametrize("kind", [pf.OrthographicCamera, pf.PerspectiveCamera])
def test_look_at_puts_the_target_in_the_centre(kind):
    camera = kind.look_at((3, 2, 1), (0.5, 0, -1), width=4, height=4)
    ray = camera.ray(floats(2), floats(2))
    to_target = np.array([0.5, 0, -1]) - np.array([3, 2, 1])
    near(ray.direction, to_target / np.linalg.norm(to_target))
    near(camera.depth(floats([0.5, 0, -1])), np.linalg.norm(to_target))
    assert camera.rotation[1, 1] > 0, "up stays up"
    near(np.linalg.det(camera.rotation), 1)


def test_cameras_are_batched_by_vmap():
    def middle(angle):
        return pf.PerspectiveCamera(3, 3, fov_y=angle).rays().direction[0, 1]

    directions = jax.vmap(middle)(floats([30.0, 60.0]))
    # The upper row of three lies two thirds up.
    heights = 2 / 3 * np.tan(np.radians([15, 30]))
    near(directions[:, 1] / -directions[:, 2], heights, 2 * CLOSE)
