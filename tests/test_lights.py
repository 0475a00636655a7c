import math

import jax
import numpy as np
import pytest

import phongfit as pf
from phongfit.testing import check_gradients
from tests.helpers import check_light, floats, near, random_rotation, random_units, unit

ORIGIN = (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    "light",
    [
        pf.DirectionalLight((1, 1, 2), (0.5, 0.6, 0.7), ambient=0.1),
        pf.PointLight((0.5, 1, 2), (0.5, 0.6, 0.7), attenuation=(1, 0.1, 0.2)),
        pf.PointLight((0.5, 1, 2), 0.7, attenuation=(0, 0, 2), specular=(0.1, 0.2, 0)),
        pf.PointLight((0, 0, 0), attenuation=(0, 1, 0), ambient=0.3),
        pf.SpotLight((0, 1, 5), (0.1, 0.2, -1), 0.9, cutoff=40, exponent=3),
        pf.SpotLight((0, 1, 5), (0, 0, -3), cutoff=90, attenuation=(0, 0, 1)),
        pf.HarmonicLight([1, 0.2, 0.3, -0.1, 0.1, 0, 0.2, -0.3, 0.1]),
    ],
    ids=lambda light: type(light).__name__,
)
def test_contract(light):
    check_light(light)


@pytest.mark.parametrize(
    "light, point, direction",
    [
        (pf.DirectionalLight((0, 0, 5)), ORIGIN, (0, 0, 1)),
        (pf.DirectionalLight((0, 3, 4)), (9, 9, 9), (0, 0.6, 0.8)),
        (pf.PointLight((0, 0, 5)), ORIGIN, (0, 0, 1)),
        (pf.PointLight((1, 2, 3)), (1, 2, 7), (0, 0, -1)),
        (pf.SpotLight((3, 0, 4), (0, 0, -1)), ORIGIN, (0.6, 0, 0.8)),
    ],
)
def test_direction(light, point, direction):
    near(light.illuminate(floats(point)).to_light, direction)


# Coefficients, distance, 1 / (a0 + a1 d + a2 d²).
@pytest.mark.parametrize(
    "attenuation, distance, expected",
    [
        ((1, 0, 0), 7, 1.0),
        ((2, 0, 0), 7, 0.5),
        ((0, 1, 0), 4, 0.25),
        ((0, 0, 1), 2, 0.25),
        ((1, 2, 3), 2, 1 / 17),
        ((1, 2, 3), 0, 1.0),
    ],
)
def test_attenuation(attenuation, distance, expected):
    intensity = floats([1.0, 0.5, 0.25])
    colours = dict(attenuation=attenuation, specular=(0.2, 0.4, 0.6), ambient=0.3)
    for light in (
        pf.PointLight((0, 0, distance), intensity, **colours),
        pf.SpotLight((0, 0, distance), (0, 0, -1), intensity, **colours),
    ):
        if distance == 0 and isinstance(light, pf.SpotLight):
            continue  # its own place lies in no direction from its axis
        arriving = light.illuminate(floats(ORIGIN))
        near(arriving.intensity, expected * intensity)
        near(arriving.specular, expected * np.array([0.2, 0.4, 0.6]))
        near(arriving.ambient, np.full(3, expected * 0.3))


# Angle off the axis, cutoff and exponent, then cos^e or 0.
@pytest.mark.parametrize(
    "angle, cutoff, exponent, expected",
    [
        (0, 45, 0, 1.0),
        (0, 45, 50, 1.0),
        (30, 45, 0, 1.0),
        (30, 45, 2, 0.75),
        (60, 61, 1, 0.5),
        (60, 61, 3, 0.125),
        (60, 59, 3, 0.0),
        (46, 45, 0, 0.0),
        (89, 90, 0, 1.0),
        (91, 90, 0, 0.0),
        (180, 90, 0, 0.0),
    ],
)
def test_spot(angle, cutoff, exponent, expected):
    light = pf.SpotLight(
        (0, 0, 2), (0, 0, -5), 0.8, cutoff=cutoff, exponent=exponent, ambient=0.4
    )
    radians = math.radians(angle)
    point = floats([math.sin(radians), 0, 2 - math.cos(radians)])
    arriving = light.illuminate(point)
    near(arriving.intensity, [0.8 * expected] * 3)
    near(arriving.ambient, [0.4 * expected] * 3)


def test_own_colours():
    """As in OpenGL: no ambient light, and a highlight of the light's own colour."""
    at = floats(ORIGIN)
    for light in (
        pf.DirectionalLight((0, 0, 1), (0.1, 0.2, 0.3)),
        pf.PointLight((0, 0, 1), (0.1, 0.2, 0.3)),
        pf.SpotLight((0, 0, 1), (0, 0, -1), (0.1, 0.2, 0.3)),
    ):
        arriving = light.illuminate(at)
        near(arriving.specular, [0.1, 0.2, 0.3])
        near(arriving.ambient, [0, 0, 0])
    light = pf.DirectionalLight((0, 0, 1), 1, specular=(0, 0.5, 1), ambient=(1, 0.5, 0))
    near(light.illuminate(at).intensity, [1, 1, 1])
    near(light.illuminate(at).specular, [0, 0.5, 1])
    near(light.illuminate(at).ambient, [1, 0.5, 0])


def test_at_its_own_place():
    """No direction and, with nothing to bound it, no light: never NaN or infinite."""
    lamp = pf.PointLight((1, 2, 3), (1, 0, 1), attenuation=(0, 0, 1))
    arriving = lamp.illuminate(floats([1, 2, 3]))
    near(arriving.to_light, [0, 0, 0])
    near(arriving.intensity, [0, 0, 0])


def test_far_away_a_point_light_is_directional():
    direction = unit(1, 2, 2)
    arriving = pf.PointLight(1e6 * direction).illuminate(floats([0.1, -0.3, 0.2]))
    near(arriving.to_light, direction, 1e-6)


# Ramamoorthi and Hanrahan's constants, to their six digits: harmonics at (x, y, z).
def harmonics(directions):
    x, y, z = np.asarray(directions, float).T
    return np.stack(
        [
            np.full_like(x, 0.282095),
            *(0.488603 * part for part in (y, z, x)),
            *(1.092548 * part for part in (x * y, y * z)),
            0.315392 * (3 * z * z - 1),
            1.092548 * x * z,
            0.546274 * (x * x - y * y),
        ],
        axis=-1,
    )


def around(light, normals):
    return np.asarray(jax.jit(jax.vmap(light.surround))(floats(normals)))


# Surroundings that are positive everywhere.
COEFFICIENTS = 0.05 * np.random.default_rng(3).normal(size=(9, 3))
COEFFICIENTS[0] = 1.5, 2, 3


def spread(count):
    """Directions all over the sphere, each for the same solid angle."""
    height = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=-1)


def test_irradiance_is_the_integral_over_all_directions():
    directions, normals = spread(20_000), random_units(20, 1)
    radiance = harmonics(directions) @ COEFFICIENTS
    assert radiance.min() > 0
    cosine = np.maximum(normals @ directions.T, 0)
    expected = 4 * cosine @ radiance / len(directions)
    near(around(pf.HarmonicLight(COEFFICIENTS), normals), expected, 1e-3)


def test_a_lamp_as_harmonics_is_nearly_lambert():
    """A lamp of intensity 1 is a radiance of π in one direction."""
    lamp, normals = np.array([[0.6, 0, 0.8]]), random_units(200, 2)
    light = pf.HarmonicLight(np.pi * harmonics(lamp)[0])
    found = around(light, normals)[:, 0]
    cosine = np.maximum(normals @ lamp[0], 0)
    # A single lamp is their worst case: 1/4 − 5/32 off where it just disappears.
    assert np.abs(found - cosine).max() < 3 / 32 + 1e-6
    assert np.sqrt(np.mean((found - cosine) ** 2)) < 0.05


def test_harmonics_turn_with_the_world():
    turn, directions = random_rotation(4), spread(50)
    values = harmonics(directions) @ COEFFICIENTS
    turned, *_ = np.linalg.lstsq(harmonics(directions @ turn.T), values, rcond=None)
    normals = random_units(30, 3)
    found = around(pf.HarmonicLight(turned), normals @ turn.T)
    near(found, around(pf.HarmonicLight(COEFFICIENTS), normals), 1e-5)


def test_what_would_be_negative_is_dark():
    light = pf.HarmonicLight([0, 0, 1, 0, 0, 0, 0, 0, 0])
    up, down = around(light, [(0, 0, 1), (0, 0, -1)])
    near(up, [math.sqrt(3 / (4 * math.pi)) * 2 / 3] * 3)
    near(down, [0, 0, 0])


def test_uniform_light_shows_white_as_ambient_light_does():
    """Light of 1 from everywhere, by the diffuse and by the ambient reflectance."""
    light = pf.HarmonicLight([math.sqrt(4 * math.pi), *[0] * 8])
    camera = pf.OrthographicCamera(8, 8)
    matte = pf.Material((0.7, 0.5, 0.3), 0.4, 10.0, 0.0)
    ambient = pf.Material(0.0, 0.4, 10.0, (0.7, 0.5, 0.3))
    lit = pf.render(pf.Scene(pf.Sphere(), camera, light), matte)
    expected = pf.render(pf.Scene(pf.Sphere(), camera, ambient=1.0), ambient)
    near(lit, expected)
    normalized = pf.BlinnPhong(normalized=True)
    scene = pf.Scene(pf.Sphere(), camera, light, specular_model=normalized)
    near(pf.render(scene, matte), expected)
    # And throws no shadow.
    scene = pf.Scene(pf.Sphere(), camera, light, shadows=True)
    near(pf.render(scene, matte), expected)


def test_derivatives_of_harmonics():
    def seen(both):
        light, normal = both
        return light.surround(normal)

    normal = floats([0.36, 0.48, 0.8])
    check_gradients(seen, (pf.HarmonicLight(COEFFICIENTS), normal))


@pytest.mark.parametrize("wrong", [3, [1, 2, 3], np.full(9, np.nan), np.ones((3, 9))])
def test_wrong_harmonics_are_named(wrong):
    with pytest.raises(ValueError, match="coefficients: expected"):
        pf.HarmonicLight(wrong)
