"""Cameras of others: a table of axes, and the same points at the same pixels."""

import json

import equinox as eqx
import jax
import numpy as np
import pytest

import phongfit as pf
from phongfit.geometry.conventions import AXES
from tests.geometry.others_cameras import FILE
from tests.helpers import close, eps, floats, near, random_rotation

OTHERS = json.loads(FILE.read_text())
WIDTH, HEIGHT = OTHERS["size"]
POINTS = np.array(OTHERS["opencv"]["points"])
VIEWS = OTHERS["opencv"]["views"]
# Of some hundred pixels, in the run's precision.
PIXELS = 1e-3 if eps() > 1e-10 else 1e-9


@eqx.filter_jit
def project(camera, points):
    return jax.vmap(camera.project)(points)


def projected(camera, points=POINTS):
    return np.asarray(project(camera, floats(points)))


def of_view(view, **changed):
    given = {"distortion": view["distortion"], "fisheye": view["lens"] == "fisheye"}
    return pf.geometry.camera_from_opencv(
        view["matrix"],
        view["rotation"],
        view["translation"],
        width=WIDTH,
        height=HEIGHT,
        **given | changed,
    )


@pytest.mark.parametrize("view", VIEWS, ids=lambda view: view["lens"])
def test_opencv_projects_to_the_same_pixels(view):
    """OpenCV's own answers; its first pixel has its centre at 0, ours at 0.5."""
    expected = np.array(view["pixels"]) + 0.5
    near(projected(of_view(view)), expected, PIXELS)
    near(projected(of_view({**view, "rotation": view["R"]})), expected, PIXELS)


def test_mitsuba_looks_the_same_way():
    mitsuba = OTHERS["mitsuba"]
    position, rotation = pf.geometry.camera_pose(mitsuba["to_world"], "mitsuba")
    camera = pf.PerspectiveCamera(
        WIDTH, HEIGHT, fov_y=mitsuba["fov_y"], position=position, rotation=rotation
    )
    film = floats(np.array(mitsuba["film"]) * (WIDTH, HEIGHT))
    rays = jax.vmap(camera.ray)(film[:, 0], film[:, 1])
    near(rays.direction, mitsuba["directions"], 1e-5)
    near(camera.position, [1, 2, 4], 1e-6)


# Where a point of the world comes to lie in an image, as each convention's own
# documents have it: from what takes the world to the camera, and focal length and
# centre in pixels.


def _opencv(point, view, focal, centre):
    x, y, z = (view @ [*point, 1])[:3]
    return centre[0] + focal * x / z, centre[1] + focal * y / z


def _opengl(point, view, focal, centre):
    """By way of clip coordinates, as of gluPerspective and glViewport."""
    eye = view @ [*point, 1]
    clip = np.diag([2 * focal / WIDTH, 2 * focal / HEIGHT, -1, 0]) @ eye
    x, y = clip[:2] / -eye[2]
    assert centre == (WIDTH / 2, HEIGHT / 2)
    return WIDTH * (x + 1) / 2, HEIGHT * (1 - y) / 2


def _blender(point, view, focal, centre):
    """As bpy_extras.object_utils.world_to_camera_view, whose y goes up from 0 to 1."""
    x, y, z = (view @ [*point, 1])[:3]
    share = [0.5 + focal * x / -z / WIDTH, 0.5 + focal * y / -z / HEIGHT]
    assert centre == (WIDTH / 2, HEIGHT / 2)
    return share[0] * WIDTH, (1 - share[1]) * HEIGHT


def _left(point, view, focal, centre):
    """Of PyTorch3D and Mitsuba: x to the left, y up, z ahead."""
    x, y, z = (view @ [*point, 1])[:3]
    return centre[0] - focal * x / z, centre[1] - focal * y / z


@pytest.mark.parametrize(
    "axes, project",
    [
        ("opencv", _opencv),
        ("colmap", _opencv),
        ("phongfit", _opengl),
        ("opengl", _opengl),
        ("nerf", _blender),
        ("blender", _blender),
        ("pytorch3d", _left),
        ("mitsuba", _left),
    ],
)
def test_every_convention_sees_the_same_points(axes, project):
    """A camera that was set up in each, and what each says of the same points."""
    camera = pf.PinholeCamera(
        WIDTH, HEIGHT, fx=700, position=(1, 2, 4), rotation=random_rotation(3)
    )
    back = np.asarray(camera.rotation)[:, 2]
    points = np.array(camera.position) - 5 * back + 0.5 * POINTS
    to_world = pf.geometry.camera_to_world(camera, axes)
    view, centre = np.linalg.inv(to_world), (WIDTH / 2, HEIGHT / 2)
    expected = [project(point, view, 700.0, centre) for point in points]
    near(projected(camera, points), expected, PIXELS)
    position, rotation = pf.geometry.camera_pose(to_world, axes)
    near(position, camera.position)
    near(rotation, camera.rotation)


def test_all_conventions_are_tested():
    tested = test_every_convention_sees_the_same_points.pytestmark[0].args[1]  # pyright: ignore
    assert {axes for axes, _ in tested} == set(AXES)


@pytest.mark.parametrize("factor", [1, -3.3, 1e-4])
@pytest.mark.parametrize("first_pixel", [0.0, 0.5])
def test_a_projection_matrix(factor, first_pixel):
    view = VIEWS[0]
    k = np.array(view["matrix"])
    k[0, 1] = 3.0
    matrix = k @ np.column_stack([view["R"], view["translation"]])
    camera = pf.geometry.camera_from_matrix(
        factor * matrix, width=WIDTH, height=HEIGHT, first_pixel=first_pixel
    )
    near(camera.skew, 3, 1e-4)
    near(camera.fx, k[0, 0], 1e-5)
    image = (matrix @ np.column_stack([POINTS, np.ones(len(POINTS))]).T).T
    expected = image[:, :2] / image[:, 2:] + 0.5 - first_pixel
    near(projected(camera), expected, PIXELS)
    assert all(camera.depth(floats(point)) > 0 for point in POINTS)


EYE = np.eye(4)[:3]


@pytest.mark.parametrize(
    "call, words",
    [
        (
            lambda: pf.geometry.camera_pose(np.eye(3), "opencv"),
            "to_world: expected numbers of",
        ),
        (lambda: pf.geometry.camera_pose(EYE, "maya"), "axes: expected"),  # pyright: ignore
        (
            lambda: pf.geometry.camera_pose(2 * EYE, "opencv"),
            "to_world: expected a rotation",
        ),
        (
            lambda: pf.geometry.camera_pose(EYE * [-1, 1, 1, 1], "nerf"),
            "to_world: expected a rotation",
        ),
        (lambda: pf.geometry.camera_pose(np.full((4, 4), np.nan), "nerf"), "finite"),
        (lambda: pf.geometry.camera_pose(np.ones((4, 4)), "nerf"), "last row"),
        (lambda: of_view(VIEWS[0], distortion=[1, 2, 3]), "distortion: expected 4 or"),
        (lambda: of_view(VIEWS[0], distortion=[0] * 11 + [1]), "thin prism"),
        (lambda: of_view({**VIEWS[0], "matrix": np.ones((3, 3))}), "matrix: expected"),
        (lambda: of_view({**VIEWS[0], "rotation": [1, 2]}), "rotation: expected"),
        (
            lambda: pf.geometry.camera_from_matrix(np.ones((3, 4)), width=4, height=4),
            "without a centre",
        ),
        (
            lambda: pf.geometry.camera_from_matrix(
                EYE, width=4, height=4, first_pixel=1
            ),
            "first_pixel: expected 0 or 0.5",
        ),
    ],
)
def test_what_is_wrong_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()


def test_rounded_axes_become_exact():
    """Of six digits in a text file; our cameras want them orthonormal."""
    matrix = np.eye(4)
    matrix[:3, :3] = random_rotation(5).round(4)
    _, rotation = pf.geometry.camera_pose(matrix, "nerf")
    near(rotation.T @ rotation, np.eye(3), close())
