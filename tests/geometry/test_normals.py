import jax
import jax.numpy as jnp
import numpy as np
import pytest

from phongfit.geometry.normals import (
    face_normal,
    face_normals,
    implicit_normal,
    parametric_normal,
    split_creases,
    vertex_normals,
)
from phongfit.testing import check_gradients
from tests.helpers import floats, near

# A cube of edge 2, each side cut along one diagonal, seen counter-clockwise.
CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
SIDES = [
    (0, 1, 3, 2),
    (4, 6, 7, 5),
    (0, 4, 5, 1),
    (2, 3, 7, 6),
    (0, 2, 6, 4),
    (1, 5, 7, 3),
]
CUBE_FACES = np.array([t for a, b, c, d in SIDES for t in ((a, b, c), (a, c, d))])


def test_a_face_has_the_normal_of_a_right_hand_and_twice_its_area():
    normal = face_normal(floats([0, 0, 0]), floats([2, 0, 0]), floats([0, 3, 0]))
    near(normal, (0, 0, 6))


def test_faces_of_a_cube_point_outwards():
    normals = face_normals(floats(CUBE), jnp.asarray(CUBE_FACES))
    sides = np.trunc(CUBE[CUBE_FACES].mean(axis=1))
    near(normals, sides)


def test_angles_do_not_depend_on_how_sides_were_cut():
    by_angle = vertex_normals(floats(CUBE), jnp.asarray(CUBE_FACES), "angle")
    near(by_angle, CUBE / np.sqrt(3))
    # Areas count a side twice at the ends of its diagonal.
    by_area = np.asarray(vertex_normals(floats(CUBE), jnp.asarray(CUBE_FACES), "area"))
    assert abs(by_area - CUBE / np.sqrt(3)).max() > 0.1
    shares = np.array([[(v in f) for f in CUBE_FACES] for v in range(8)], float)
    expected = shares @ np.asarray(face_normals(floats(CUBE), jnp.asarray(CUBE_FACES)))
    near(by_area, expected / np.linalg.norm(expected, axis=1, keepdims=True))


@pytest.mark.parametrize("weighting", ["area", "angle"])
def test_degenerate_faces_and_unused_vertices_do_no_harm(weighting):
    spoilt = floats(np.concatenate([CUBE, [[9, 9, 9], [1, 1, 1]]]))
    # A face of one vertex, one of a line, one of coinciding vertices.
    faces = np.concatenate([CUBE_FACES, [(0, 0, 0), (0, 1, 1), (7, 9, 7)]])

    def normals(vertices):
        return vertex_normals(vertices, jnp.asarray(faces), weighting)

    clean = vertex_normals(floats(CUBE), jnp.asarray(CUBE_FACES), weighting)
    near(normals(spoilt)[:8], clean)
    near(normals(spoilt)[8:], 0)
    slopes = jax.jacrev(normals)(spoilt)
    assert np.all(np.isfinite(slopes)) and np.all(slopes[8:] == 0)
    assert np.any(slopes[:8] != 0)


@pytest.mark.parametrize("weighting", ["area", "angle"])
def test_gradients_of_vertex_normals(weighting):
    rng = np.random.default_rng(0)
    vertices = floats(CUBE + rng.uniform(-0.2, 0.2, CUBE.shape))
    faces = jnp.asarray(CUBE_FACES)
    check_gradients(lambda v: vertex_normals(v, faces, weighting), vertices, order=1)


@pytest.mark.parametrize(
    "angle, vertices", [(180, 8), (91, 8), (89, 24), (30, 24), (0, 24)]
)
def test_creases_of_a_cube(angle, vertices):
    origin, faces = split_creases(CUBE, CUBE_FACES, angle)
    assert len(origin) == vertices
    np.testing.assert_array_equal(origin[faces], CUBE_FACES)
    if vertices == 24:
        # Cut open, every corner has its side's normal: the diagonals stay smooth.
        normals = np.asarray(vertex_normals(floats(CUBE[origin]), jnp.asarray(faces)))
        sides = np.asarray(face_normals(floats(CUBE), jnp.asarray(CUBE_FACES)))
        near(normals[faces], np.repeat(sides[:, None], 3, axis=1))


def test_a_crease_of_half_an_edge_ends_at_a_smooth_vertex():
    # A ridge that flattens out: sharp at one end, flat at the other.
    vertices = np.array(
        [[0, 0, 0], [0, 1, 1], [-1, 1, 0], [1, 1, 0], [-1, 0, 0], [1, 0, 0]], float
    )
    faces = np.array([(0, 1, 2), (0, 3, 1), (0, 2, 4), (0, 5, 3)])
    origin, split = split_creases(vertices, faces, 60)
    # Only the ridge between the first two faces is sharp, and no way leads around it.
    assert sorted(origin) == [0, 0, 1, 1, 2, 3, 4, 5]
    assert split[0, 1] != split[1, 2]


def test_a_degenerate_face_may_come_to_a_crease():
    faces = np.concatenate([CUBE_FACES, [(0, 1, 1)]])
    origin, split = split_creases(CUBE, faces, 30)
    np.testing.assert_array_equal(origin[split], faces)


def test_a_parametric_normal():
    def saddle(u, v):
        return jnp.stack([u, v, u * v])

    normal = parametric_normal(saddle, floats(0.5), floats(-1.0))
    near(normal, np.array([1, -0.5, 1]) / 1.5)
    check_gradients(lambda at: parametric_normal(saddle, *at), floats([0.5, -1.0]))


def test_an_implicit_normal():
    def ellipsoid(p):
        return jnp.sum(p * p * floats([1.0, 4.0, 9.0])) - 1

    normal = implicit_normal(ellipsoid, floats([1.0, 1.0, 1.0]))
    near(normal, np.array([1, 4, 9]) / np.sqrt(98))
    near(implicit_normal(ellipsoid, floats([0.0, 0.0, 0.0])), 0)
