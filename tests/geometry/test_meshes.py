import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.geometry.cameras import Ray
from phongfit.geometry.meshes import barycentrics
from phongfit.testing import check_gradients
from tests.helpers import check_surface, floats, known, near

# A low pyramid over a square, its tip towards the viewer.
PYRAMID = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [0.1, 0.2, 0.8]])
SLOPES = np.array([(0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)])
TRIANGLE = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], float)
FRONT = [[0, 1, 2]]


def camera(width=5, height=4, **keywords):
    return pf.PerspectiveCamera(width, height, fov_y=15, **keywords)


PERSPECTIVE, PARALLEL = camera(), pf.OrthographicCamera(3, 4, view_height=1.3)
MESHES = {
    "area": pf.Mesh(PYRAMID, SLOPES),
    "angle": pf.Mesh(PYRAMID, SLOPES, weighting="angle"),
    "normals": pf.Mesh(PYRAMID, SLOPES, PYRAMID + [0, 0, 2.0]),
    "materials": pf.Mesh(PYRAMID, SLOPES, material_index=[0, 2, 1, 0]),
    "creases": pf.Mesh(PYRAMID, SLOPES, crease_angle=20),
    "two-sided": pf.Mesh(PYRAMID, SLOPES[:, ::-1], two_sided=True),
}


@pytest.mark.parametrize(
    "name, view",
    [
        ("area", PARALLEL),
        pytest.param("angle", PERSPECTIVE, marks=pytest.mark.extended),
        pytest.param("normals", PARALLEL, marks=pytest.mark.extended),
        ("two-sided", PERSPECTIVE),
    ],
)
def test_contract(name, view):
    check_surface(MESHES[name], view)


@pytest.mark.extended
@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("view", [PERSPECTIVE, PARALLEL])
def test_contract_to_second_order(name, view):
    check_surface(MESHES[name], view, order=2)


def test_given_normals_are_normalised_and_interpolated():
    normals = np.array([[1, 0, 1], [-1, 0, 1], [0, 0, 7]], float)
    mesh = pf.Mesh(TRIANGLE, FRONT, normals)
    buffer = mesh.trace(pf.OrthographicCamera(5, 5, view_height=0.5))
    unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    near(mesh.vertex_normals(), unit)
    # The centre of the image is the middle of the triangle's height: weights ¼, ¼, ½.
    near(known(buffer.barycentrics)[2, 2], (0.25, 0.25, 0.5))
    between = np.array([0.25, 0.25, 0.5]) @ unit
    near(buffer.normal[2, 2], between / np.linalg.norm(between))
    near(buffer.position[2, 2], (0, 0, 0))
    near(known(buffer.surface_normal)[2, 2], (0, 0, 1))
    assert buffer.mask.all() and np.all(buffer.face == 0)


def test_a_long_thin_triangle_at_a_slant_is_seen_in_perspective():
    """Against exact geometry of rays and a plane, in double precision."""
    corners = np.array([[-0.05, -1, 4], [0.05, -1, 4], [0.02, -0.8, -20]])
    normals = np.array([[0.6, 0.8, 0], [-0.6, 0.8, 0], [0, 0.6, -0.8]])
    view = pf.PerspectiveCamera(60, 200, fov_y=24, position=(0, 0.0, 5.5))
    buffer = pf.Mesh(corners, FRONT, normals, two_sided=True).trace(view)
    mask = np.asarray(buffer.mask)
    assert mask.sum() > 100

    y, x = np.nonzero(mask)
    scale = 2 * np.tan(np.radians(12)) / 200
    along = np.stack(
        [(x + 0.5 - 30) * scale, (100 - y - 0.5) * scale, -np.ones(len(x))]
    )
    eye = np.array([0, 0, 5.5])
    one, other = corners[1] - corners[0], corners[2] - corners[0]
    # eye + t · along = corner + u · one + v · other
    systems = np.stack(
        [
            np.broadcast_to(one[:, None], along.shape),
            np.broadcast_to(other[:, None], along.shape),
            -along,
        ],
        axis=1,
    ).transpose(2, 0, 1)
    u, v, _ = np.linalg.solve(systems, (eye - corners[0])[:, None])[..., 0].T
    weights = np.stack([1 - u - v, u, v], axis=1)
    assert np.all(weights > -1e-3) and np.ptp(weights[:, 2]) > 0.7

    near(known(buffer.barycentrics)[mask], weights, 1e-5)
    np.testing.assert_allclose(
        buffer.position[mask], weights @ corners, rtol=1e-5, atol=1e-5
    )
    expected = weights @ normals
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    near(buffer.normal[mask], expected, 2e-5)

    # Weights that are linear in the image are far off: the test can tell.
    depths = 5.5 - corners[:, 2]
    screen = np.linalg.inv(
        np.stack([corners[:, 0] / depths, corners[:, 1] / depths, np.ones(3)])
    )
    affine = (screen @ np.stack([along[0], along[1], np.ones(len(x))])).T
    assert abs(affine - weights).max() > 0.3


def test_barycentrics_of_a_ray_in_the_plane_are_finite():
    a, b, c = floats(TRIANGLE)
    ray = Ray(floats([0, -5, 0]), floats([0, 1, 0]))
    near(barycentrics(ray, a, b, c), (1, 0, 0))
    slopes_at = jax.jacrev(lambda at: barycentrics(Ray(at, ray.direction), a, b, c))
    slopes = jax.jit(slopes_at)(ray.origin)
    assert np.all(np.isfinite(slopes))


def test_gradients_reach_vertices_normals_lights_and_camera():
    scene = pf.Scene(
        pf.Mesh(PYRAMID, SLOPES, PYRAMID + [0, 0, 2.0]),
        camera(4, 3, position=(0.3, 0.2, 5)),
        pf.PointLight((1, 2, 3), 0.6),
        0.2,
        background=0.1,
        shading=pf.GouraudShading(),
    )
    material = pf.Material((0.5, 0.4, 0.3), 0.4, 12.0)
    assert scene.trace().mask.all()
    check_gradients(lambda both: pf.render(*both), (scene, material), order=1)
    image = pf.render(scene, material)
    for leaf in (
        lambda s: s.surface.vertices,
        lambda s: s.surface.normals,
        lambda s: s.camera.position,
        lambda s: s.lights[0].position,
    ):
        moved = eqx.tree_at(leaf, scene, leaf(scene).at[..., 0].add(0.05))
        assert np.any(abs(pf.render(moved, material) - image) > 1e-4)


def test_inside_jit_and_vmap_it_is_the_same():
    mesh, material = pf.Mesh(PYRAMID, SLOPES), pf.Material(specular=0.3)

    def image(shift):
        moved = eqx.tree_at(lambda m: m.vertices, mesh, mesh.vertices + shift[None])
        scene = pf.Scene(moved, camera(), pf.PointLight((1, 2, 3)), 0.2, shadows=True)
        return pf.render(scene, material)

    shifts = floats([[0, 0, 0], [0.3, 0, -1]])
    expected = jnp.stack([image(shift) for shift in shifts])
    near(jax.jit(image)(shifts[1]), expected[1])
    near(jax.vmap(image)(shifts), expected)


def test_the_back_is_seen_of_two_sided_meshes_only():
    view = pf.OrthographicCamera(5, 5, view_height=0.5)
    back = [[0, 2, 1]]
    with pytest.warns(UserWarning, match="no pixel sees the mesh"):
        assert not pf.Mesh(TRIANGLE, back).trace(view).mask.any()
    buffer = pf.Mesh(TRIANGLE, back, two_sided=True).trace(view)
    assert buffer.mask.all()
    near(buffer.normal, np.broadcast_to([0.0, 0, 1], (5, 5, 3)))
    near(buffer.surface_normal, np.broadcast_to([0.0, 0, 1], (5, 5, 3)))


def test_faces_that_show_their_backs_hide_nothing():
    near_back = pf.Mesh(TRIANGLE + [0, 0, 1.0], [[0, 2, 1]])
    both = pf.geometry.join([near_back, pf.Mesh(TRIANGLE, FRONT)])
    buffer = both.trace(pf.OrthographicCamera(5, 5, view_height=0.5))
    assert buffer.mask.all()
    near(buffer.position[..., 2], 0)
    assert np.all(buffer.material_index == 1)


def test_a_mesh_outside_the_view_gives_a_warning_and_the_background():
    scene = pf.Scene(pf.Mesh(TRIANGLE + [50.0, 0, 0], FRONT), camera(), background=0.3)
    with pytest.warns(UserWarning, match="^surface: .* outside the view"):
        image = pf.render(scene, pf.Material())
    near(image, np.full(image.shape, 0.3))


def test_degenerate_faces_and_unused_vertices_do_no_harm():
    vertices = np.concatenate([PYRAMID, [[0, 0, 2], [np.pi, 9, 9]]])
    faces = np.concatenate([SLOPES, [(0, 0, 0), (0, 4, 4), (0, 2, 0)]])
    clean, spoilt = pf.Mesh(PYRAMID, SLOPES), pf.Mesh(vertices, faces)

    def image(mesh):
        return pf.render(
            pf.Scene(mesh, camera(), pf.PointLight((1, 2, 3))), pf.Material()
        )

    near(image(spoilt), image(clean))
    slopes = eqx.filter_jit(eqx.filter_grad(lambda mesh: image(mesh).sum()))(spoilt)
    assert np.all(np.isfinite(slopes.vertices))


def test_joined_objects_keep_their_materials():
    left = pf.Mesh(PYRAMID - [1.2, 0, 0], SLOPES, material_index=[0, 1, 0, 1])
    right = pf.Mesh(PYRAMID + [1.2, 0, 0], SLOPES, weighting="angle")
    both = pf.geometry.join([left, right])
    assert both.materials == 3
    np.testing.assert_array_equal(both.material_index, [0, 1, 0, 1, 2, 2, 2, 2])
    near(both.face_normals(), jnp.concatenate([left.face_normals()] * 2))
    near(both.vertex_normals()[5:], right.vertex_normals())
    near(both.vertex_normals()[:5], left.vertex_normals())
    with pytest.raises(ValueError, match="^meshes: "):
        pf.geometry.join([])
    with pytest.raises(ValueError, match="^meshes: .*two-sided"):
        pf.geometry.join([left, pf.Mesh(TRIANGLE, FRONT, two_sided=True)])


@pytest.mark.parametrize(
    "named, arguments",
    [
        ("vertices", dict(vertices=np.zeros((3, 2)))),
        ("vertices", dict(vertices=np.where(TRIANGLE == 0, np.nan, TRIANGLE))),
        ("vertices", dict(vertices=np.where(TRIANGLE == 0, np.inf, TRIANGLE))),
        ("vertices", dict(vertices="cube.obj")),
        ("faces", dict(faces=[])),
        ("faces", dict(faces=np.zeros((0, 3), int))),
        ("faces", dict(faces=[[0, 1, 3]])),
        ("faces", dict(faces=[[0, -1, 2]])),
        ("faces", dict(faces=[[0.0, 1.0, 2.0]])),
        ("faces", dict(faces=[[0, 1, 2, 0]])),
        ("normals", dict(normals=np.ones((2, 3)))),
        ("normals", dict(normals=TRIANGLE * np.nan)),
        ("material_index", dict(material_index=[0, 1])),
        ("material_index", dict(material_index=[-1])),
        ("material_index", dict(material_index=[2**40])),
        ("material_index", dict(material_index=[2**31 - 1])),
        ("material_index", dict(material_index=[0.5])),
        ("weighting", dict(weighting="length")),
        ("crease_angle", dict(crease_angle=np.nan)),
        ("crease_angle", dict(crease_angle=30, normals=np.ones((3, 3)))),
    ],
)
def test_bad_meshes(named, arguments):
    with pytest.raises(ValueError, match=f"^{named}: "):
        pf.Mesh(**dict(vertices=TRIANGLE, faces=FRONT) | arguments)


def test_faces_are_never_traced():
    with pytest.raises(
        ValueError, match="^faces: expected known numbers, got a traced array"
    ):
        jax.jit(lambda faces: pf.Mesh(TRIANGLE, faces).vertices)(jnp.array(FRONT))


@pytest.mark.parametrize("kind", [pf.PerspectiveCamera, pf.OrthographicCamera])
def test_a_camera_inside_a_face(kind):
    mesh = pf.Mesh(PYRAMID, SLOPES)
    inside = PYRAMID[SLOPES[1]].mean(axis=0)
    with pytest.raises(ValueError, match="^camera: its position .* lies in a face"):
        mesh.trace(kind(4, 4, position=inside))
    # In the plane of a face, but beside it, it is fine.
    a, b, c = PYRAMID[SLOPES[1]]
    buffer = mesh.trace(kind.look_at(3 * c - a - b, inside, width=4, height=4))
    assert buffer.mask.any()
