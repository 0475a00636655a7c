"""Height fields: their points, triangles and shadows."""

import numpy as np
import pytest

import phongfit as pf
from phongfit.geometry.height import positions_at, shadow_shares

CAMERA = pf.OrthographicCamera(40, 32, view_height=32.0, position=(0, 0, 50))


def wall(height: float = 5.0) -> np.ndarray:
    """A floor at 0, and a wall of a height over columns 18 to 21."""
    field = np.zeros((32, 40))
    field[:, 18:22] = height
    return field


def test_points_lie_where_pixels_look():
    points = positions_at(wall(), CAMERA)
    np.testing.assert_allclose(points[0, 0], [-19.5, 15.5, 0], atol=1e-4)
    np.testing.assert_allclose(points[31, 20], [0.5, -15.5, 5], atol=1e-4)
    camera = pf.PerspectiveCamera.look_at((3, 2, 4), width=40, height=32)
    gbuffer = pf.geometry.trace(pf.Sphere(), camera)
    mask, points = np.asarray(gbuffer.mask), np.asarray(gbuffer.position)
    height = np.where(mask, points @ np.asarray(camera.rotation)[:, 2], np.nan)
    np.testing.assert_allclose(positions_at(height, camera)[mask], points[mask], 1e-4)


def test_triangles_face_the_camera():
    height = wall()
    height[:, :3] = np.nan
    mesh = pf.geometry.HeightField(height, np.ones((32, 40), int), CAMERA).mesh()
    assert len(mesh.vertices) == 32 * 37 and len(mesh.faces) == 2 * 31 * 36
    assert np.all(np.asarray(mesh.face_normals())[:, 2] > 0)


@pytest.mark.parametrize("steep", [0.5, 1.0, 2.0])
def test_a_wall_throws_its_shadow_as_far_as_it_should(steep):
    """From the right at slope 2, a wall of 5 darkens 2.5 pixels to its left."""
    lights = [pf.DirectionalLight((1, 0, steep)), pf.DirectionalLight((-1, 0, steep))]
    left, right = pf.geometry.cast_shadows(wall(), CAMERA, lights)
    # The left edge of its top lies over column 18, the foot of its side under 17.
    dark = 18 - np.argmax(left[16, :18])
    assert abs(dark - 5 / steep) <= 1
    assert not left[:, 18:].any()
    np.testing.assert_array_equal(right, left[:, ::-1])


def test_near_lights_and_holes():
    above = pf.PointLight((0, 0, 30.0))
    beside = pf.PointLight((-19.5, 0, 2.0))
    below = wall()
    below[10:20, 18:22] = np.nan
    overhead, aside = pf.geometry.cast_shadows(below, CAMERA, [above, beside])
    assert not overhead[:, 19:21].any()
    # Behind the wall, of a lamp that is lower, but for what the gap lets through.
    assert aside[2, 25:].all() and not aside[15, 25:].any() and not aside[2, :17].any()
    assert not aside[10:20, 18:22].any()
    # A lamp before the wall does not care for what is behind itself.
    assert not pf.geometry.cast_shadows(wall(), CAMERA, [pf.PointLight((10.0, 0, 3))])[
        0, :, 24:
    ].any()


def test_a_shadow_has_soft_pixels_at_its_edge_alone():
    light = pf.DirectionalLight((1, 0.3, 1.3))
    (share,) = shadow_shares(wall(), CAMERA, [light])
    (hard,) = pf.geometry.cast_shadows(wall(), CAMERA, [light])
    assert set(np.unique(share)) <= {0, 0.25, 0.5, 0.75, 1}
    assert 0 < np.mean((share > 0) & (share < 1)) < 0.1
    assert np.mean((share > 0.5) != hard) < 0.03


def test_flat_and_turned():
    """Nothing throws a shadow on a plane, however it is turned to the camera."""
    y, x = np.mgrid[:32, :40]
    tilted = 0.8 * x - 0.5 * y
    lights = [pf.DirectionalLight(d) for d in ((1, 0, 0.9), (-1, 1, 0.5), (0, -1, 1))]
    assert not pf.geometry.cast_shadows(tilted, CAMERA, lights).any()


def test_bad_arguments():
    with pytest.raises(ValueError, match="height: expected numbers of shape"):
        pf.geometry.cast_shadows(np.zeros((3, 3)), CAMERA, [])
    assert pf.geometry.cast_shadows(np.zeros((32, 40)), CAMERA, []).shape == (0, 32, 40)
