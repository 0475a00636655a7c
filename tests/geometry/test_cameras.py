import math

import equinox as eqx
import jax
import numpy as np
import pytest

import phongfit as pf
from phongfit.geometry.cameras import WindowCamera
from tests.helpers import check_camera, close, floats, known, near, random_rotation

ROTATION = random_rotation(7)
rays_of = eqx.filter_jit(lambda camera: camera.rays())


@pytest.mark.parametrize(
    "camera",
    # Of one size, so that those of a kind share their programs; and a narrow one.
    [
        pf.OrthographicCamera(6, 4),
        pf.OrthographicCamera(6, 4, view_height=0.7, rotation=ROTATION),
        pf.OrthographicCamera.look_at((1, 2, 3), (0, 1, 0), width=6, height=4),
        pf.PerspectiveCamera(6, 4, fov_y=50),
        pf.PerspectiveCamera(6, 4, position=(1, 2, 3), rotation=ROTATION),
        pf.PerspectiveCamera.look_at((1, 2, 3), up=(0, 0, 1), width=3, height=5),
        pf.PinholeCamera(6, 4, fx=5, position=(1, 2, 3), rotation=ROTATION),
        pf.PinholeCamera(6, 4, fx=5, fy=6, cx=1.5, cy=3, skew=0.3),
        pf.PinholeCamera(
            6, 4, fx=9, distortion=pf.geometry.BrownDistortion(-0.2, 0.1, 0.01)
        ),
        pf.PinholeCamera(
            6, 4, fx=3, cx=2, distortion=pf.geometry.FisheyeDistortion(0.05)
        ),
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
    rays = rays_of(pf.OrthographicCamera(8, 4, view_height=4))
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
    rays = rays_of(pf.PerspectiveCamera(8, 4, fov_y=90, position=(1, 2, 3)))
    near(rays.origin[row, column], (1, 2, 3))
    near(rays.direction[row, column], np.array(through) / np.linalg.norm(through))


# A pixel is a quarter of a unit wide and half a unit high at distance 1; the axis goes
# through the corner of the first pixel.
@pytest.mark.parametrize(
    "x, y, through", [(0, 0, (0, 0, -1)), (4, 0, (1, 0, -1)), (4, 2, (0.5, -1, -1))]
)
def test_pinhole_rays(x, y, through):
    camera = pf.PinholeCamera(8, 4, fx=4, fy=2, cx=0, cy=0, skew=2, position=(1, 2, 3))
    ray = camera.ray(floats(x), floats(y))
    near(ray.direction, np.array(through) / np.linalg.norm(through))
    near(camera.project(ray.at(floats(7))), (x, y), 1e-5)


def test_a_pinhole_that_looks_through_its_middle_is_a_perspective_camera():
    rotation, focal = random_rotation(8), 2 / math.tan(math.radians(25))
    calibrated = pf.PinholeCamera(6, 4, fx=focal, position=(1, 2, 3), rotation=rotation)
    plain = pf.PerspectiveCamera(6, 4, fov_y=50, position=(1, 2, 3), rotation=rotation)
    near(rays_of(calibrated).direction, rays_of(plain).direction)
    assert calibrated.covered() is plain.covered() is None


def test_nothing_is_seen_behind_a_pinhole():
    behind = floats([0.1, 0.2, 5.0])
    for camera in (
        pf.PinholeCamera(6, 4, fx=5),
        pf.PerspectiveCamera(position=(0, 0, 4)),
    ):
        assert np.isnan(camera.project(behind)).all()


def test_pixels_past_the_fold_of_a_lens_see_nothing():
    """With k1 = −1/3 a place is never further than 2/3 from the centre."""
    lens = pf.geometry.BrownDistortion(-1 / 3)
    camera = pf.PinholeCamera(16, 16, fx=8, distortion=lens, position=(0, 0, 5))
    x, y = np.meshgrid(np.arange(16) - 7.5, np.arange(16) - 7.5)
    inside = np.hypot(x, y) / 8 < 2 / 3
    near(known(camera.covered()), inside)
    wall = pf.Sphere((0, 0, -100), 99)
    buffer = pf.geometry.trace(wall, camera)
    near(buffer.mask, inside)
    assert np.isfinite(buffer.normal).all() and np.isfinite(buffer.position).all()


@pytest.mark.parametrize(
    "wrong, words",
    [
        (dict(fx=0), "fx: expected a number > 0"),
        (dict(fx=5, fy=-1), "fy: expected a number > 0"),
        (dict(fx=5, cx=np.nan), "cx: expected a finite number"),
        (dict(fx=5, distortion=[0.1]), "distortion: expected"),
        (dict(fx=5, rotation=np.ones((3, 3))), "rotation: expected orthonormal"),
    ],
)
def test_wrong_intrinsics_are_named(wrong, words):
    with pytest.raises(ValueError, match=words):
        pf.PinholeCamera(6, 4, **wrong)


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
    near(pf.geometry.look_at(position, target, up), np.array(axes).T)


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

    directions = jax.jit(jax.vmap(middle))(floats([30.0, 60.0]))
    # The upper row of three lies two thirds up.
    heights = 2 / 3 * np.tan(np.radians([15, 30]))
    near(directions[:, 1] / -directions[:, 2], heights, 2 * close())


def test_a_window_sees_what_the_whole_does_there():
    """The same bits, past the whole's edge nothing, where a lens's fold ends it."""
    lens = pf.geometry.BrownDistortion(-0.3)
    whole = pf.PinholeCamera(12, 8, fx=4, distortion=lens)
    window = WindowCamera(whole, 5, 3, 9, 4)
    rays, part = rays_of(whole), rays_of(window)
    np.testing.assert_array_equal(part.direction[:, :7], rays.direction[3:7, 5:])
    covered, seen = whole.covered(), window.covered()
    assert covered is not None and seen is not None and not covered.all()
    np.testing.assert_array_equal(seen[:, :7], covered[3:7, 5:])
    assert not seen[:, 7:].any()
    assert WindowCamera(pf.OrthographicCamera(4, 4), 0, 0, 2, 2).parallel
    assert not window.parallel and window.covered() is not None
