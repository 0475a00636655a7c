"""Sums over the samples against the whole Jacobian, one problem of each kind."""

import dataclasses

import equinox as eqx
import jax
import jax.extend.core
import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from phongfit.fitting.fit import set_up
from phongfit.fitting.problem.losses import as_loss
from phongfit.fitting.problem.parameters import MATERIAL_PARAMETERS
from phongfit.fitting.problem.problem import Problem, evaluate
from phongfit.fitting.problem.samples import gather, seen_pixels
from phongfit.fitting.problem.specification import Specification
from phongfit.fitting.solve.solution import _unit, few_residuals, solve
from phongfit.fitting.solve.sums import colours, linearize, sums
from phongfit.material import stack_materials
from tests.fitting.scenes import as_vector, ball, photograph, truth, unknowns_of
from tests.helpers import eps, floats

TRUTH = truth()

NOISE = 0.03
SCENE = ball(size=16)
INTENSITY = "scene.lights[0].intensity"


def two_materials() -> pf.Scene:
    mesh = pf.shapes.Ball().mesh(12, 8)
    half = (np.arange(len(mesh.faces)) % 2).astype(np.int32)
    surface = pf.Mesh(mesh.vertices, mesh.faces, mesh.normals, half)
    return pf.Scene(surface, SCENE.camera, SCENE.lights, SCENE.ambient)


TWO = two_materials()
KINDS = {
    "one material": (SCENE, {}),
    "two materials": (TWO, {}),
    "images apart": ([SCENE, SCENE], dict(unknowns=("diffuse", "exposure"))),
    "materials and images": ([TWO, TWO], dict(unknowns=("diffuse", "exposure"))),
    "scenes": (
        SCENE,
        dict(unknowns=("diffuse", INTENSITY, "scene.lights[1].direction")),
    ),
    "priors and ties": (
        SCENE,
        dict(
            priors={"shininess": (30, 5), "diffuse": (0.4, 0.02)},
            ties={"ambient.red": (0.5, "diffuse.blue")},
        ),
    ),
    "tukey": (SCENE, {}),
}


def problem_of(kind: str) -> tuple[Problem, jax.Array]:
    """A problem with noise and some white pixels, and a point off its optimum."""
    scene, options = KINDS[kind]
    scenes = scene if isinstance(scene, list) else [scene]
    material = stack_materials([TRUTH] * 2) if scenes[0] is TWO else TRUTH
    images = [
        photograph(one, material, noise=NOISE, seed=k) for k, one in enumerate(scenes)
    ]
    images = [np.where(image > 0.55, 1, image) for image in images]
    setting = set_up(
        Specification(known=TRUTH, **options),
        scene,
        images if isinstance(scene, list) else images[0],
    )
    loss = as_loss("tukey" if kind == "tukey" else "linear")
    samples = gather(setting.sources, seen_pixels(setting.sources))
    problem = Problem(samples, setting.unknowns, floats(NOISE), loss, True)
    names, logarithm = setting.unknowns.names, setting.unknowns.logarithmic
    rng = np.random.default_rng(0)
    y = 0.3 + 0.1 * rng.random(len(logarithm))
    if any(name.startswith("scene") or name == "exposure" for name in names):
        y += np.asarray(setting.unknowns.start)
    return problem, floats(np.where(logarithm, np.log(25), y))


@eqx.filter_jit
def dense(problem: Problem, y: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Residuals of everything, their Jacobian, and the gradient of half the cost."""

    def residual(y: jax.Array) -> jax.Array:
        priors = problem.unknowns.prior_residual(y)
        return jnp.concatenate([problem.residual(y).ravel(), priors])

    def cost(y: jax.Array) -> jax.Array:
        priors = problem.unknowns.prior_residual(y)
        robust = problem.loss.root(problem.residual(y))
        return (jnp.sum(robust**2) + jnp.sum(priors**2)) / 2

    return residual(y), jax.jacfwd(residual)(y), jax.grad(cost)(y)


@eqx.filter_jit
def ours(problem: Problem, y: jax.Array) -> tuple:
    few, left = few_residuals(y, problem)
    slope, _ = jax.jacfwd(few_residuals)(y, problem)
    return sums(problem, y), linearize(problem, y).jacobian, few, left, slope


# The others compile as much, and are made of the same parts.
BY_DEFAULT = ("priors and ties",)


@pytest.mark.parametrize(
    "kind",
    [
        kind if kind in BY_DEFAULT else pytest.param(kind, marks=pytest.mark.extended)
        for kind in KINDS
    ],
)
def test_sums_are_those_of_the_whole_jacobian(kind):
    problem, y = problem_of(kind)
    residual, jacobian, gradient = (np.asarray(a, float) for a in dense(problem, y))
    total, sparse, few, left, slope = ours(problem, y)
    size = np.sqrt(np.sum(jacobian**2, axis=0))
    tolerance = 3e3 * eps() * np.sqrt(np.sum(residual**2))
    assert np.all(size > 0)
    np.testing.assert_allclose(total.gradient / size, gradient / size, atol=tolerance)
    if kind == "tukey":
        return
    np.testing.assert_allclose(total.cost, np.sum(residual**2), rtol=1e3 * eps())
    unit = np.outer(size, size)
    hessian = jacobian.T @ jacobian
    np.testing.assert_allclose(total.hessian / unit, hessian / unit, atol=1e3 * eps())
    columns = sparse.columns()
    samples = jacobian[: problem.samples.target.size].T.reshape(columns.shape)
    np.testing.assert_allclose(
        columns, samples, atol=1e3 * eps() * np.abs(samples).max()
    )

    # Weighted, beside what is not.
    weight = np.random.default_rng(1).random(problem.samples.target.shape)
    plain, weighted = eqx.filter_jit(sparse.grams)(None, floats(weight))
    whole = np.einsum("icn,cn,jcn->ij", columns, weight, columns)
    np.testing.assert_allclose(weighted / unit, whole / unit, atol=1e3 * eps())
    unweighted = np.einsum("icn,jcn->ij", columns, columns)
    np.testing.assert_allclose(plain / unit, unweighted / unit, atol=1e3 * eps())

    # What the noise level follows from.
    at = evaluate(problem, y)
    squares = np.asarray(at.difference, float) ** 2 * np.asarray(problem.samples.weight)
    np.testing.assert_allclose(left.squares, squares.sum(), rtol=1e3 * eps())
    shares = np.asarray(at.variance_share, float)
    assert 0 < shares.sum() < np.sum(np.asarray(problem.samples.weight) > 0)
    np.testing.assert_allclose(left.share, shares.sum(), rtol=1e3 * eps())

    # A few residuals that no solver can tell from all of them.
    few, slope = np.asarray(few, float), np.asarray(slope, float)
    count = float(_unit(problem)) ** 2
    assert few.shape == (len(y) + 1,)
    np.testing.assert_allclose(count * few @ few, np.sum(residual**2), rtol=3e3 * eps())
    np.testing.assert_allclose(
        count * slope.T @ few / size, gradient / size, atol=10 * tolerance
    )
    np.testing.assert_allclose(
        count * slope.T @ slope / unit, hessian / unit, atol=1e4 * eps()
    )


@pytest.mark.parametrize(
    "names, per_channel, options, count",
    [
        (MATERIAL_PARAMETERS[:4], MATERIAL_PARAMETERS[:3], {}, 4),
        (MATERIAL_PARAMETERS[:4], (), {}, 4),
        (MATERIAL_PARAMETERS[:4], MATERIAL_PARAMETERS[:4], {}, 4),
        (MATERIAL_PARAMETERS[:4], MATERIAL_PARAMETERS[:3], {"materials": 24}, 4),
        (("diffuse",), ("diffuse",), {}, 1),
        (("diffuse", "exposure"), ("diffuse",), {"scenes": [SCENE] * 5}, 2),
        # A direction has two.
        (("diffuse", "scene.lights[0].direction"), (), {"scenes": [SCENE]}, 3),
        # A tie to another channel moves that one's samples, too.
        (("diffuse",), ("diffuse",), {"ties": {"diffuse.red": "diffuse.blue"}}, 1),
        (
            ("ambient", "diffuse"),
            ("ambient", "diffuse"),
            {"ties": {"ambient.red": "diffuse.blue"}},
            2,
        ),
    ],
)
def test_how_many_derivatives(names, per_channel, options, count):
    unknowns = unknowns_of(names, per_channel, TRUTH, {}, **options)
    tangents, select = colours(unknowns)
    assert tangents.shape == (count, unknowns.lower.size)
    assert np.array_equal(tangents.sum(axis=0), np.ones(unknowns.lower.size))
    # No sample is moved by two of a colour.
    assert select.sum(axis=-1).max() == 1


def test_a_derivative_in_the_unknowns_alone():
    problem, y = problem_of("one material")

    def through(sigma: jax.Array) -> jax.Array:
        return few_residuals(y, dataclasses.replace(problem, sigma=sigma))[0].sum()

    with pytest.raises(NotImplementedError, match="in the unknowns only"):
        jax.jit(lambda sigma: jax.jvp(through, (sigma,), (sigma,)))(problem.sigma)


def test_a_rounded_image_without_noise_is_no_reason_to_stop():
    film = pf.Film(encoding="srgb", bits=8)
    scene = ball()
    image = photograph(scene, TRUTH, film=film)
    setting = set_up(Specification(film=film), scene, image)
    samples = gather(setting.sources, seen_pixels(setting.sources))
    problem = Problem(samples, setting.unknowns, floats(1e-7), pf.Linear(), True)
    start = floats(setting.unknowns.position(as_vector(TRUTH)))
    near, far = (solve(problem, start * share, 50) for share in (1.0, 1.02))
    assert near.converged and far.converged
    assert float(far.cost) == pytest.approx(float(near.cost), rel=1e-3)


def equations(jaxpr: jax.extend.core.Jaxpr) -> int:
    """How many there are, those of programs within included; copies do not count."""
    count = 0
    for equation in jaxpr.eqns:
        inner = [part for part in equation.params.values() if hasattr(part, "jaxpr")]
        count += sum(equations(part.jaxpr) for part in inner)
        count += not inner and equation.primitive.name != "broadcast_in_dim"
    return count


@pytest.mark.parametrize(
    "name",
    [
        "scene.lights[0].direction",
        pytest.param("exposure", marks=pytest.mark.extended),
        pytest.param(INTENSITY, marks=pytest.mark.extended),
    ],
)
def test_many_images_compile_like_few(name):
    def size(images: int) -> int:
        scenes, image = [SCENE] * images, np.full((16, 16, 3), 0.5)
        per_image = () if name == "exposure" else (name,)
        problem = pf.make_problem(
            scenes,
            [image] * images,
            0.1,
            unknowns=("diffuse", name),
            per_image=per_image,
        )
        y = problem.unknowns.start
        return equations(jax.make_jaxpr(sums)(problem, y).jaxpr)

    assert size(9) == size(3)
