import equinox as eqx
import numpy as np
import pytest

import phongfit as pf
from phongfit.material import stack_materials
from tests.helpers import near

# Two triangles of a square in the plane z = 0, of two materials.
SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
HALVES = [[0, 1, 2], [0, 2, 3]]
TILTED = np.array([[-1, -1, 2], [1, -1, 2], [1, 1, 2], [-1, 1, 2]], float)
VIEW = pf.OrthographicCamera(8, 8, view_height=2)


def square(**keywords):
    return pf.Mesh(SQUARE, HALVES, TILTED, **keywords)


def lit(scene, material=None):
    """Light at the lighting points, and the scene's buffer."""
    gbuffer = scene.trace()
    material = pf.Material(specular=0.4) if material is None else material
    return np.asarray(pf.rendering.combine(pf.terms(scene, gbuffer), material)), gbuffer


def test_phong_shading_lights_the_pixels():
    scene = pf.Scene(square(), VIEW, pf.PointLight((0, 0, 3)))
    gbuffer = scene.trace()
    points = scene.shading.points(scene.surface, VIEW, gbuffer)
    near(points.normal, gbuffer.normal)
    near(points.surface_normal, np.broadcast_to([0.0, 0, 1], (8, 8, 3)))
    assert scene.shading.interpolation(scene.surface, gbuffer) is None


def test_gouraud_shading_is_linear_between_the_vertices():
    scene = pf.Scene(
        square(), VIEW, pf.PointLight((2, 1, 3)), shading=pf.GouraudShading()
    )
    colours, gbuffer = lit(scene)
    assert colours.shape == (4, 3)
    image = np.asarray(pf.render(scene, pf.Material(specular=0.4), gbuffer=gbuffer))
    # The lower right half: (u, v) of pixel (row, column) along its two sides.
    for row, column in ((7, 0), (7, 7), (5, 6)):
        x, y = (column + 0.5) / 8, (7.5 - row) / 8
        expected = (1 - x) * colours[0] + (x - y) * colours[1] + y * colours[2]
        near(image[row, column], expected)


def test_flat_shading_by_centroid_uses_the_face():
    scene = pf.Scene(square(), VIEW, pf.PointLight((0, 0, 3)), shading=pf.FlatShading())
    points = scene.shading.points(scene.surface, VIEW, scene.trace())
    near(points.position, SQUARE[np.array(HALVES)].mean(axis=1))
    near(points.normal, [[0, 0, 1]] * 2)
    image = np.asarray(pf.render(scene, pf.Material()))
    assert len(np.unique(image.reshape(-1, 3), axis=0)) == 1
    # By hand: the light is 3 above and a third of √2 beside the centroid.
    cosine = 3 / np.sqrt(9 + 2 / 9)
    near(image, np.full(image.shape, 0.8 * cosine))


def test_flat_shading_by_last_vertex_is_that_of_opengl():
    flat = pf.FlatShading("last_vertex")
    scene = pf.Scene(square(), VIEW, pf.PointLight((2, 1, 3)), shading=flat)
    colours, gbuffer = lit(scene)
    gouraud = eqx.tree_at(lambda s: s.shading, scene, pf.GouraudShading())
    at_vertices, _ = lit(gouraud)
    near(colours, at_vertices[[2, 3]])
    image = np.asarray(pf.render(scene, pf.Material(specular=0.4), gbuffer=gbuffer))
    near(image[7, 7], at_vertices[2])
    near(image[0, 0], at_vertices[3])


def test_a_vertex_between_two_materials_is_lit_with_both():
    mesh = square(material_index=[1, 0])
    scene = pf.Scene(mesh, VIEW, ambient=1, shading=pf.GouraudShading())
    both = pf.Material(diffuse=0, ambient=[[1, 0, 0], [0, 0, 1]])
    image = np.asarray(pf.render(scene, both))
    near(image[7, 7], (0, 0, 1))
    near(image[0, 0], (1, 0, 0))
    # No pixel is in between.
    assert len(np.unique(image.reshape(-1, 3), axis=0)) == 2
    colours, _ = lit(scene, both)
    assert len(colours) == 6


SHADINGS = [
    pf.PhongShading(),
    pf.GouraudShading(),
    pf.FlatShading(),
    pf.FlatShading("last_vertex"),
]
SUN = pf.DirectionalLight((0.5, 0.3, 2))


def image_of(mesh, shading, material):
    scene = pf.Scene(mesh, VIEW, SUN, 0.3, shading=shading)
    return np.asarray(pf.render(scene, material))


@pytest.mark.parametrize("shading", SHADINGS)
def test_several_materials_in_a_mesh(shading):
    materials = [pf.Material(0.8, 0.4, 9.0), pf.Material((0.2, 0.3, 0), 0.1, 30.0, 1)]
    together = stack_materials(materials)
    image = image_of(square(material_index=[1, 0]), shading, together)
    first, second = (image_of(square(), shading, one) for one in materials)
    lower = np.arange(8)[:, None] + np.arange(8) >= 8
    near(image[lower], second[lower])
    upper = np.arange(8)[:, None] + np.arange(8) < 7
    near(image[upper], first[upper])


@pytest.mark.parametrize("shading", SHADINGS)
def test_the_back_of_a_two_sided_mesh_is_lit_as_a_front(shading):
    index, material = [1, 0], pf.Material([[0.8], [0.3]], 0.4, 9.0)
    front = image_of(square(material_index=index), shading, material)
    # The corners in the other order, the last one (of GL_FLAT) the same.
    turned = np.array(HALVES)[:, [1, 0, 2]]
    inside_out = pf.Mesh(SQUARE, turned, -TILTED, index, two_sided=True)
    near(image_of(inside_out, shading, material), front)
    assert front.min() > 0.1


@pytest.mark.parametrize("kind", [pf.FlatShading, pf.GouraudShading])
def test_colours_are_clamped_before_they_are_spread_and_fogged(kind):
    fog = pf.Fog(0, "exp", density=0.2)
    plain = pf.Scene(square(), VIEW, ambient=3, shading=kind(), fog=fog)
    clamped = pf.Scene(square(), VIEW, ambient=3, shading=kind(clamp=True), fog=fog)
    material, film = pf.Material(ambient=1), pf.Film(clamp=False)
    share = np.exp(-0.2 * 5)
    near(pf.render(plain, material, film=film), np.full((8, 8, 3), 3 * share))
    near(pf.render(clamped, material, film=film), np.full((8, 8, 3), share))


def test_the_essays_triangle():
    """A highlight in the middle of a large triangle: Gouraud misses it."""
    mesh = pf.Mesh([[-4, -3, 0], [4, -3, 0], [0, 4, 0]], [[0, 1, 2]])

    def image(shading, specular=0.7):
        material = pf.Material(0.3, specular, 50.0, 0)
        view = pf.OrthographicCamera(21, 21, view_height=4)
        light = pf.PointLight((0, 0, 3))
        return np.asarray(
            pf.render(pf.Scene(mesh, view, light, shading=shading), material)
        )

    phong, gouraud = image(pf.PhongShading()), image(pf.GouraudShading())
    flat = image(pf.FlatShading())
    near(phong[10, 10], 1.0)
    assert phong[0, 0].max() < 0.3
    # At the corners, the half vector is tens of degrees off: 0.003 is left.
    assert gouraud.max() < 0.2
    near(gouraud, image(pf.GouraudShading(), specular=0.0), 5e-3)
    assert len(np.unique(flat[phong[..., 0] > 0])) == 1


@pytest.mark.parametrize("shading", [pf.FlatShading(), pf.GouraudShading()])
def test_faces_and_vertices_are_wanted(shading):
    with pytest.raises(ValueError, match="^shading: expected a Mesh .*, got Sphere"):
        pf.Scene(pf.Sphere(), shading=shading)
    scene = pf.Scene(square(), VIEW, shading=shading)
    with pytest.raises(ValueError, match="^gbuffer: .*faces"):
        pf.render(scene, pf.Material(), gbuffer=pf.geometry.trace(pf.Sphere(), VIEW))


def test_flat_shading_knows_two_places():
    with pytest.raises(ValueError, match="^at: expected .*, got 'first'"):
        pf.FlatShading("first")  # pyright: ignore[reportArgumentType]
