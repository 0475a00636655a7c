"""Whole images, against formulas written out in plain NumPy."""

import json
import math
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import phongfit as pf
from tests.helpers import floats, near

CASES = json.loads(
    (Path(__file__).parents[1] / "data/phong_point_cases.json").read_text()
)
LOOSE = 2e-4 if floats(0).dtype == np.float32 else 1e-10
RAW = pf.Film(clamp=False)


def one_pixel(normal, view, lights, *, ambient=0.0, specular_model=None):
    """A pixel at the origin with a given normal, seen from the direction `view`."""
    surface = pf.NormalMap([[normal]], positions=[[(0, 0, 0)]])
    camera = pf.OrthographicCamera.look_at(view, width=1, height=1)
    return pf.Scene(surface, camera, lights, ambient, specular_model=specular_model)


@pytest.mark.parametrize("case", CASES["cases"])
def test_point_cases(case):
    """Buck, *The Ray Tracer Challenge*: eye and light around a wall."""
    numbers = CASES["material"]
    scene = one_pixel(
        CASES["normal"],
        case["eye"],
        pf.PointLight(case["light_position"]),
        ambient=numbers["color"],
        specular_model=pf.Phong(),
    )
    names = ("ambient", "diffuse", "specular", "shininess")
    material = pf.Material(**{name: numbers[name] for name in names})
    pixel = pf.render(scene, material, film=RAW)[0, 0]
    near(pixel, [case["expected"]] * 3, CASES["tolerance"])


# A red surface under a warm light 60° off: diffuse 0.5 I ρ, by channel.
@pytest.mark.parametrize(
    "light, material, expected",
    [
        (dict(intensity=(1, 0.8, 0.6)), dict(diffuse=(0.5, 0.1, 0)), (0.25, 0.04, 0)),
        (
            dict(intensity=0),
            dict(diffuse=1, ambient=(0.1, 0.2, 0.3)),
            (0.05, 0.1, 0.15),
        ),
        (dict(intensity=0), dict(ambient=0, emission=(0.7, 0, 0.2)), (0.7, 0, 0.2)),
        (dict(intensity=0, ambient=(0.5, 0, 1)), dict(ambient=0.4), (0.4, 0.2, 0.6)),
        # Blinn: h lies 30° off, cos² = 3/4.
        (
            dict(specular=(1, 0.5, 0)),
            dict(diffuse=0, specular=(0.4, 0.8, 1), shininess=2, ambient=0),
            (0.3, 0.3, 0),
        ),
        (
            dict(specular=1),
            dict(diffuse=0, specular=0.5, shininess=(2, 4, 6), ambient=0),
            (0.375, 0.28125, 0.2109375),
        ),
    ],
)
def test_by_hand(light, material, expected):
    lights = pf.DirectionalLight((math.sqrt(3), 0, 1), **light)
    scene = one_pixel((0, 0, 1), (0, 0, 1), lights, ambient=0.5)
    near(pf.render(scene, pf.Material(**{"ambient": 0.0} | material))[0, 0], expected)


MATERIAL = dict(
    diffuse=(0.6, 0.3, 0.2),
    specular=(0.3, 0.4, 0.5),
    shininess=(20.0, 40.0, 60.0),
    ambient=(0.5, 0.4, 0.3),
    emission=(0.01, 0.02, 0.03),
)


def full_scene(specular):
    camera = pf.PerspectiveCamera.look_at(
        (1.0, 0.5, 4.0), (0.2, 0.0, 0.1), width=9, height=7, fov_y=35
    )
    lights = (
        pf.DirectionalLight((1, 1, 2), (0.9, 0.8, 0.7), specular=(0.5, 0.6, 0.7)),
        pf.PointLight(
            (-2, 1, 3), (0.4, 0.5, 0.6), attenuation=(1, 0.1, 0.02), ambient=0.1
        ),
        pf.SpotLight(
            (1.5, -2, 3), (-1.5, 2, -3.2), (1.5, 1, 0.5), cutoff=12, exponent=30
        ),
        pf.DirectionalLight((0, 0, -1), 5.0),
    )
    surface = pf.Sphere((0.1, -0.2, 0.3), 1.1)
    background = (0.1, 0.05, 1.5)
    return pf.Scene(
        surface,
        camera,
        lights,
        (0.1, 0.2, 0.3),
        specular_model=specular,
        background=background,
    )


def normalized(vector):
    return vector / np.sqrt(vector @ vector)


def pixel_by_numpy(row, column, phong):
    """The lecture's formula in plain NumPy for one pixel of `full_scene`."""
    eye, target = np.array([1.0, 0.5, 4.0]), np.array([0.2, 0.0, 0.1])
    back = normalized(eye - target)
    right = normalized(np.cross([0.0, 1.0, 0.0], back))
    up = np.cross(back, right)
    half = math.tan(math.radians(35) / 2)
    x = (column + 0.5 - 4.5) / 3.5 * half
    y = (3.5 - row - 0.5) / 3.5 * half
    ray = normalized(x * right + y * up - back)
    center, radius = np.array([0.1, -0.2, 0.3]), 1.1
    b = ray @ (eye - center)
    c = (eye - center) @ (eye - center) - radius**2
    if b * b - c < 0:
        return np.array([0.1, 0.05, 1.0])  # the background, clamped
    point = eye + (-b - math.sqrt(b * b - c)) * ray
    m, v = (point - center) / radius, -ray

    to_point = np.array([-2.0, 1.0, 3.0]) - point
    d = np.sqrt(to_point @ to_point)
    attenuation = 1 / (1 + 0.1 * d + 0.02 * d * d)
    to_spot = normalized(np.array([1.5, -2.0, 3.0]) - point)
    off_axis = -to_spot @ normalized(np.array([-1.5, 2.0, -3.2]))
    spot = off_axis**30 if off_axis >= math.cos(math.radians(12)) else 0.0
    warm, cold = np.array([0.9, 0.8, 0.7]), np.array([0.4, 0.5, 0.6])
    beam = np.array([1.5, 1.0, 0.5])
    lit = [
        (normalized(np.array([1.0, 1, 2])), warm, np.array([0.5, 0.6, 0.7])),
        (to_point / d, attenuation * cold, attenuation * cold),
        (to_spot, spot * beam, spot * beam),
        (np.array([0.0, 0, -1]), np.full(3, 5.0), np.full(3, 5.0)),
    ]
    rho_d, rho_s, f, rho_a, emission = (np.array(leaf) for leaf in MATERIAL.values())
    total = emission + rho_a * (np.array([0.1, 0.2, 0.3]) + 0.1 * attenuation)
    for s, diffuse, highlight in lit:
        if s @ m <= 0:
            continue
        total = total + rho_d * diffuse * (s @ m)
        cosine = (2 * (s @ m) * m - s) @ v if phong else normalized(s + v) @ m
        total = total + rho_s * highlight * max(cosine, 0.0) ** f
    return np.minimum(total, 1)


@pytest.mark.parametrize("model", [pf.Phong(), pf.BlinnPhong()])
def test_every_pixel_of_an_image(model):
    image = pf.render(full_scene(model), pf.Material(**MATERIAL))
    phong = isinstance(model, pf.Phong)
    expected = [[pixel_by_numpy(i, j, phong) for j in range(9)] for i in range(7)]
    near(image, expected, LOOSE)
    inside = pf.geometry.trace(full_scene(model).surface, full_scene(model).camera).mask
    assert 20 < inside.sum() < 60


BALL = pf.Scene(
    pf.Sphere(),
    pf.OrthographicCamera(6, 5),
    (pf.DirectionalLight((1, 1, 2)), pf.PointLight((-2, 0, 3), 0.5)),
    ambient=0.3,
    background=(0.2, 0.3, 0.4),
)
PLASTIC = pf.preset("red_plastic")


def test_clamp_and_background():
    bright = pf.Material(diffuse=2.0, emission=0.5)
    image = np.asarray(pf.render(BALL, bright))
    raw = np.asarray(pf.render(BALL, bright, film=RAW))
    assert raw.max() > 1.5
    near(image, np.minimum(raw, 1))
    mask = np.asarray(pf.geometry.trace(BALL.surface, BALL.camera).mask)
    assert 0 < mask.sum() < mask.size
    near(image[~mask], np.broadcast_to([0.2, 0.3, 0.4], image[~mask].shape))


def test_no_lights_at_all():
    scene = eqx.tree_at(lambda s: s.lights, BALL, ())
    mask = np.asarray(pf.geometry.trace(scene.surface, scene.camera).mask)
    image = np.asarray(pf.render(scene, pf.Material(ambient=(0.1, 0.2, 0.5))))
    near(image[mask], np.broadcast_to([0.03, 0.06, 0.15], image[mask].shape))


def test_a_gbuffer_is_used_again():
    buffer = pf.geometry.trace(BALL.surface, BALL.camera)
    near(pf.render(BALL, PLASTIC, gbuffer=buffer), pf.render(BALL, PLASTIC))
    flat = eqx.tree_at(lambda b: b.mask, buffer, jnp.zeros_like(buffer.mask))
    image = pf.render(BALL, PLASTIC, gbuffer=flat)
    near(image, np.broadcast_to([0.2, 0.3, 0.4], (5, 6, 3)))


def test_jit():
    image = jax.jit(lambda material: pf.render(BALL, material))(PLASTIC)
    near(image, pf.render(BALL, PLASTIC))
    # Constructors run inside jit as well.
    image = jax.jit(lambda red: pf.render(BALL, pf.Material((red, 0, 0))))(floats(0.5))
    near(image, pf.render(BALL, pf.Material((0.5, 0, 0))))


def test_vmap_over_materials():
    several = [PLASTIC, pf.preset("gold"), pf.preset("jade")]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *several)
    images = jax.vmap(lambda material: pf.render(BALL, material))(stacked)
    assert images.shape == (3, 5, 6, 3)
    for image, material in zip(images, several, strict=True):
        near(image, pf.render(BALL, material))


def test_a_material_map():
    """Each pixel has its own material: as if each were rendered by itself."""
    rng = np.random.default_rng(0)
    maps = {
        name: rng.uniform(0.1, 0.9, (5, 6, 3))
        for name in ("diffuse", "specular", "ambient", "emission")
    }
    shininess = rng.uniform(1, 100, (5, 6, 1))
    image = pf.render(BALL, pf.Material(**maps, shininess=shininess), film=RAW)
    for row, column in ((2, 2), (1, 4), (4, 3)):
        there = {name: leaf[row, column] for name, leaf in maps.items()}
        one = pf.Material(**there, shininess=shininess[row, column])
        near(image[row, column], pf.render(BALL, one, film=RAW)[row, column])


def test_shapes_of_leaves_do_not_matter():
    image = pf.render(BALL, pf.Material(0.4, 0.2, 9.0, 0.1, 0.05))
    rgb = pf.Material((0.4,) * 3, [0.2], (9.0,) * 3, np.full((5, 6, 3), 0.1), [[0.05]])
    near(pf.render(BALL, rgb), image)
