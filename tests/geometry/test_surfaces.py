import math

import jax
import numpy as np
import pytest

import phongfit as pf
from phongfit.geometry.cameras import Ray
from tests.helpers import check_surface, eps, floats, near, random_units


def map_like(height=2, width=3, seed=0):
    """Normals of any length that face +z, and positions near the origin."""
    rng = np.random.default_rng(seed)
    normals = rng.uniform(-0.6, 0.6, (height, width, 3)) + np.array([0, 0, 2])
    return normals, rng.uniform(-0.3, 0.3, (height, width, 3))


NORMALS, POSITIONS = map_like()
SMALL = pf.OrthographicCamera(3, 2)


SURFACES = [
    (pf.Sphere(), pf.OrthographicCamera(4, 3)),
    (pf.Sphere((0.2, 0.1, -1), 0.7), pf.PerspectiveCamera(3, 3, fov_y=10)),
    (
        pf.Sphere(radius=0.3),
        pf.PerspectiveCamera.look_at((1, 1, 2), width=3, height=3),
    ),
    (pf.NormalMap(NORMALS), SMALL),
    (pf.NormalMap(NORMALS, np.eye(2, 3), POSITIONS), SMALL),
    (pf.NormalMap(NORMALS, None, POSITIONS), pf.PerspectiveCamera(3, 2)),
]


@pytest.mark.parametrize("surface, camera", SURFACES)
def test_contract(surface, camera):
    check_surface(surface, camera)


@pytest.mark.extended
@pytest.mark.parametrize("surface, camera", SURFACES)
def test_contract_to_second_order(surface, camera):
    check_surface(surface, camera, order=2)


# A ray of an orthographic view that meets the unit sphere at (x, y), where the normal
# is the place itself: z = sqrt(1 - x² - y²). A pixel is 0.2 wide here.
@pytest.mark.parametrize(
    "row, column, x, y",
    [(5, 5, 0, 0), (5, 8, 0.6, 0), (1, 5, 0, 0.8), (6, 3, -0.4, -0.2)],
)
def test_normals_of_the_unit_sphere(row, column, x, y):
    buffer = pf.geometry.trace(
        pf.Sphere(), pf.OrthographicCamera(11, 11, view_height=2.2)
    )
    expected = (x, y, math.sqrt(1 - x**2 - y**2))
    assert buffer.mask[row, column]
    near(buffer.normal[row, column], expected)
    near(buffer.position[row, column], expected)
    near(buffer.to_viewer[row, column], (0, 0, 1))


def test_mask_of_the_unit_sphere():
    buffer = pf.geometry.trace(
        pf.Sphere(), pf.OrthographicCamera(11, 11, view_height=2.2)
    )
    x, y = np.meshgrid(np.linspace(-1, 1, 11), np.linspace(1, -1, 11))
    inside = np.hypot(x, y)
    sure = np.abs(inside - 1) > 1e-3
    assert np.array_equal(np.asarray(buffer.mask)[sure], (inside < 1)[sure])


def test_perspective():
    # From (0, 0, 2), 30° up touches the unit sphere; straight on is its pole.
    buffer = pf.geometry.trace(
        pf.Sphere(), pf.PerspectiveCamera(1, 1, position=(0, 0, 2))
    )
    near(buffer.position[0, 0], (0, 0, 1))
    for half_angle, seen in ((29.9, True), (30.1, False)):
        # Two rows of pixels, whose centres are at half of the height from the middle.
        fov = 2 * math.degrees(math.atan(2 * math.tan(math.radians(half_angle))))
        camera = pf.PerspectiveCamera(1, 2, fov_y=fov, position=(0, 0, 2))
        assert np.all(pf.geometry.trace(pf.Sphere(), camera).mask == seen)


@pytest.mark.parametrize(
    "surface, camera",
    [
        (pf.Sphere((0, 0, 10)), pf.OrthographicCamera(3, 3)),
        (pf.Sphere((0, 0, 10)), pf.PerspectiveCamera(3, 3)),
        (pf.Sphere(radius=20), pf.OrthographicCamera(3, 3)),
        (pf.Sphere(radius=20), pf.PerspectiveCamera(3, 3)),
        (pf.Sphere((100, 0, 0)), pf.PerspectiveCamera(3, 3)),
    ],
    ids=["behind", "behind pinhole", "from inside", "pinhole inside", "beside"],
)
def test_nothing_is_seen(surface, camera):
    buffer = pf.geometry.trace(surface, camera)
    assert not buffer.mask.any()
    for leaf in (buffer.position, buffer.normal, buffer.to_viewer):
        assert np.all(np.isfinite(leaf))


@pytest.mark.parametrize("distance", [10.0, 1e3, 1e5])
def test_far_away_in_single_precision(distance):
    """The textbook's b² − 4ac loses all of its digits here."""
    sphere = pf.Sphere((0, 0, -distance), 1)
    buffer = pf.geometry.trace(sphere, pf.OrthographicCamera(11, 11, view_height=2.2))
    near(buffer.normal[5, 8], (0.6, 0, 0.8), 1e-5)
    fov = 2 * math.degrees(math.atan(1.1 / (distance + 5)))
    buffer = pf.geometry.trace(sphere, pf.PerspectiveCamera(11, 11, fov_y=fov))
    # The pinhole sees it a little from the side, and rounding turns each ray a little.
    tolerance = 2 / distance + 2 * eps() * distance
    near(buffer.normal[5, 8], (0.6, 0, 0.8), tolerance)


def test_intersect_random_rays():
    """Every hit lies on the sphere and on its ray, in front of it."""
    sphere = pf.Sphere((0.3, -0.2, 0.1), 1.5)
    origins = floats(4 * random_units(50, 1))
    rays = Ray(origins, floats(-random_units(50, 1)))
    found = jax.jit(jax.vmap(sphere.intersect))(rays)
    position, normal, hit = map(np.asarray, found)
    assert np.all(hit)
    near(np.linalg.norm(position - np.array([0.3, -0.2, 0.1]), axis=1), 1.5)
    along, direction = position - np.asarray(origins), np.asarray(rays.direction)
    near(np.cross(along, direction), np.zeros((50, 3)))
    assert np.all(np.sum(along * direction, axis=1) > 0)
    assert np.all(np.sum(normal * direction, axis=1) < 0)


def test_normal_map_normalizes():
    buffer = pf.geometry.trace(pf.NormalMap(NORMALS), SMALL)
    near(buffer.normal, NORMALS / np.linalg.norm(NORMALS, axis=-1, keepdims=True))
    assert buffer.mask.all()
    near(buffer.position, np.zeros((2, 3, 3)))
    near(buffer.to_viewer, np.broadcast_to([0, 0, 1], (2, 3, 3)))


def test_normal_map_keeps_positions():
    buffer = pf.geometry.trace(pf.NormalMap(NORMALS, positions=POSITIONS), SMALL)
    near(buffer.position, POSITIONS)
    camera = pf.PerspectiveCamera(3, 2, position=(0, 0, 2))
    towards = np.array([0, 0, 2]) - POSITIONS
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    near(
        pf.geometry.trace(pf.NormalMap(NORMALS, None, POSITIONS), camera).to_viewer,
        towards,
    )


def test_outside_the_mask_nothing_matters():
    """Zero normals are outside; what is outside may be NaN."""
    normals, positions = NORMALS.copy(), POSITIONS.copy()
    normals[0, 0] = 0
    normals[0, 1], positions[0, 1] = math.nan, math.inf
    mask = np.ones((2, 3), bool)
    mask[0, 1] = mask[1, 2] = False
    buffer = pf.geometry.trace(pf.NormalMap(normals, mask, positions), SMALL)
    assert np.array_equal(buffer.mask, [[False, False, True], [True, True, False]])
    near(np.linalg.norm(buffer.normal, axis=-1), np.ones((2, 3)))
    assert np.all(np.isfinite(buffer.position))


@pytest.mark.parametrize(
    "camera, message",
    [
        (
            pf.OrthographicCamera(2, 3),
            r"^surface: expected .*\(3, 2\) pixels.*got \(2, 3\)",
        ),
        (pf.PerspectiveCamera(3, 2), "^surface: .*orthographic"),
    ],
)
def test_normal_map_and_camera_must_fit_together(camera, message):
    with pytest.raises(ValueError, match=message):
        pf.geometry.trace(pf.NormalMap(NORMALS), camera)
