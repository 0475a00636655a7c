"""Faces that rays meet, without Embree: the same ones."""

import subprocess
import sys

import numpy as np
import pytest

import phongfit as pf
from phongfit.geometry import raytracing
from phongfit.geometry.boxes import MAX_LEAF_FACES, RAYS_PER_BATCH, FaceTree


@pytest.fixture
def without_embree(monkeypatch):
    """As on a machine that there is no wheel for."""
    monkeypatch.setitem(sys.modules, "embreex.mesh_construction", None)


def random_faces(count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(count)
    vertices = rng.uniform(-0.5, 0.5, (3 * count, 3)).astype(np.float32)
    return vertices, np.arange(3 * count, dtype=np.int32).reshape(-1, 3)


def random_rays(count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(count)
    origin = rng.normal(size=(count, 3))
    direction = rng.uniform(-0.5, 0.5, (count, 3)) - origin
    direction[::5, 0] = 0  # along an axis of the boxes
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return origin.astype(np.float32), direction.astype(np.float32)


@pytest.mark.parametrize("faces", [1, MAX_LEAF_FACES, 60])
def test_the_same_faces_as_embree(faces, without_embree, monkeypatch):
    mesh, rays = random_faces(faces), random_rays(500)
    own = raytracing._scene(*mesh)
    assert isinstance(own, FaceTree)
    monkeypatch.undo()
    embree = raytracing._scene(*mesh)
    assert not isinstance(embree, FaceTree)
    first = own.run(*rays, None, "INTERSECT")
    np.testing.assert_array_equal(first, embree.run(*rays, None, "INTERSECT"))
    assert 0 < np.sum(first >= 0) < len(first)
    limit = np.random.default_rng(0).uniform(0, 2, len(first)).astype(np.float32)
    blocked = own.run(*rays, limit, "OCCLUDED") >= 0
    assert np.array_equal(blocked, embree.run(*rays, limit, "OCCLUDED") >= 0)
    assert 0 < np.sum(blocked) < np.sum(first >= 0)


def test_no_ray_slips_between_two_faces():
    grid = np.stack(np.meshgrid(*2 * [np.linspace(-0.7, 0.7, 8)]), axis=-1)
    corner = np.arange(64).reshape(8, 8)
    square = [corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]]
    a, b, c, d = (one.ravel() for one in square)
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    height = 0.1 * np.sin(5 * grid).sum(axis=-1, keepdims=True)
    vertices = np.concatenate([grid, height], axis=-1).reshape(-1, 3)
    tree = FaceTree(vertices, faces)
    # Through corners and edges, in more rays than are worked on together.
    inner = vertices.reshape(8, 8, 3)[1:-1, 1:-1].reshape(-1, 3)
    ends = np.concatenate([inner, (inner[:-1] + inner[1:]) / 2])
    ends = np.resize(ends, (RAYS_PER_BATCH + 7, 3))
    origin = np.array([0.01, 0.02, 2.0]) + 0 * ends
    along = ends - origin
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    assert np.all(tree.run(origin, along, None, "INTERSECT") >= 0)


def test_the_same_picture_with_shadows(without_embree, monkeypatch):
    ball = pf.shapes.Ball().mesh(12, 8)
    floor = np.array([[-2, -1, -2], [2, -1, -2], [2, -1, 2], [-2, -1, 2]], float)
    vertices = np.concatenate([np.asarray(ball.vertices), floor])
    faces = np.concatenate(
        [np.asarray(ball.faces), len(vertices) - 4 + np.array([[0, 2, 1], [0, 3, 2]])]
    )
    camera = pf.PerspectiveCamera.look_at((0.3, 1.1, 4), width=24, height=24)
    light, material = pf.DirectionalLight((0.5, 1, 0.4)), pf.Material(0.3, 0.6, 0.3, 9)

    def picture(size: float) -> np.ndarray:
        mesh = pf.Mesh(size * vertices, faces.astype(np.int32), two_sided=True)
        scene = pf.Scene(mesh, camera, light, ambient=0.2, shadows=True)
        return np.asarray(pf.render(scene, material))

    own = picture(1.0)
    monkeypatch.undo()
    # Another size, since what was traced before is remembered.
    np.testing.assert_allclose(own, picture(1 + 1e-5), atol=1e-3)


def test_embree_is_not_imported_before_faces_are_traced():
    code = """
import sys
import phongfit as pf
light = pf.DirectionalLight((0, 0, 1))
camera, material = pf.OrthographicCamera(4, 4), pf.Material(0.1, 0.5, 0.2, 9.0)
pf.render(pf.Scene(pf.Sphere(), camera, light), material)
pf.fit
late = ("embreex", "scipy", "trimesh", "matplotlib")
assert not [name for name in late if name in sys.modules]
pf.render(pf.Scene(pf.shapes.Ball().mesh(8, 6), camera, light), material)
assert "embreex" in sys.modules
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
