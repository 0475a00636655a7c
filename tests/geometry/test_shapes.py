import jax
import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.geometry.normals import implicit_normal
from phongfit.geometry.shapes import Ball, Cylinder, HeightField, Torus, plane
from phongfit.testing import check_gradients
from tests.helpers import check_surface, close, floats, known, near


def waves(x, y):
    return 0.2 * jnp.sin(4 * x) * jnp.cos(3 * y)


SHAPES = [
    Ball(0.9),
    Torus(0.7, 0.3),
    Cylinder(0.5, 1.5),
    plane(1.5, 1.2),
    HeightField(waves, 2, 1.5, relief=0.3),
]


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: type(s).__name__)
def test_both_ways_to_write_it_down_are_the_same_surface(shape):
    mesh = shape.mesh(8, 6)

    @jax.jit
    def implicit(points):
        normals = jax.vmap(lambda p: implicit_normal(shape.implicit, p))(points)
        return jax.vmap(shape.implicit)(points), normals

    on_it, expected = implicit(mesh.vertices)
    near(on_it, 0, 10 * close())
    corner = np.asarray(shape.corner())
    assert np.all(abs(np.asarray(mesh.vertices)) <= corner + close())
    # Exact normals, outwards and the same both ways: at the poles of a ball, almost.
    near(mesh.normals, expected, 1e-3 if floats(0).dtype == np.float32 else 1e-7)
    # The faces look the same way as their corners.
    index = np.asarray(mesh.faces)
    normals = np.asarray(known(mesh.normals))[index]
    faces = np.sum(np.asarray(mesh.face_normals())[:, None] * normals, axis=-1)
    a, b, c = np.moveaxis(np.asarray(mesh.vertices)[index], 1, 0)
    # At a pole, faces have no area but for rounding.
    proper = np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-4
    assert np.all(faces[proper] > 0.3) and proper.mean() > 0.7


@pytest.mark.parametrize(
    "shape",
    [
        pytest.param(
            shape,
            id=type(shape).__name__,
            marks=() if type(shape) in (Ball, Torus) else pytest.mark.extended,
        )
        for shape in SHAPES
    ],
)
def test_traced_and_tessellated_they_look_alike(shape):
    view = pf.PerspectiveCamera.look_at((1.5, 2, 4), width=40, height=40, fov_y=28)
    light, material = pf.DirectionalLight((1, 1, 2)), pf.Material(0.7, 0.3, 20.0)

    def image(surface):
        scene = pf.Scene(surface, view, light, 0.2, shadows=True)
        return np.asarray(pf.render(scene, material)), np.asarray(scene.trace().mask)

    (one, seen), (other, covered) = image(shape.surface()), image(shape.mesh(160, 80))
    assert 0.05 < seen.mean() < 0.9
    assert (seen != covered).mean() < 0.01
    both = seen & covered
    # Shadows have edges.
    assert (abs(one - other).max(axis=-1)[both] < 0.02).mean() > 0.98
    assert np.median(abs(one - other)[both]) < 1e-3


VIEW = pf.PerspectiveCamera.look_at(
    (0.2, 1.8, 4), (0.03, 0.71, 0), width=3, height=2, fov_y=4
)


def test_contract():
    check_surface(Torus(0.7, 0.3).surface(), VIEW)


@pytest.mark.extended
@pytest.mark.parametrize("shape", [Torus(0.7, 0.3), HeightField(waves)])
def test_contract_to_second_order(shape):
    check_surface(shape.surface(), VIEW, order=2)
    check_surface(shape.mesh(8, 6), VIEW, order=2)


def test_gradients_reach_the_numbers_of_a_shape():
    """By way of its triangles; of its surface, `test_contract` holds it."""
    view = pf.PerspectiveCamera.look_at(
        (0.1, 0.7, 4), (0, 0.7, 0), width=2, height=2, fov_y=3
    )

    def image(parts):
        torus, view, light = parts
        scene = pf.Scene(torus.mesh(8, 6), view, light, 0.2)
        return pf.render(scene, pf.Material(0.6))

    point = Torus(0.7, 0.3), view, pf.PointLight((1, 2, 3))
    check_gradients(image, point, order=1)


def test_a_sphere_of_triangles_has_whole_poles():
    mesh = Ball().mesh(8, 6)
    near(known(mesh.normals)[:9], np.broadcast_to([0.0, -1, 0], (9, 3)), 2e-3)
    near(known(mesh.normals)[-9:], np.broadcast_to([0.0, 1, 0], (9, 3)), 2e-3)


def test_a_surface_of_ones_own():
    def cone(u, v):
        angle = 2 * jnp.pi * u
        return jnp.stack([(1 - v) * jnp.cos(angle), v, -(1 - v) * jnp.sin(angle)])

    mesh = pf.geometry.tessellate(cone, columns=12, rows=4)
    x, y, z = np.asarray(mesh.vertices).T
    near(np.hypot(x, z), 1 - y)
    # At 45° all around, at the tip too.
    near(known(mesh.normals)[:, 1], np.sqrt(0.5), 1e-3)


@pytest.mark.parametrize(
    "named, make",
    [
        ("radius", lambda: Ball(0)),
        ("major", lambda: Torus(-1)),
        ("minor", lambda: Torus(1, np.nan)),
        ("height", lambda: Cylinder(1, 0)),
        ("width", lambda: plane(0)),
        ("relief", lambda: HeightField(waves, relief=0)),
        ("function", lambda: HeightField(np.zeros((3, 3)))),  # pyright: ignore
        ("function", lambda: pf.geometry.tessellate(lambda u, v: u)),
        ("u", lambda: pf.geometry.tessellate(waves, u=(0, 1, 2))),
        ("rows", lambda: pf.geometry.tessellate(waves, rows=0)),
        ("columns", lambda: Ball().mesh(2.5)),  # pyright: ignore
    ],
)
def test_bad_shapes(named, make):
    with pytest.raises(ValueError, match=f"^{named}: "):
        make()
