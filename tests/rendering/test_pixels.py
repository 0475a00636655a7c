"""What an image is made of, for every shading method: the fit rests on it."""

import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.testing import check_gradients
from tests.helpers import close, near

# A bumpy sheet of three materials, its vertices shared between them.
BASE = pf.shapes.HeightField(lambda x, y: 0.2 * jnp.sin(4 * x) * jnp.cos(3 * y)).mesh(
    5, 4
)
SHEET: dict[str, Any] = dict(
    vertices=np.asarray(BASE.vertices),
    faces=np.asarray(BASE.faces),
    normals=np.asarray(BASE.normals),
)
INDEX = np.arange(len(BASE.faces)) % 3
SHADINGS = {
    "Phong": pf.PhongShading(),
    "Gouraud": pf.GouraudShading(),
    "flat": pf.FlatShading(),
    "GL_FLAT": pf.FlatShading("last_vertex"),
}


each_shading = pytest.mark.parametrize(
    "shading", SHADINGS.values(), ids=SHADINGS.keys()
)
extended = pytest.mark.extended


def world(shading, **keywords):
    # No pixel looks at an edge, where the image jumps.
    place = (0.5, 0.3, 4), (0.03, 0.04, 0)
    view = pf.PerspectiveCamera.look_at(*place, width=9, height=7, fov_y=35)
    lights = (
        pf.DirectionalLight((2, 0, 1), (0.5, 0.4, 0.3)),
        pf.PointLight((-1, 1, 2), 0.5, attenuation=(1, 0.1, 0)),
    )
    fog = pf.Fog((0.2, 0.3, 0.4), "exp", density=0.1)
    mesh = pf.Mesh(**SHEET, material_index=INDEX)
    options: dict[str, Any] = dict(shadows=True, fog=fog, background=0.1) | keywords
    return pf.Scene(mesh, view, lights, 0.3, shading=shading, **options)


@eqx.filter_jit
def lit(light, positions):
    return jax.vmap(light.illuminate)(positions)


@eqx.filter_jit
def radiance(pixels, material):
    return pixels.radiance(material)


def materials(seed=0):
    rng = np.random.default_rng(seed)
    return pf.Material(
        diffuse=rng.uniform(0.1, 0.9, (3, 3)),
        specular=rng.uniform(0.1, 0.9, (3, 1)),
        shininess=rng.uniform(5, 30, (3, 1)),
        ambient=0.4,
        emission=(0.01, 0.02, 0.03),
    )


@each_shading
def test_linear_in_the_reflectances_and_in_fog(shading):
    """Fog keeps a share of the light, and adds its colour."""
    scene = world(shading)
    gbuffer = scene.trace()
    pixels = pf.rendering.pixel_terms(
        eqx.tree_at(lambda s: s.fog, scene, None), gbuffer
    )
    one, other = materials(1), materials(2)
    other = eqx.tree_at(lambda m: m.shininess, other, one.shininess)
    mixed = jax.tree.map(lambda x, y: 0.3 * x + 0.6 * y, one, other)
    mixed = eqx.tree_at(lambda m: m.shininess, mixed, one.shininess)
    clear, second, both = (
        np.asarray(radiance(pixels, material)) for material in (one, other, mixed)
    )
    near(both, 0.3 * clear + 0.6 * second, 5 * close())

    depth = jax.vmap(jax.vmap(scene.camera.depth))(gbuffer.position)
    share = np.exp(-0.1 * np.asarray(depth))[..., None]
    expected = share * clear + (1 - share) * np.array([0.2, 0.3, 0.4])
    near(radiance(pf.rendering.pixel_terms(scene, gbuffer), one), expected)


@pytest.mark.parametrize(
    "shading",
    [
        *(pytest.param(one, id=name) for name, one in SHADINGS.items()),
        pytest.param(pf.GouraudShading(clamp=True), id="Gouraud, clamped"),
        pytest.param(pf.FlatShading(clamp=True), id="flat, clamped", marks=extended),
    ],
)
def test_some_pixels_are_those_of_the_image(shading):
    scene = world(shading)
    gbuffer = scene.trace()
    pixels, material = pf.rendering.pixel_terms(scene, gbuffer), materials()
    light, mask = np.asarray(radiance(pixels, material)), np.asarray(gbuffer.mask)
    image = pf.render(scene, material, gbuffer=gbuffer)
    assert 0.3 < mask.mean() < 1
    near(image[mask], np.clip(light, 0, 1)[mask])
    near(image[~mask], 0.1)
    assert np.all(np.isfinite(light)), "placeholders must be finite"

    chosen = np.flatnonzero(mask)[::3]
    some = pixels.select(jnp.asarray(chosen))
    expected, found = light.reshape(-1, 3)[chosen], radiance(some, material)
    near(found, expected)
    assert found.shape == (len(chosen), 3)
    # Traced, it takes them all along; chosen twice, it is the same.
    select = eqx.filter_jit(lambda p, i: p.select(i).radiance(material))
    near(select(pixels, jnp.asarray(chosen)), expected)
    near(radiance(some.select(jnp.arange(4)), material), expected[:4])


def test_of_the_points_that_are_lit_only_those_that_show_are_kept():
    mesh = pf.shapes.Torus().mesh(64, 32)
    scene = pf.Scene(mesh, pf.PerspectiveCamera(20, 20), shading=pf.GouraudShading())
    gbuffer = scene.trace()
    pixels = pf.rendering.pixel_terms(scene, gbuffer)
    some = pixels.select(jnp.asarray(np.flatnonzero(gbuffer.mask)[:20]))
    assert len(pixels.terms.diffuse) == 65 * 33
    assert len(some.terms.diffuse) <= 64


# By default, of a mesh with Gouraud shading: `geometry/test_meshes`.
@extended
@each_shading
def test_gradients_in_every_leaf(shading):
    scene = world(shading)
    assert scene.trace().mask.any()
    check_gradients(lambda both: pf.render(*both), (scene, materials()), order=1)


@extended
@each_shading
def test_second_derivatives_in_the_material(shading):
    scene = world(shading)
    pixels = pf.rendering.pixel_terms(scene, scene.trace())
    check_gradients(lambda both: both[0].radiance(both[1]), (pixels, materials()))


CAMERAS = pf.OrthographicCamera, pf.PerspectiveCamera
# Each shading once, and each pair of a camera and a viewer.
VIEWERS = set(zip(SHADINGS, 2 * CAMERAS, (False, True, True, False), strict=True))


@pytest.mark.parametrize(
    "name, kind, local_viewer",
    [
        pytest.param(*row, marks=() if row in VIEWERS else extended)
        for row in itertools.product(SHADINGS, CAMERAS, (False, True))
    ],
)
def test_where_the_viewer_is_for_the_light(name, kind, local_viewer):
    shading = SHADINGS[name]
    view = kind.look_at((0.5, 0.3, 4), width=5, height=4)
    plain = world(shading, shadows=False)
    plain = eqx.tree_at(lambda s: s.camera, plain, view)
    scene = pf.Scene(
        plain.surface, view, plain.lights, shading=shading, local_viewer=local_viewer
    )
    gbuffer = scene.trace()
    points = shading.points(scene.surface, view, gbuffer)
    if local_viewer:
        toward = np.asarray(view.position) - np.asarray(points.position)
        toward /= np.linalg.norm(toward, axis=-1, keepdims=True)
    else:
        toward = np.broadcast_to(view.rotation[:, 2], points.position.shape)
    # Both highlights as they are computed from the half vector by hand.
    for i, light in enumerate(scene.lights):
        flat = points.position.reshape(-1, 3)
        to_light = np.asarray(lit(light, flat).to_light)
        half = to_light + toward.reshape(-1, 3)
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        normal = np.asarray(points.normal).reshape(-1, 3)
        expected = np.sum(half * normal, axis=1) * (
            np.sum(to_light * normal, axis=1) > 0
        )
        found = np.asarray(pf.terms(scene, gbuffer).cosine)[..., i].ravel()
        near(found, expected, 5 * close())


def test_materials_per_pixel_of_a_normal_map():
    normals = np.broadcast_to([0.0, 0, 1], (2, 3, 3))
    surface = pf.NormalMap(normals, material_index=[[0, 1, 2], [2, 1, 0]])
    scene = pf.Scene(surface, pf.OrthographicCamera(3, 2), ambient=1)
    image = pf.render(scene, pf.Material(ambient=[[0.1], [0.2], [0.3]]))
    near(image[..., 0], [[0.1, 0.2, 0.3], [0.3, 0.2, 0.1]])


@pytest.mark.parametrize(
    "named, material",
    [
        ("diffuse", pf.Material(diffuse=np.full((2, 3), 0.5))),
        ("shininess", pf.Material(shininess=np.full((2, 1), 9.0))),
        ("specular", pf.Material(specular=np.full((5, 9, 3), 0.5))),
        ("emission", pf.Material(emission=np.zeros((7, 9, 3)))),
    ],
)
def test_a_material_that_does_not_fit(named, material):
    # A map fits the pixels of Phong shading, but not the vertices of Gouraud's.
    scene = world(pf.GouraudShading())
    with pytest.raises(ValueError, match=f"^{named}: "):
        pf.render(scene, material)
    if named == "emission":
        pf.render(world(pf.PhongShading()), material)


def test_more_materials_than_the_surface_has_are_no_fault():
    rows = np.full((5, 3), 0.5)
    one = pf.render(world(pf.PhongShading()), pf.Material(diffuse=rows))
    near(one, pf.render(world(pf.PhongShading()), pf.Material(diffuse=0.5)))
