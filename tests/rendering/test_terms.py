"""The image is linear in the reflectances, and what light may and may not do."""

import equinox as eqx
import jax
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import phongfit as pf
from phongfit.rendering.terms import MAX_UNROLLED, ShadingTerms, combine, point_terms
from tests.helpers import floats, near, random_rotation, unit

shares = st.floats(0, 1, width=32)
colours = st.tuples(shares, shares, shares)
places = st.tuples(*[st.floats(-1, 1, width=32)] * 3)
seeds = st.integers(0, 2**20)
materials = st.builds(
    pf.Material,
    diffuse=colours,
    specular=colours,
    shininess=st.floats(1, 200, width=32),
    ambient=colours,
    emission=colours,
)
# float32 keeps seven digits of a cosine, of which the exponent takes two or three.
LOOSE = 2e-4 if floats(0).dtype == np.float32 else 1e-11


def lights_around(offset=(0, 0, 0), rotation=None):
    """One light of each kind, in front of the unit sphere, turned with `rotation`."""
    rotation = np.eye(3) if rotation is None else rotation

    def turned(*vector):
        return rotation @ np.array(vector, float)

    shift = np.array(offset) / 4
    return (
        pf.DirectionalLight(turned(*(shift + [1, 1, 2])), (0.5, 0.4, 0.3), ambient=0.1),
        pf.PointLight(
            turned(*(shift + [-2, 1, 2])), 0.7, attenuation=(1, 0.1, 0.05), specular=0.4
        ),
        pf.SpotLight(
            turned(*(shift + [1, -1, 3])),
            turned(-1, 1, -2.5),
            0.8,
            cutoff=50,
            exponent=2,
        ),
    )


def world(offset=(0, 0, 0), rotation=None, specular=None, lights=None):
    """A close view of a ball, whose every pixel sees it, turned with `rotation`."""
    rotation = np.eye(3) if rotation is None else rotation
    camera = pf.PerspectiveCamera(
        4, 3, fov_y=12, position=rotation @ np.array([0, 0, 5.0]), rotation=rotation
    )
    lights = lights_around(offset, rotation) if lights is None else lights
    return pf.Scene(pf.Sphere(), camera, lights, ambient=0.2, specular_model=specular)


@eqx.filter_jit
def unclamped(scene, material):
    return combine(
        pf.terms(scene, pf.geometry.trace(scene.surface, scene.camera)), material
    )


def mixed(a, first, b, second):
    """a · first + b · second of everything that the image is linear in."""

    def leaf(name):
        return a * getattr(first, name) + b * getattr(second, name)

    names = ("diffuse", "specular", "ambient", "emission")
    return pf.Material(**{n: leaf(n) for n in names}, shininess=first.shininess)


@pytest.mark.parametrize("specular", [pf.Phong(), pf.BlinnPhong(normalized=True)])
def test_linear_in_the_reflectances(specular):
    scene = world(specular=specular)

    @given(materials, materials, shares, shares)
    @settings(max_examples=25)
    def holds(first, second, a, b):
        a, b = floats(a), floats(b)
        second = eqx.tree_at(lambda m: m.shininess, second, first.shininess)
        image = unclamped(scene, mixed(a, first, b, second))
        sum_ = a * unclamped(scene, first) + b * unclamped(scene, second)
        near(image, sum_, LOOSE)

    holds()


@given(materials, places)
@settings(max_examples=20)
def test_light_adds_up(material, offset):
    """The image of all lights is the sum of those of each, ambient counted once."""
    together = unclamped(world(offset), material)
    dark = unclamped(world(lights=()), material)
    added = sum(
        unclamped(world(lights=(light,)), material) - dark
        for light in lights_around(offset)
    )
    near(together, dark + added, LOOSE)


@given(materials, places, places.filter(lambda place: max(map(abs, place)) > 0.1))
@settings(max_examples=20)
def test_never_negative_and_brighter_with_every_light(material, offset, anywhere):
    lights = (pf.DirectionalLight(anywhere), *lights_around(offset))
    before = np.zeros((3, 4, 3))
    for count in range(5):
        image = np.asarray(unclamped(world(lights=lights[:count]), material))
        assert np.all(np.isfinite(image))
        assert np.all(image >= before - 1e-6)
        before = image


@given(materials, places, seeds)
@settings(max_examples=20)
def test_nothing_changes_when_the_world_is_turned(material, offset, seed):
    turned = world(offset, random_rotation(seed))
    near(unclamped(turned, material), unclamped(world(offset), material), LOOSE)


def test_what_the_terms_are():
    """At one point, by hand: light 60° off the normal, viewer on the normal."""
    light = pf.DirectionalLight(
        (np.sqrt(3), 0, 1), (0.4, 0.6, 0.8), specular=(1, 0.5, 0), ambient=(0, 0.1, 0.2)
    )
    up = unit(0, 0, 1)
    found = point_terms(
        (light,), floats([0.3] * 3), pf.Phong(), floats([0] * 3), up, up
    )
    near(found.ambient, [0.3, 0.4, 0.5])
    near(found.diffuse, [0.2, 0.3, 0.4])
    near(found.cosine, [0.5])
    near(found.strength, [[1, 0.5, 0]])
    near(found.specular(floats(3.0)), [0.125, 0.0625, 0])
    # An exponent for each channel: 0.5, 0.5² and 0.5³.
    near(found.specular(floats([1.0, 2.0, 3.0])), [0.5, 0.125, 0])
    normalized = pf.BlinnPhong(normalized=True)
    scaled = point_terms(
        (light,), floats([0.3] * 3), normalized, floats([0] * 3), up, up
    )
    near(scaled.diffuse, np.array([0.2, 0.3, 0.4]) / np.pi)


@pytest.mark.parametrize("count", [1, MAX_UNROLLED - 1, MAX_UNROLLED + 3])
def test_highlights_of_all_lights_add_up(count):
    """Also of more lights than are written out, and so do their slopes in f."""
    rng = np.random.default_rng(count)
    cosine, strength = rng.random((5, count)), rng.random((5, count, 3))
    dark = floats(np.zeros((5, 3)))
    found = ShadingTerms(dark, dark, floats(cosine), floats(strength), pf.Phong())
    exponents = floats([2.0, 7.0, 30.0])
    lobes = cosine[..., None] ** np.array([2.0, 7.0, 30.0])
    near(found.specular(exponents), (strength * lobes).sum(axis=1))
    slope = jax.jit(jax.grad(lambda f: found.specular(f).sum()))(exponents)
    slopes = strength * lobes * np.log(cosine)[..., None]
    near(slope, slopes.sum(axis=(0, 1)))


def test_many_lights_in_their_order():
    """More than are written out, of all kinds: each as it is by itself."""
    lights = 6 * lights_around()
    lights = (lights[0], *lights)
    assert len(lights) > MAX_UNROLLED
    visibility = np.random.default_rng(0).random(len(lights))
    place = pf.BlinnPhong(), floats([0.1, 0.2, 0.3]), unit(0, 1, 3), unit(1, 0, 2)
    found = point_terms(lights, floats([0.3] * 3), *place, floats(visibility))
    each = [
        point_terms((light,), floats([0.0] * 3), *place, floats([visible]))
        for light, visible in zip(lights, visibility, strict=True)
    ]
    near(found.cosine, [one.cosine[0] for one in each])
    near(found.strength, [one.strength[0] for one in each])
    near(found.diffuse, sum(one.diffuse for one in each))
    near(found.ambient, 0.3 + sum(one.ambient for one in each))


@pytest.mark.parametrize("leaf", ["diffuse", "specular", "shininess", "ambient"])
def test_a_map_of_another_size_is_refused(leaf):
    with pytest.raises(ValueError, match=rf"^{leaf}: expected .*, got \(2, 4, 3\)"):
        unclamped(world(), pf.Material(**{leaf: np.ones((2, 4, 3))}))


def test_terms_are_batched_by_vmap():
    """Samples in a row, and the same through an image."""
    scene = world()
    buffer = pf.geometry.trace(scene.surface, scene.camera)
    image = pf.terms(scene, buffer)
    row = jax.tree.map(lambda leaf: leaf[1], image)
    material = pf.preset("gold")
    whole = np.asarray(jax.jit(combine)(image, material))
    near(jax.jit(combine)(row, material), whole[1])
