"""Lambert, Phong and Blinn-Phong against numbers that can be checked by hand."""

import math

import jax
import numpy as np
import pytest

import phongfit as pf
from phongfit.reflectance import (
    blinn_from_phong,
    halfway,
    lambert,
    mirror,
    phong_from_blinn,
)
from tests.helpers import check_specular, floats, near, random_units, unit

UP = (0, 0, 1)
X = (1, 0, 0)
DOWN = (0, 0, -1)
AT_30 = (0.5, 0, math.sqrt(3) / 2)  # 30° from UP
AT_45 = (1, 0, 1)
AT_60 = (math.sqrt(3) / 2, 0, 0.5)
OPPOSITE_60 = (-math.sqrt(3) / 2, 0, 0.5)


@pytest.mark.parametrize(
    "normal, light, expected",
    [
        (UP, UP, 1.0),
        (UP, AT_30, math.sqrt(3) / 2),
        (UP, AT_45, math.sqrt(0.5)),
        (UP, AT_60, 0.5),
        (UP, X, 0.0),
        (UP, DOWN, 0.0),
        (AT_30, AT_60, math.sqrt(3) / 2),
    ],
)
def test_lambert(normal, light, expected):
    near(lambert(unit(*normal), unit(*light)), expected)


@pytest.mark.parametrize(
    "normal, light, expected",
    [
        (UP, UP, UP),
        (UP, AT_60, OPPOSITE_60),
        (UP, X, (-1, 0, 0)),
        (AT_45, UP, X),
    ],
)
def test_mirror(normal, light, expected):
    near(mirror(unit(*normal), unit(*light)), unit(*expected))


@pytest.mark.parametrize(
    "light, view, expected",
    [
        (UP, UP, UP),
        (AT_60, OPPOSITE_60, UP),
        (UP, X, (math.sqrt(0.5), 0, math.sqrt(0.5))),
        (X, (-1, 0, 0), (0, 0, 0)),
    ],
)
def test_halfway(light, view, expected):
    near(halfway(unit(*light), unit(*view)), expected)


# normal, light, view, then r·v and h·m before the exponent. In a plane with angles a
# and b from the normal, on one side each, r·v = cos(a - b) and h·m = cos((a - b) / 2).
HIGHLIGHTS = [
    (UP, UP, UP, 1.0, 1.0),
    (UP, AT_60, OPPOSITE_60, 1.0, 1.0),
    (UP, UP, AT_60, 0.5, math.sqrt(3) / 2),
    (UP, AT_60, UP, 0.5, math.sqrt(3) / 2),
    (UP, AT_30, AT_30, 0.5, math.sqrt(3) / 2),
    (UP, AT_45, AT_45, 0.0, math.sqrt(0.5)),
    (UP, AT_60, AT_60, -0.5, 0.5),
    (AT_30, AT_60, UP, 1.0, 1.0),
    # The light at the horizon and behind: nothing, by the gate.
    (UP, X, AT_60, 0.0, 0.0),
    (UP, DOWN, UP, 0.0, 0.0),
    (UP, (1, 0, -0.1), AT_60, 0.0, 0.0),
]


@pytest.mark.parametrize("normal, light, view, phong, blinn", HIGHLIGHTS)
def test_highlight_cosines(normal, light, view, phong, blinn):
    vectors = unit(*normal), unit(*light), unit(*view)
    near(pf.Phong().cosine(*vectors), phong)
    near(pf.BlinnPhong().cosine(*vectors), blinn)


@pytest.mark.parametrize(
    "model, view, expected",
    [
        # Light 30° below the horizon of UP at (√3/2, 0, -1/2): r = (-√3/2, 0, -1/2).
        (pf.Phong(gate=False), (-math.sqrt(3) / 2, 0, -0.5), 1.0),
        (pf.Phong(gate=False), (-1, 0, 0), math.sqrt(3) / 2),
        # h of that light and UP lies 60° from both.
        (pf.BlinnPhong(gate=False), UP, 0.5),
        (pf.Phong(), (-1, 0, 0), 0.0),
        (pf.BlinnPhong(), UP, 0.0),
    ],
)
def test_gate(model, view, expected):
    below = unit(math.sqrt(3) / 2, 0, -0.5)
    near(model.cosine(unit(*UP), below, unit(*view)), expected)


@pytest.mark.parametrize(
    "cosine, shininess, expected",
    [
        (1.0, 200.0, 1.0),
        (0.5, 1.0, 0.5),
        (0.5, 3.0, 0.125),
        (0.0, 1.0, 0.0),
        (-1, 2, 0),
    ],
)
def test_lobe(cosine, shininess, expected):
    cosine, shininess = floats(cosine), floats(shininess)
    near(pf.Phong().lobe(cosine, shininess), expected)
    near(pf.BlinnPhong().lobe(cosine, shininess), expected)
    scale = (shininess + 2) / (2 * math.pi)
    near(pf.BlinnPhong(normalized=True).lobe(cosine, shininess), scale * expected)


def test_normalized_diffuse():
    assert pf.Phong().diffuse_scale() == pf.BlinnPhong().diffuse_scale() == 1
    near(pf.BlinnPhong(normalized=True).diffuse_scale(), 1 / math.pi)


def test_the_normalized_lobe_integrates_to_one():
    # (f + 2) / 2π · cos^f, with one more cosine over the hemisphere, is 1 for every f.
    height, width = np.polynomial.legendre.leggauss(200)
    cosine, weight = (height + 1) / 2, width / 2
    for shininess in (1.0, 10.0, 200.0):
        lobe = pf.BlinnPhong(normalized=True).lobe(floats(cosine), floats(shininess))
        near(2 * math.pi * np.sum(weight * cosine * np.asarray(lobe)), 1.0, 1e-5)


@pytest.mark.parametrize(
    "model, gated, normalized",
    [
        (pf.Phong(), True, False),
        (pf.Phong(gate=False), False, False),
        (pf.BlinnPhong(), True, False),
        (pf.BlinnPhong(gate=False), False, False),
        (pf.BlinnPhong(normalized=True), True, True),
    ],
)
def test_contract(model, gated, normalized):
    check_specular(model, gated=gated, normalized=normalized)


def test_exchange_of_light_and_viewer():
    """Helmholtz: neither model's cosine minds which is which."""
    normals, to_light, to_viewer = (random_units(100, seed) for seed in (1, 2, 3))
    for model in (pf.Phong(gate=False), pf.BlinnPhong(gate=False)):
        cosine = jax.jit(jax.vmap(model.cosine))
        near(cosine(normals, to_light, to_viewer), cosine(normals, to_viewer, to_light))


def test_exponents_of_the_two_models():
    near(blinn_from_phong(floats(25.0)), 100.0)
    near(
        phong_from_blinn(blinn_from_phong(floats([3.0, 70.0]))),
        [3.0, 70.0],
    )
    # The same highlight: at 10° off its centre the two agree within 2 %.
    off = math.radians(10)
    phong = pf.Phong().lobe(floats(math.cos(off)), floats(40.0))
    blinn = pf.BlinnPhong().lobe(floats(math.cos(off / 2)), floats(160.0))
    assert abs(float(phong / blinn) - 1) < 0.02
