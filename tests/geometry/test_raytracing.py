import sys
import threading

import jax.numpy as jnp
import numpy as np
import pytest

from phongfit.geometry import raytracing
from phongfit.geometry.cameras import Ray
from phongfit.geometry.raytracing import blocked, first_faces
from tests.helpers import floats

# Two squares facing +z, at z = 0 and, half as far to the right, at z = -1.
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
VERTICES = np.concatenate([SQUARE, SQUARE + [0.5, 0, -1]])
FACES = jnp.asarray([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
ALL = jnp.ones(4, bool)


def rays_down(xy, z=3.0):
    origin = np.concatenate([np.asarray(xy, float), np.full((len(xy), 1), z)], axis=1)
    return Ray(floats(origin), floats(np.tile([0.0, 0.0, -1.0], (len(xy), 1))))


POINTS = [(0.6, 0.2), (0.2, 0.6), (1.3, 0.1), (0.8, 0.9), (2.0, 0.5), (-0.1, 0.5)]


def test_the_first_face_is_found():
    found = first_faces(floats(VERTICES), FACES, ALL, rays_down(POINTS))
    np.testing.assert_array_equal(found, [0, 1, 2, 1, -1, -1])


def test_rays_pass_through_faces_that_are_not_visible():
    rays = rays_down(POINTS)
    behind = first_faces(floats(VERTICES), FACES, jnp.arange(4) > 1, rays)
    np.testing.assert_array_equal(behind, [3, -1, 2, 3, -1, -1])
    none = first_faces(floats(VERTICES), FACES, jnp.zeros(4, bool), rays)
    np.testing.assert_array_equal(none, -1)


# The squares are 3 and 4 away.
@pytest.mark.parametrize(
    "distance, expected",
    [
        (np.inf, [1, 1, 1, 1, 0, 0]),
        (3.5, [1, 1, 0, 1, 0, 0]),
        (2.9, [0] * 6),
        (-1, [0] * 6),
    ],
)
def test_what_is_in_the_way(distance, expected):
    limits = floats(np.full(len(POINTS), distance))
    found = blocked(floats(VERTICES), FACES, rays_down(POINTS), limits)
    np.testing.assert_array_equal(found, np.array(expected, bool))


@pytest.mark.parametrize("size, place", [(1e-6, 0), (1e6, 0), (1, 300), (1e-3, 0.5)])
def test_any_size_and_place(size, place):
    shift = np.array([place, -place, 0])
    vertices, rays = VERTICES * size + shift, rays_down(POINTS)
    rays = Ray(floats(np.asarray(rays.origin) * size + shift), rays.direction)
    found = first_faces(floats(vertices), FACES, ALL, rays)
    np.testing.assert_array_equal(found, [0, 1, 2, 1, -1, -1])


def test_a_far_viewer_sees_as_well_as_a_near_one():
    # From 1e6 away, Embree's float32 alone would put the squares 0.06 apart from it.
    rays = rays_down(POINTS, z=1e6)
    found = first_faces(floats(VERTICES), FACES, ALL, rays)
    np.testing.assert_array_equal(found, [0, 1, 2, 1, -1, -1])
    found = blocked(floats(VERTICES), FACES, rays, floats(np.full(6, 1e6 + 0.5)))
    np.testing.assert_array_equal(found, [1, 1, 0, 1, 0, 0])


def test_what_was_traced_is_not_traced_again(monkeypatch):
    runs = []
    plain = raytracing._Tree.run
    monkeypatch.setattr(
        raytracing._Tree,
        "run",
        lambda *args: (runs.append(args[3]), plain(*args))[1],
    )
    vertices = floats(VERTICES + 0.125)
    for _ in range(3):
        first_faces(jnp.array(vertices), FACES, ALL, rays_down(POINTS))
    assert len(runs) == 1
    first_faces(vertices + floats(0.25), FACES, ALL, rays_down(POINTS))
    assert len(runs) == 2


def test_threads_share_what_is_remembered():
    """Each gets its own result, though others push it out of memory meanwhile."""
    twice = raytracing._cache_last(4)(lambda array: 2 * array)
    right = np.zeros(8, int)

    def ask(thread):
        for k in range(8000):
            number = k % 5 + thread
            right[thread] += twice(np.array(number)) == 2 * number

    threads = [threading.Thread(target=ask, args=(k,)) for k in range(len(right))]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(interval)
    assert np.all(right == 8000)
