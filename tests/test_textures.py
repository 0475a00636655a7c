import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.textures import texels
from tests.fitting.texels.scenes import plate
from tests.helpers import floats, near

# Two rows of three texels.
VALUES = np.arange(6.0).reshape(2, 3, 1)


@eqx.filter_jit
def texels_at(texture, uv):
    return texture.at(uv)


@pytest.mark.parametrize(
    "filter, wrap, rows",
    [
        (
            "bilinear",
            "repeat",
            [
                # The centres of texels, counted from the upper left corner.
                ((1 / 6, 1 / 4), 0),
                ((1 / 2, 1 / 4), 1),
                ((1 / 6, 3 / 4), 3),
                # Between two, and between four.
                ((1 / 3, 1 / 4), 0.5),
                ((1 / 3, 1 / 2), 2),
                # The left edge lies between the first column and the last.
                ((0, 1 / 4), 1),
                # Whole images away.
                ((1 / 2 - 4, 1 / 4 + 7), 1),
            ],
        ),
        # The left edge is the first column.
        ("bilinear", "clamp", [((0, 1 / 4), 0), ((-7, 9), 3)]),
        ("nearest", "repeat", [((0.3, 0.1), 0), ((0.34, 0.6), 4), ((1.0, 0.0), 0)]),
        ("nearest", "clamp", [((1.0, 1.0), 5)]),
    ],
)
def test_texels(filter, wrap, rows):
    texture = pf.Texture(VALUES, filter, wrap)
    uv, expected = (np.array(column) for column in zip(*rows, strict=True))
    near(texels_at(texture, floats(uv)), expected[:, None])
    near(texels_at(texture, floats(uv[0])), expected[:1])


@pytest.mark.parametrize("wrap", ["repeat", "clamp"])
def test_weights_sum_to_one_and_texels_are_there(wrap):
    uv = floats(np.random.default_rng(0).uniform(-2, 3, (500, 2)))
    index, weight = jax.jit(lambda uv: texels(uv, (5, 7), "bilinear", wrap))(uv)
    near(np.sum(weight, axis=-1), 1)
    assert np.min(weight) >= 0 and np.min(index) >= 0 and np.max(index) < 35
    near(texels_at(pf.Texture(np.ones((5, 7, 3)), wrap=wrap), uv), 1)


@pytest.mark.parametrize(
    "values, words",
    [
        (np.ones((2, 2)), "values: expected shape"),
        (np.ones((2, 2, 2)), "values: expected shape"),
        (np.ones((0, 2, 3)), "values: expected shape"),
        (np.full((1, 1, 3), np.nan), "values: expected finite"),
    ],
)
def test_what_is_no_texture(values, words):
    with pytest.raises(ValueError, match=words):
        pf.Texture(values)


def test_what_textures_do_not_take():
    with pytest.raises(ValueError, match="filter: expected"):
        pf.Texture(VALUES, "cubic")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="wrap: expected"):
        pf.Texture(VALUES, wrap="mirror")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="diffuse: expected numbers ≥ 0"):
        pf.Textures(diffuse=pf.Texture(-VALUES))
    with pytest.raises(ValueError, match="shininess: expected a texture"):
        pf.Textures(shininess=pf.Texture(np.ones((1, 1, 3))))
    with pytest.raises(ValueError, match="normal: expected a texture"):
        pf.Textures(normal=pf.Texture(VALUES))
    with pytest.raises(ValueError, match="diffuse: expected numbers ≥ 0"):
        pf.Textures(diffuse=pf.VertexColours(-np.ones((4, 1))))
    for values in (np.ones(3), np.ones((4, 2)), np.ones((0, 3)), np.ones((1, 1, 3))):
        with pytest.raises(ValueError, match=r"values: expected shape \(V, 3\)"):
            pf.VertexColours(values)


def test_normals_are_a_texture():
    with pytest.raises(ValueError, match="normal: expected a Texture, got"):
        pf.Textures(normal=pf.VertexColours(np.ones((4, 3))))  # pyright: ignore


CAMERA = pf.OrthographicCamera(8, 8, view_height=2)
FRONT = pf.DirectionalLight((0, 0, 1))


def seen(textures, material, shading=None, light=FRONT, ambient=0.0, **changes):
    scene = pf.Scene(
        plate(textures, **changes), CAMERA, light, ambient, shading=shading
    )
    return np.asarray(pf.render(scene, material))


@pytest.mark.parametrize(
    "shading", [pf.PhongShading(), pf.GouraudShading(), pf.FlatShading()]
)
def test_textures_multiply_what_they_are_named_after(shading):
    names = ("diffuse", "specular", "ambient", "emission")
    each = np.random.default_rng(0).uniform(0.1, 0.9, (4, 4, 4, 3))
    values = dict(zip(names, each, strict=True))
    textures = pf.Textures(**{n: pf.Texture(v, "nearest") for n, v in values.items()})
    for name in names:
        material = pf.Material(**(dict.fromkeys(names, 0.0) | {name: 0.5}))
        image = seen(textures, material, shading, ambient=1.0)
        # Nearest, and twice as many pixels along a side.
        shown = np.repeat(np.repeat(values[name], 2, axis=0), 2, axis=1)
        near(image, 0.5 * shown)
    glowing = pf.Material(0.0, emission=0.5, ambient=0.0)
    alone = pf.Textures(ambient=textures.ambient)
    near(seen(alone, glowing, shading, ambient=1.0), 0.5)


def test_an_exponent_for_each_texel():
    values = np.array([[[1.0], [0.5]]])
    light = pf.DirectionalLight((0.6, 0, 0.8))
    textures = pf.Textures(shininess=pf.Texture(values, "nearest"))
    image = seen(textures, pf.Material(0.0, 1.0, 40.0, 0.0), light=light)
    for half, f in ((image[:, :4], 40.0), (image[:, 4:], 20.0)):
        near(half, seen(None, pf.Material(0.0, 1.0, f, 0.0), light=light)[:, :4])
    with pytest.raises(ValueError, match="textures: .* needs Phong shading"):
        seen(textures, pf.Material(), pf.GouraudShading())


def test_a_normal_map_turns_normals():
    # To the right, upwards in the image, and ahead.
    for local, direction in (
        ((0.6, 0, 0.8), (0.6, 0, 0.8)),
        ((0, 0.6, 0.8), (0, 0.6, 0.8)),
        ((0, 0, 1), (0, 0, 1)),
    ):
        textures = pf.Textures(normal=pf.Texture([[local]]))
        buffer = pf.geometry.trace(plate(textures), CAMERA)
        near(np.asarray(buffer.normal), np.broadcast_to(direction, (8, 8, 3)))
    # A mirrored texture: its right is the plate's left.
    mirrored = plate(pf.Textures(normal=pf.Texture([[(0.6, 0, 0.8)]])))
    mirrored = pf.Mesh(
        mirrored.vertices,
        mirrored.faces,
        uv=np.asarray(mirrored.uv) * [-1, 1],
        textures=mirrored.textures,
    )
    buffer = pf.geometry.trace(mirrored, CAMERA)
    near(np.asarray(buffer.normal), np.broadcast_to((-0.6, 0, 0.8), (8, 8, 3)))


def test_materials_have_their_own_textures():
    red, blue = ([[colour]] for colour in ((1.0, 0, 0), (0, 0, 1.0)))
    textures = [pf.Textures(diffuse=pf.Texture(colour)) for colour in (red, blue)]
    material = pf.Material(np.array([[1.0] * 3, [0.5] * 3]), 0.0, 1.0, 0.0)
    image = seen(textures, material, material_index=[0, 1])
    near(image[7, 6], (1, 0, 0))
    near(image[1, 0], (0, 0, 0.5))
    with pytest.raises(ValueError, match="textures: expected one for all .* got 3"):
        plate([pf.Textures()] * 3, material_index=[0, 1])


@pytest.mark.extended
def test_a_fit_finds_the_factors_of_textures():
    textures = [
        pf.Textures(diffuse=pf.Texture([[colour]]))
        for colour in ((1.0, 0, 0), (0, 0, 1.0))
    ]
    scene = pf.Scene(plate(textures, material_index=[0, 1]), CAMERA, FRONT)
    grey = pf.Material(ambient=0.0)
    image = pf.render(scene, pf.Material([[1.0], [0.5]], ambient=0.0))
    fit = pf.fit(scene, image, unknowns=("diffuse",), per_channel=(), known=grey)
    near(np.asarray(fit.material.diffuse)[:, 0], (1, 0.5), 1e-4)


def test_a_mesh_with_textures_needs_uv():
    mesh, wood = plate(), pf.Textures(diffuse=pf.Texture(VALUES))
    with pytest.raises(ValueError, match="textures: expected a mesh with uv"):
        pf.Mesh(mesh.vertices, mesh.faces, textures=wood)
    with pytest.raises(ValueError, match="uv: expected shape"):
        pf.Mesh(mesh.vertices, mesh.faces, uv=np.zeros((4, 2)))
    textured = mesh.with_textures(wood)
    assert textured.textures is not None and mesh.textures is None
    assert textured.with_textures(None).textures is None


def test_joined_meshes_keep_their_textures():
    red = pf.Textures(diffuse=pf.Texture([[(1.0, 0, 0)]]))
    bare = pf.Mesh(np.asarray(plate().vertices) + [0, 0, -1], plate().faces)
    both = pf.geometry.join([bare, plate(red)])
    white = pf.Material(np.ones((2, 1)), 0.0, 1.0, 0.0)
    scene = pf.Scene(both, CAMERA, FRONT)
    near(np.asarray(pf.render(scene, white)), np.broadcast_to((1, 0, 0), (8, 8, 3)))


def test_texels_have_gradients():
    values = floats(np.random.default_rng(0).uniform(size=(4, 4, 3)))
    buffer = pf.geometry.trace(plate(), CAMERA)

    @jax.jit
    def mean(values):
        textured = plate().with_textures(pf.Textures(diffuse=pf.Texture(values)))
        scene = pf.Scene(textured, CAMERA, FRONT)
        return jnp.mean(pf.render(scene, pf.Material(1.0, ambient=0.0), gbuffer=buffer))

    # Each is seen in as many pixels: a third of a channel's mean over 16 texels.
    near(jax.grad(mean)(values), np.full((4, 4, 3), 1 / 48), 1e-5)


ASKEW = np.array([[-1, -1, 1], [1.2, -0.8, -1], [-0.1, 1.1, 0.3], [2, 2, -1]])


def test_colours_of_vertices_are_linear_in_space():
    """Where a ray meets the plane, by hand: areas in the plane, not in the image."""
    colours = np.random.default_rng(0).uniform(0.1, 0.9, (4, 3))
    textures = pf.Textures(emission=pf.VertexColours(colours))
    mesh = pf.Mesh(ASKEW, [[0, 1, 2], [1, 3, 2]], textures=textures)
    camera = pf.PerspectiveCamera.look_at((0, 0, 2.5), width=16, height=16, fov_y=60)
    scene = pf.Scene(mesh, camera, FRONT)
    material = pf.Material(0.0, 0.0, 1.0, 0.0, emission=0.5)
    buffer, image = scene.trace(), np.asarray(pf.render(scene, material))
    points, mask = np.asarray(buffer.position), np.asarray(buffer.mask)
    assert mask.sum() > 50 and len(set(np.asarray(buffer.face)[mask])) == 2
    for place in np.argwhere(mask):
        corners = np.asarray(mesh.faces)[np.asarray(buffer.face)[tuple(place)]]
        # Position and weights: p = Σ w v, Σ w = 1.
        matrix = np.vstack([ASKEW[corners].T, np.ones(3)])
        point = np.append(points[tuple(place)], 1)
        weights = np.linalg.lstsq(matrix, point, rcond=None)[0]
        near(image[tuple(place)], 0.5 * weights @ colours[corners], 1e-4)


def test_colours_of_vertices_are_in_the_materials_place():
    values = np.random.default_rng(1).uniform(0.2, 1, (4, 1))
    each = [pf.Textures(specular=pf.VertexColours(values)), pf.Textures()]
    mesh = pf.Mesh(plate().vertices, plate().faces, None, [0, 1], textures=each)
    scene = pf.Scene(mesh, CAMERA, FRONT)
    material = pf.Material(0.0, np.ones((2, 1)), 1e-3, 0.0)
    image = np.asarray(pf.render(scene, material))
    # The other triangle has none. At a pixel's centre its weights are known.
    near(image[1, 0], (1, 1, 1), 1e-3)
    weights = np.array([1 - 7.5 / 8, 7.5 / 8 - 1.5 / 8, 1.5 / 8])
    near(image[6, 7], np.repeat(weights @ values[:3], 3), 2e-3)
    # An exponent, too, and a mesh that is cut open keeps its colours.
    bent = pf.Textures(shininess=pf.VertexColours(values), diffuse=each[0].specular)
    half = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 0, 1.0]])
    faces = [[0, 1, 2], [0, 2, 3]]
    for angle in (None, 10.0):
        cut = pf.Mesh(half, faces, textures=bent, crease_angle=angle)
        rows = np.asarray(cut.textures[0].diffuse.values)  # pyright: ignore
        for point, row in zip(np.asarray(cut.vertices), rows, strict=True):
            near(row, values[np.flatnonzero((half == point).all(axis=1))[0]])
    assert len(rows) == 6
    with pytest.raises(ValueError, match="diffuse: expected a row for each of 3 vert"):
        pf.Mesh(half[:3], [[0, 1, 2]], textures=bent)


def test_joined_meshes_keep_the_colours_of_their_vertices():
    red = pf.Textures(diffuse=pf.VertexColours([(1.0, 0, 0)] * 4))
    bare = pf.Mesh(np.asarray(plate().vertices) + [0, 0, 1], plate().faces[:1])
    both = pf.geometry.join(
        [bare, pf.Mesh(plate().vertices, plate().faces, textures=red)]
    )
    white = pf.Material(np.ones((2, 1)), 0.0, 1.0, 0.0)
    image = np.asarray(pf.render(pf.Scene(both, CAMERA, FRONT), white))
    near(image[7, 6], (1, 1, 1))
    near(image[1, 0], (1, 0, 0))


def test_colours_of_vertices_have_gradients():
    values = floats(np.random.default_rng(0).uniform(size=(4, 3)))
    bare = pf.Mesh(plate().vertices, plate().faces)
    buffer = pf.geometry.trace(bare, CAMERA)

    @jax.jit
    def mean(values):
        colours = pf.Textures(diffuse=pf.VertexColours(values))
        scene = pf.Scene(bare.with_textures(colours), CAMERA, FRONT)
        return jnp.mean(pf.render(scene, pf.Material(1.0, ambient=0.0), gbuffer=buffer))

    slopes = np.asarray(jax.grad(mean)(values))
    # The two on the diagonal are corners of both triangles.
    near(slopes[[1, 3]], np.full((2, 3), slopes[1, 0]), 1e-6)
    near(slopes.sum(), 1, 1e-5)
    assert slopes[0, 0] > 1.5 * slopes[1, 0]
    step = np.zeros((4, 3))
    step[2, 1] = 0.1
    near((mean(values + step) - mean(values)) / 0.1, slopes[2, 1], 1e-3)


def test_several_rays_make_smooth_outlines():
    scene = pf.Scene(pf.Sphere(), pf.OrthographicCamera(16, 16), background=1.0)
    black = pf.Material(0.0, 0.0, 1.0, 0.0)
    once, smooth = (np.asarray(pf.render(scene, black, samples=n)) for n in (1, 16))
    assert set(np.unique(once)) == {0, 1}
    assert np.any((smooth > 0.2) & (smooth < 0.8))
    covered = np.pi / 2.2**2
    assert abs(1 - smooth.mean() - covered) < 0.5 * abs(1 - once.mean() - covered)
    for samples in (0, 2, -1):
        with pytest.raises(ValueError, match="samples: expected 1, 4, 9"):
            pf.render(scene, black, samples=samples)
    with pytest.raises(ValueError, match="samples: expected 1 with a gbuffer"):
        pf.render(scene, black, samples=4, gbuffer=scene.trace())
    normals = pf.NormalMap(np.ones((16, 16, 3)))
    with pytest.raises(ValueError, match="samples: expected 1 for a normal map"):
        pf.render(pf.Scene(normals, scene.camera), black, samples=4)
