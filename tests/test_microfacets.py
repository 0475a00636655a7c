"""GGX and Ward: densities by SciPy's quadrature, energy, reciprocity, and fits."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, special

import phongfit as pf
from phongfit.microfacets import (
    cosines,
    roughness_from_shininess,
    shininess_from_roughness,
)
from phongfit.testing import check_gradients
from tests.helpers import floats, near, random_rotation, random_units, unit

UP = (0, 0, 1)
ALPHAS = (0.05, 0.3, 1.0)


@jax.jit
def heights(model, normals, to_light, to_viewer):
    """π f (m · s) for a ρ_s of 1; the exponent is 30."""
    return model.lobe(jax.vmap(model.cosine)(normals, to_light, to_viewer), floats(30))


def of_light(model, viewer, to_light):
    """The same on a plane that looks up, for many lights; NumPy in and out."""
    ups, views = (np.broadcast_to(v, to_light.shape) for v in (UP, viewer))
    return np.asarray(heights(model, floats(ups), floats(to_light), floats(views)))


def of_light_and_viewer(model, towards):
    """The same for lights that shine from where the viewer is."""
    ups = floats(np.broadcast_to(UP, towards.shape))
    return np.asarray(heights(model, ups, floats(towards), floats(towards)))


def tilted(degrees):
    return math.sin(math.radians(degrees)), 0.0, math.cos(math.radians(degrees))


def sent_back(model, viewer, spread, rings=400, turns=200):
    r"""Share of uniform light sent back to a viewer, by half vectors.

    $\int f (m \cdot s)\, ds$ with $ds = 4 (v \cdot h)\, dh$, and h by Gauss and
    Legendre in the angle whose tangent is `spread` times tan of a uniform one.
    """
    nodes, weights = special.roots_legendre(rings)
    angle = (nodes + 1) * math.pi / 4
    tangent = spread * np.tan(angle)
    polar = np.arctan(tangent)
    slope = spread / np.cos(angle) ** 2 / (1 + tangent**2)
    around = (np.arange(turns) + 0.5) * 2 * math.pi / turns
    half = np.stack(
        np.broadcast_arrays(
            np.sin(polar)[:, None] * np.cos(around),
            np.sin(polar)[:, None] * np.sin(around),
            np.cos(polar)[:, None],
        ),
        axis=-1,
    )
    toward = half @ np.asarray(viewer)
    light = 2 * toward[..., None] * half - np.asarray(viewer)
    shown = of_light(model, viewer, light.reshape(-1, 3)).reshape(toward.shape)
    area = (weights * math.pi / 4 * slope * np.sin(polar))[:, None] * 2 * math.pi
    return float((shown / math.pi * 4 * np.maximum(toward, 0) * area / turns).sum())


@pytest.mark.parametrize("alpha", ALPHAS)
def test_facets_of_ggx_cover_the_plane_once(alpha):
    """∫ D (m · h) dh = 1, with D read off the lobe where light and viewer coincide."""

    def density(angle):
        towards = np.array(tilted(math.degrees(angle)))[None]
        shown = of_light_and_viewer(pf.GGX(math.sqrt(alpha), 1.0), towards)[0]
        # There V = G / (4 cos²), and G = 1 / (1 + Λ) with Λ of both directions.
        root = math.sqrt(alpha**2 + (1 - alpha**2) * math.cos(angle) ** 2)
        return shown / math.pi * 4 * root

    def ring(angle):
        return density(angle) * math.cos(angle) * math.sin(angle) * 2 * math.pi

    asked = {"points": [alpha / 2], "epsabs": 1e-4, "epsrel": 1e-4}
    assert integrate.quad(ring, 0, math.pi / 2, **asked)[0] == pytest.approx(
        1, abs=1e-3
    )


@pytest.mark.parametrize("alpha", (0.02, 0.1, 0.3))
def test_ward_is_normalized(alpha):
    """Seen head-on it sends back what SciPy integrates, and 1 as α goes to 0."""

    def ring(angle):
        slope = math.exp(-(math.tan(angle) ** 2) / alpha**2) / (math.pi * alpha**2)
        shared = math.sqrt(math.cos(2 * angle)) * math.cos(angle)
        return slope * shared * math.sin(angle) * 2 * math.pi

    expected = integrate.quad(ring, 0, math.pi / 4, points=[alpha], limit=200)[0]
    found = sent_back(pf.Ward(alpha), UP, alpha)
    assert found == pytest.approx(expected, rel=2e-4)
    assert abs(expected - 1) < 3.2 * alpha**2


@pytest.mark.parametrize("alpha", ALPHAS)
@pytest.mark.parametrize("degrees", (0, 45, 80))
def test_no_light_is_made(alpha, degrees):
    """In a white furnace a mirror of facets is never brighter than what lights it."""
    back = sent_back(pf.GGX(math.sqrt(alpha), 1.0), tilted(degrees), alpha)
    assert 0.3 < back < 1 + 1e-3
    if alpha == 0.05 and degrees < 80:
        # Hardly any facet hides another.
        assert back > 0.99


@pytest.mark.parametrize("model", (pf.GGX(0.5), pf.GGX(0.9, 0.8), pf.Ward(0.4)))
def test_light_and_viewer_may_be_exchanged(model):
    normals, lights, viewers = (random_units(200, seed) for seed in (1, 2, 3))
    there = np.asarray(heights(model, *map(floats, (normals, lights, viewers))))
    back = np.asarray(heights(model, *map(floats, (normals, viewers, lights))))
    light, viewer = (np.sum(normals * v, axis=1) for v in (lights, viewers))
    seen = (light > 0) & (viewer > 0)
    # Ward's falls below the smallest number.
    assert np.all(there[~seen] == 0) and np.all(np.isfinite(there))
    assert np.mean(there[seen] > 0) > 0.9
    near((there / light)[seen], (back / viewer)[seen], 1e-3)
    turn = random_rotation(4).T
    turned = heights(model, *(floats(v @ turn) for v in (normals, lights, viewers)))
    clear = seen & (np.minimum(light, viewer) > 0.02)
    near(np.asarray(turned)[clear], there[clear], 1e-3)


@pytest.mark.parametrize(
    "model, light, viewer, expected",
    [
        # F0 / (4 α²), whatever of masking: at the peak there is none.
        (pf.GGX(0.5, 0.04), UP, UP, 0.04 / (4 * 0.0625)),
        (pf.GGX(f0=1.0), UP, UP, 32 / 8),
        (pf.Ward(0.2), UP, UP, 1 / (4 * 0.04)),
        (pf.Ward(), UP, UP, 32 / 8),
        # In mirror directions at 60°: F = F0 + (1 − F0) / 32; α = 1 has roots of 1.
        (pf.GGX(1.0, 0.04), tilted(60), tilted(-60), 0.07 * 0.5 / (2 * (0.5 + 0.5))),
        (pf.Ward(0.2), tilted(60), tilted(-60), 1 / (4 * 0.04)),
        # tan² of 15° between h and the normal; the square root of cosines 1 and √3/2.
        (
            pf.Ward(0.2),
            UP,
            tilted(30),
            math.exp(-(math.tan(math.pi / 12) ** 2) / 0.04)
            / 0.16
            * math.sqrt(1 / math.cos(math.pi / 6)),
        ),
        (pf.GGX(0.5), (0, 0, -1), UP, 0),
        (pf.Ward(0.5), UP, (0, 0, -1), 0),
    ],
)
def test_by_hand(model, light, viewer, expected):
    found = of_light(model, unit(*viewer), np.asarray(unit(*light))[None])[0]
    assert found == pytest.approx(float(expected), rel=2e-5, abs=1e-7)


def test_a_narrow_highlight_keeps_its_digits():
    """At 0.1° from the centre of α = 0.003, where 1 − cos² has lost most of them."""
    angle, alpha = math.radians(0.1), 0.003
    light = np.array([math.sin(2 * angle), 0, math.cos(2 * angle)])
    found = of_light(pf.GGX(math.sqrt(alpha), 1.0), unit(*UP), light[None])[0]
    slope = math.tan(angle) ** 2
    facets = alpha**2 / (math.cos(angle) * (alpha**2 + slope) * math.cos(angle)) ** 2
    assert found == pytest.approx(facets / 4, rel=1e-3)


def test_conversions():
    exponents = floats([0.0, 2.0, 30.0, 1000.0])
    rough = roughness_from_shininess(exponents)
    near(rough**4, 2 / (np.asarray(exponents) + 2))
    near(shininess_from_roughness(rough), exponents, 1e-4)
    # The same facets, by either name.
    places = [floats(random_units(20, seed)) for seed in (1, 2, 3)]
    given = pf.GGX(roughness_from_shininess(floats(30.0)))
    near(heights(given, *places), heights(pf.GGX(), *places), 1e-4)


@pytest.mark.parametrize("exponent", (10.0, 50.0, 1000.0))
def test_how_far_blinn_and_ggx_are_apart(exponent):
    """Peak and sum of the facets are the same; the rest is as documented."""
    a2 = 2 / (exponent + 2)
    angle = np.linspace(0, np.pi / 2, 100001)[:-1]
    blinn = np.cos(angle) ** exponent
    # Where light and viewer coincide: F0 G / 4 cos, and D over its peak.
    towards = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=-1)
    shown = of_light_and_viewer(pf.GGX(a2**0.25, 1.0), towards)
    root = np.sqrt(a2 + (1 - a2) * np.cos(angle) ** 2)
    ggx = shown * 4 * root * a2
    ring = np.cos(angle) * np.sin(angle)
    sums = [np.trapezoid(one * ring, angle) for one in (blinn, ggx)]
    assert sums[1] / sums[0] == pytest.approx(1, abs=1e-3)
    assert ggx[0] == pytest.approx(1, rel=1e-4)
    apart = blinn - ggx
    assert 0.145 < apart.max() < 0.165 and -0.06 < apart.min() < -0.02
    half = [angle[np.argmax(one < 0.5)] for one in (blinn, ggx)]
    assert 0.77 < half[1] / half[0] < 0.80


@pytest.mark.parametrize("numbers", ({"roughness": 0}, {"f0": 1.1}, {"f0": (1, 1)}))
def test_wrong_numbers(numbers):
    (name,) = numbers
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        pf.GGX(**numbers)
    with pytest.raises(ValueError, match="^alpha: expected a number from"):
        pf.Ward(2.0)


# A roughness of its own goes the way of one that follows from the exponent.
ROUGH = pytest.param(pf.GGX(0.5), marks=pytest.mark.extended)
PLACE = [np.array(v) / np.linalg.norm(v) for v in ((1, 2, 10), (1, 0, 1), (-8, 3, 10))]


@pytest.mark.parametrize("model", (pf.GGX(), ROUGH, pf.Ward(0.4)))
def test_derivatives(model):
    def lobe(at):
        model, vectors, exponent = at
        return model.lobe(cosines(*vectors), exponent)

    check_gradients(lobe, (model, PLACE, 30.0), rtol=1e-4)


@pytest.mark.parametrize(
    "model",
    [
        pytest.param(pf.GGX(), marks=pytest.mark.extended),
        pf.Ward(0.4),
        ROUGH,
    ],
)
def test_derivatives_where_there_is_no_light(model):
    """Finite behind the surface, and where a light is missing: its cosines are 0."""
    normal, light, viewer = PLACE
    nothing = jax.tree.map(jnp.zeros_like, cosines(*map(jnp.asarray, PLACE)))

    def lobes(at):
        model, vectors, missing, exponent = at
        each = cosines(*vectors), missing
        return jnp.stack([model.lobe(one, exponent) for one in each])

    point = model, (normal, -light, viewer), nothing, 30.0
    check_gradients(lobes, point, finite_differences=False)


@pytest.mark.parametrize(
    "model", (pf.GGX(), pf.GGX(0.25, 0.5), pf.Ward(), pf.Ward(0.125))
)
def test_scene_files(model, tmp_path):
    scene = pf.Scene(pf.Sphere(), pf.OrthographicCamera(8, 8), specular_model=model)
    pf.save_scene(tmp_path / "scene.json", scene)
    again = pf.load_scene(tmp_path / "scene.json").specular_model
    assert type(again) is type(model)
    assert jax.tree.structure(again) == jax.tree.structure(model)
    near(jax.tree.leaves(again), jax.tree.leaves(model))
