import math

import numpy as np
import pytest

import phongfit as pf
from tests.helpers import check_light, floats, near, unit

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
