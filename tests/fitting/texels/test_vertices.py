"""Numbers at vertices: their sums, and fits of them against the truth."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

import phongfit as pf
from phongfit.files.fits import DataRecord, DataSettings
from phongfit.files.texture_fits import save_texture_fit
from phongfit.fitting.texels import solve
from phongfit.fitting.texels.result import TextureFit
from phongfit.fitting.texels.solve import inverse_diagonal, precondition
from phongfit.fitting.texels.sums import Touched
from phongfit.fitting.texels.vertices import RINGS, Vertices
from phongfit.geometry.surfaces import GBuffer
from tests.fitting.texels import ball
from tests.fitting.texels.ball import BALL, NOISE, TRUE, painted, scenes
from tests.fitting.texels.scenes import photographs, shiny
from tests.fitting.texels.test_sums import check_differences, dense, products
from tests.helpers import floats, near

RNG = np.random.default_rng(0)


def fan(spokes: int = 40) -> trimesh.Trimesh:
    """A tip that all faces share, and one face without an area."""
    angle = np.arange(spokes) / spokes * 2 * np.pi
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(spokes)], axis=1)
    number = np.arange(spokes)
    faces = np.stack([number * 0, number + 1, (number + 1) % spokes + 1], axis=1)
    points = np.concatenate([[[0, 0, 1]], rim])
    return trimesh.Trimesh(points, [*faces, [3, 3, 9]], process=False)


def vertices(mesh: trimesh.Trimesh, layers: int = 1) -> Vertices:
    return Vertices(layers, np.asarray(mesh.vertices), np.asarray(mesh.faces))


def touched(texels: Vertices, count: int = 400) -> Touched:
    """Random points of random faces, each of a layer."""
    faces = len(texels.faces) - (texels.faces[-1, 0] == texels.faces[-1, 1])
    face, weights = RNG.integers(0, faces, count), RNG.dirichlet([1, 1, 1], count)
    nothing = floats(np.zeros((count, 3)))
    mask, place = jnp.ones(count, bool), (jnp.asarray(face), floats(weights))
    buffer = GBuffer(
        nothing, nothing, nothing, mask, face=place[0], barycentrics=place[1]
    )
    layers = texels.shape[0]
    layer = RNG.integers(0, layers, count).astype(np.int32) if layers > 1 else None
    return texels.touched(buffer, layer)


ICO = trimesh.creation.icosphere(1)


@pytest.mark.parametrize("mesh", [ICO, fan()], ids=["ball", "fan"])
@pytest.mark.parametrize("layers", [1, 2])
def test_sums_are_those_of_the_whole_matrix(mesh, layers):
    texels = vertices(mesh, layers)
    seen, count = touched(texels), texels.texels
    whole = dense(seen, count)
    columns = [RNG.normal(size=len(whole)) for _ in range(2)]
    blocks = {
        (p, q): products(seen, columns[p] * columns[q], count)
        for p, q in ((0, 0), (0, 1), (1, 1))
    }
    both = np.concatenate([column[:, None] * whole for column in columns], axis=1)
    prior = RNG.uniform(size=2 * count)
    matrix = texels.matrix(blocks, 2, prior)
    near(matrix.toarray(), both.T @ both + np.diag(prior), 1e-4)
    # Fields that no sample couples.
    del blocks[0, 1]
    apart = texels.matrix(blocks, 2, 1.0).toarray()
    assert not apart[:count, count:].any()
    near(apart[count:, count:], both.T[count:] @ both[:, count:] + np.eye(count), 1e-4)
    # The tip of a fan, which has many, keeps none of its edges.
    assert texels.slots <= 6
    # One vertex, the nearest.
    best = seen.weight.argmax(axis=1)[:, None]
    number = np.take_along_axis(seen.number, best, axis=1)
    alone = Touched(number, np.ones(number.shape))
    blocks = {(0, 0): products(alone, columns[0] ** 2, count)}
    one = columns[0][:, None] * dense(alone, count)
    near(texels.matrix(blocks, 1, 0.5).toarray(), one.T @ one + np.eye(count) / 2, 1e-4)


def test_neighbours_are_the_ends_of_edges():
    texels = vertices(ICO, 2)
    first, second, _ = texels.links()
    found = {frozenset(pair) for pair in zip(first, second, strict=True)}
    edges = [*ICO.edges_unique, *(np.asarray(ICO.edges_unique) + len(ICO.vertices))]
    assert found == {frozenset(pair) for pair in edges} and len(found) == len(first)
    check_differences(texels)


def test_vertices_of_one_colour_are_far_apart():
    texels = vertices(trimesh.creation.icosphere(3), 2)
    colours, count = texels.colours(), len(texels.points)
    assert colours.max() < 120 and (colours[:count] == colours[count:]).all()
    first, second = (one[: len(one) // 2] for one in texels.links()[:2])
    graph = sparse.csr_array((np.ones(len(first)), (first, second)), (count, count))
    apart = dijkstra(graph, directed=False, unweighted=True)
    same = (colours[:count, None] == colours[:count]) & ~np.eye(count, dtype=bool)
    assert same.any() and apart[same].min() > RINGS


def test_variances_are_those_of_the_inverse(monkeypatch):
    texels = vertices(trimesh.creation.icosphere(3))
    seen = touched(texels, 4 * texels.texels)
    light = RNG.uniform(0.2, 1, len(seen.number))
    matrix = texels.matrix({(0, 0): 1e3 * products(seen, light, texels.texels)}, 1, 1.0)
    exact = np.diag(np.linalg.inv(matrix.toarray()))
    ready = precondition(matrix)
    near(inverse_diagonal(ready, texels, 1), exact, 1e-6)
    monkeypatch.setattr(solve, "EXACT", 0)
    ratio = np.sqrt(inverse_diagonal(ready, texels, 1) / exact)
    assert abs(np.median(ratio) - 1) < 0.01
    assert np.quantile(abs(ratio - 1), 0.9) < 0.1


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    return ball.images()


def fitted(scene, image, **options) -> TextureFit:
    known = pf.Material(ambient=0.0)
    given: Any = {"size": "vertices", "per_channel": (), "known": known}
    return pf.fit_texture(scene, image, **(given | options))


def pulls(fit: TextureFit, true=TRUE) -> np.ndarray:
    """Of vertices that are seen at least three times."""
    errors = fit.stderr["diffuse"][0]
    told = np.isfinite(errors) & (fit.seen[0] >= 3)[:, None]
    assert told.mean() > 0.85
    return ((fit.values["diffuse"][0] - true) / errors)[told]


@pytest.mark.extended
def test_numbers_at_vertices_and_a_shared_highlight(images, tmp_path):
    fit = fitted(scenes(), images)
    assert fit.converged and not fit.warnings, fit
    assert fit.values["diffuse"].shape == (1, *TRUE.shape)
    assert 0.9 < np.sqrt(np.mean(pulls(fit) ** 2)) < 1.1
    for one, true in zip(fit.shared, (0.3, 20.0), strict=True):
        assert abs(one.value - true) < 4 * one.stderr < 0.2 * true
    assert abs(fit.noise / NOISE - 1) < 0.05
    assert f"of {len(TRUE)} vertices identified" in str(fit)
    # What was found is a scene again, and a file.
    found = fit.scene(scenes()[0])
    assert isinstance(found.surface, pf.Mesh)
    truth = np.asarray(pf.render(painted(diffuse=TRUE)[0], shiny()))
    image = np.asarray(pf.render(found, fit.material))
    assert np.sqrt(np.mean((image - truth) ** 2)) < NOISE
    for suffix in ("glb", "obj"):
        pf.save_mesh(tmp_path / f"a.{suffix}", found.surface, fit.material)
        mesh, material, _ = pf.load_mesh(tmp_path / f"a.{suffix}")
        again = pf.render(dataclasses.replace(found, surface=mesh), material)
        near(again, image, 1e-4)


def test_vertices_that_nothing_sees(images):
    """One photograph: the far side is marked, and filled for others alone."""
    fit = fitted(scenes()[0], images[0], unknowns=("diffuse.texture",))
    errors, seen = fit.stderr["diffuse"][0], fit.seen[0]
    far = np.asarray(BALL.vertices)[:, 2] < -0.2
    assert (seen[far] == 0).all() and np.isinf(errors[seen == 0]).all()
    filled, known = fit.filled("diffuse")[0], np.isfinite(errors)
    near(filled[known], fit.values["diffuse"][0][known])
    (back,) = np.flatnonzero((np.asarray(BALL.vertices) == [0, 0, -1]).all(axis=1))
    told = known[:, 0]
    apart = np.linalg.norm(BALL.vertices - BALL.vertices[back], axis=1)
    assert filled[back, 0] in filled[told & (apart < apart[told].min() + 1e-6), 0]


@pytest.mark.extended
def test_exponents_of_vertices_by_way_of_files(tmp_path):
    """Half of the ball is sharper; a mesh file looks as the photographs do."""
    right = np.asarray(BALL.vertices)[:, :1] > 0
    f, model = np.where(right, 30.0, 12.0), pf.BlinnPhong(normalized=True)
    rho = np.full(TRUE.shape, 0.04)
    views = [
        dataclasses.replace(one, specular_model=model)
        for one in painted(diffuse=TRUE, specular=rho, shininess=f)
    ]
    bare = [dataclasses.replace(one, surface=ball.bare()) for one in views]
    light = photographs(views, pf.Material(1.0, 1.0, 1.0, 0.0), 0.0)
    names = ("diffuse", "specular", "shininess")
    fit = fitted(bare, light, unknowns=[f"{name}.texture" for name in names])
    errors = fit.stderr["shininess"][0]
    assert errors.shape == f.shape and np.isfinite(errors).mean() > 0.5
    data = DataRecord(name="ball", reading=DataSettings(), inputs={})
    save_texture_fit(tmp_path, fit, bare[0], data=data, settings={})
    mesh, material, _ = pf.load_mesh(tmp_path / "mesh.glb")
    for view, seen in zip(views, light, strict=True):
        scene = pf.Scene(mesh, view.camera, view.lights)
        image = np.asarray(pf.render(scene, material))
        assert np.sqrt(np.mean((image - np.clip(seen, 0, 1)) ** 2)) < 0.005


@pytest.mark.parametrize(
    "options, words",
    [
        ({"size": "edges"}, "size: expected rows and columns, or 'vertices', got 'e"),
        ({"wrap": "clamp"}, "filter, wrap: expected none of vertices"),
        ({"scene": pf.Scene(pf.Sphere(), scenes()[0].camera)}, "scene: expected a Mes"),
        (
            {"scene": [scenes()[0], scenes(pf.Mesh(ICO.vertices, ICO.faces))[0]]},
            "scene: expected the same Mesh in all scenes",
        ),
    ],
)
def test_wrong_arguments_are_named(options, words):
    given = {"scene": scenes()[0], "size": "vertices"} | options
    several = isinstance(given["scene"], list)
    image = np.zeros((32, 32, 3))
    with pytest.raises(ValueError, match=words):
        pf.fit_texture(given.pop("scene"), [image] * 2 if several else image, **given)
