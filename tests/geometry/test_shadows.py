import equinox as eqx
import jax
import numpy as np
import pytest

import phongfit as pf
from phongfit.geometry import shapes
from tests.helpers import floats, known, near

VIEW = pf.OrthographicCamera(20, 20, view_height=2)
FLOOR = pf.shapes.plane(4, 4).mesh(1, 1)


def screen(height=0.5):
    """The right half of the floor's middle, that much above it, for light only."""
    corners = np.array(
        [[0, -2, height], [2, -2, height], [2, 2, height], [0, 2, height]]
    )
    # It shows its back to the camera, and so is not seen, but it is in the way.
    return pf.Mesh(corners, [[0, 2, 1], [0, 3, 2]])


def columns_in_light(light, surface=None):
    """For each column of pixels, its x and whether the light reaches it."""
    surface = pf.geometry.join([FLOOR, screen()]) if surface is None else surface
    gbuffer = pf.geometry.trace(surface, VIEW, [light], shadows=True)
    near(gbuffer.position[..., 2], 0)
    assert known(gbuffer.visibility).shape == (20, 20, 1)
    seen = np.asarray(gbuffer.visibility)[..., 0]
    assert set(np.unique(seen)) <= {0.0, 1.0}
    assert np.all(seen == seen[0])
    return np.asarray(gbuffer.position)[0, :, 0], seen[0] > 0


@pytest.mark.parametrize(
    "light, edge",
    [
        # The screen begins at x = 0, half a unit above the floor.
        (pf.DirectionalLight((0, 0, 1)), 0),
        (pf.DirectionalLight((-1, 0, 1)), 0.5),
        (pf.DirectionalLight((3, 0, 5)), -0.3),
        (pf.PointLight((-0.5, 0, 1)), 0.5),
        (pf.SpotLight((-0.5, 0, 1), (0, 0, -1), cutoff=80), 0.5),
    ],
)
def test_a_shadow_begins_where_geometry_says(light, edge):
    x, lit = columns_in_light(light)
    np.testing.assert_array_equal(lit, x < edge)
    assert lit.any() and not lit.all()


@pytest.mark.parametrize("kind", [pf.PointLight, pf.SpotLight])
def test_what_lies_behind_a_light_throws_no_shadow(kind):
    between = (0.2, 0, 0.4)
    light = kind(between) if kind is pf.PointLight else kind(between, (0, 0, -1))
    _, lit = columns_in_light(light)
    assert lit.all()


def test_each_light_has_its_own_shadow():
    lights = (pf.DirectionalLight((0, 0, 1)), pf.DirectionalLight((-1, 0, 1)))
    surface = pf.geometry.join([FLOOR, screen()])
    both = known(pf.geometry.trace(surface, VIEW, lights, shadows=True).visibility)
    for i, light in enumerate(lights):
        alone = known(
            pf.geometry.trace(surface, VIEW, [light], shadows=True).visibility
        )
        np.testing.assert_array_equal(both[..., i], alone[..., 0])


def test_in_shadow_only_ambient_light_and_emission_are_left():
    light = pf.DirectionalLight((0, 0, 1), 0.9, ambient=0.1)
    scene = pf.Scene(
        pf.geometry.join([FLOOR, screen()]), VIEW, light, 0.2, shadows=True
    )
    material = pf.Material(0.5, 0.4, 9.0, (0.3, 0.2, 0.1), 0.05)
    image = pf.render(scene, material)
    dark = 0.05 + 0.3 * np.array([0.3, 0.2, 0.1])
    near(image[0, -1], dark)
    near(image[0, 0], dark + 0.9 * (0.5 + 0.4))


@eqx.filter_jit
def directions(light, positions):
    return jax.vmap(lambda position: light.illuminate(position).to_light)(positions)


@pytest.mark.parametrize("size, place", [(1, 0), (1e-3, 0), (1e3, 0), (1, 50)])
def test_no_acne_on_a_coarse_mesh_of_any_size_and_place(size, place):
    """Where a face and its normals both look to the light, a convex mesh is lit."""
    ball = shapes.Ball().mesh(12, 8)
    shift = np.array([place, -place, 0])
    mesh = pf.Mesh(np.asarray(ball.vertices) * size + shift, ball.faces, ball.normals)
    view = pf.PerspectiveCamera.look_at(
        np.array([0, 0, 5]) * size + shift, shift, width=100, height=100, fov_y=26
    )
    for light in (
        pf.PointLight(np.array([2, 3, 4]) * size + shift),
        pf.PointLight(np.array([0, 0, 1.05]) * size + shift),
        pf.DirectionalLight((1, 1, 1)),
        pf.DirectionalLight((1, 0, 0.02)),
    ):
        gbuffer = pf.geometry.trace(mesh, view, [light], shadows=True)
        to_light = directions(light, gbuffer.position.reshape(-1, 3)[::7])
        facing = np.sum(
            known(gbuffer.surface_normal).reshape(-1, 3)[::7] * to_light, axis=1
        )
        seen = np.asarray(gbuffer.visibility).ravel()[::7]
        mask = np.asarray(gbuffer.mask).ravel()[::7]
        assert np.all(seen[mask & (facing > 0)] == 1)
        # And on its far side it is in its own shadow.
        assert np.all(seen[mask & (facing < -0.05)] == 0)
        assert (mask & (facing > 0)).sum() > 100


def test_a_face_is_never_in_its_own_shadow():
    # A light just below its plane, that its interpolated normals still look at.
    tilted = np.array([[1, 0, 0.2]] * 3)
    mesh = pf.Mesh([[-2, -2, 0], [2, -2, 0], [0, 3, 0]], [[0, 1, 2]], tilted)
    light = pf.DirectionalLight((1, 0, -0.1))
    gbuffer = pf.geometry.trace(mesh, VIEW, [light], shadows=True)
    assert gbuffer.mask.any()
    assert np.all(known(gbuffer.visibility)[gbuffer.mask] == 1)


@pytest.mark.parametrize(
    "shading, points",
    [
        (pf.GouraudShading(), 6),
        (pf.FlatShading(), 4),
        (pf.FlatShading("last_vertex"), 4),
    ],
)
def test_shadows_fall_where_the_shading_lights(shading, points):
    # Of the floor, only what lies at x > 0 is below the screen: two of its vertices.
    scene = pf.Scene(
        pf.geometry.join(
            [FLOOR, pf.Mesh(screen().vertices * floats([[2.0, 2, 1]]), screen().faces)]
        ),
        VIEW,
        pf.DirectionalLight((0, 0, 1)),
        shadows=True,
        shading=shading,
    )
    gbuffer = scene.trace()
    lit = scene.shading.points(scene.surface, VIEW, gbuffer)
    x, z = np.asarray(lit.position)[:, 0], np.asarray(lit.position)[:, 2]
    assert len(x) == points + 2 * (points == 6)
    np.testing.assert_array_equal(
        known(gbuffer.visibility)[:, 0] > 0, (z > 0) | (x < 0)
    )


def test_a_scene_with_shadows_wants_a_buffer_with_its_shadows():
    light = pf.DirectionalLight((0, 0, 1))
    scene = pf.Scene(FLOOR, VIEW, light, shadows=True)
    for gbuffer in (
        pf.geometry.trace(FLOOR, VIEW),
        pf.geometry.trace(FLOOR, VIEW, [light, light], shadows=True),
        pf.geometry.trace(
            FLOOR, VIEW, [light], shadows=True, shading=pf.GouraudShading()
        ),
    ):
        with pytest.raises(ValueError, match="^gbuffer: expected visibility of shape"):
            pf.render(scene, pf.Material(), gbuffer=gbuffer)


def test_a_ball_is_in_the_way_of_its_own_back():
    lights = (pf.DirectionalLight((0, 1, 0)), pf.PointLight((0, 0, 0)))
    gbuffer = pf.geometry.trace(
        pf.Sphere(), pf.OrthographicCamera(40, 40), lights, shadows=True
    )
    mask = np.asarray(gbuffer.mask)
    up = np.asarray(gbuffer.normal)[..., 1]
    outside, inside = np.moveaxis(np.asarray(gbuffer.visibility), -1, 0)
    np.testing.assert_array_equal(outside[mask] > 0, up[mask] >= 0)
    # A bulb in the middle of the ball is on the way before the other side is.
    assert np.all(inside[mask] == 1)


def test_a_normal_map_without_positions_knows_of_no_shadows():
    flat = np.broadcast_to([0.0, 0, 1], (4, 4, 3))
    light = pf.DirectionalLight((0, 0, 1))
    view = pf.OrthographicCamera(4, 4)
    with pytest.raises(ValueError, match="^shadows: a normal map"):
        pf.Scene(pf.NormalMap(flat), view, light, shadows=True)
    with pytest.raises(ValueError, match="^fog: a normal map"):
        pf.Scene(pf.NormalMap(flat), view, light, fog=pf.Fog())
    with pytest.raises(
        ValueError, match="^shadows: expected a normal map with positions"
    ):
        pf.geometry.trace(pf.NormalMap(flat), view, [light], shadows=True)
