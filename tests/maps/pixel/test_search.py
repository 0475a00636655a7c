"""Steps of the search for an exponent."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial import Polynomial

from phongfit.maps.pixel.columns import make_columns
from phongfit.maps.pixel.exponent import Box
from phongfit.maps.pixel.lobes import PowerLobes
from phongfit.maps.pixel.search import _cubic, refine_exponents
from phongfit.reflectance import BlinnPhong
from tests.helpers import floats

BEST = float(np.log(12))


@pytest.mark.parametrize("step", [0.7, -0.4])
def test_a_cubic_has_its_bottom_where_it_is_said_to_be(step):
    """Of what falls at first, and has risen at the end of a step: a way past a wall."""
    for share in (0.1, 0.5, 0.9):
        bottom = share * step
        # Its slope is 0 there and at a top behind the start.
        slope = Polynomial.fromroots([bottom, -3 * step]) * np.sign(step)
        curve = slope.integ()
        assert slope(0) * step < 0 < slope(step) * step
        seen = (slope(0), slope(step), curve(step) - curve(0), step)
        assert float(_cubic(*map(floats, seen))) == pytest.approx(bottom, rel=1e-4)


def test_where_a_cubic_tells_nothing_the_middle_is_tried():
    # Lower at the end, a straight line, no step at all, a bottom that is nearly here.
    for seen in ((-1, -1, -1, 1), (1, 1, 1, 1), (-1e-6, 1, 0.5, 1)):
        assert float(_cubic(*map(floats, seen))) == 0.5
    assert float(_cubic(*map(floats, (0, 0, 0, 0)))) == 0


@jax.jit
def refined(start, bend):
    """Two steps from `start`, of a pixel under 40 lamps whose exponent is `BEST`."""
    rng = np.random.default_rng(0)
    diffuse, logarithm = rng.random(40), -0.3 * rng.random(40)
    light = 0.4 * diffuse + 0.3 * np.exp(12 * logarithm) + rng.normal(0, 0.003, 40)
    diffuse, light, logarithm = (
        floats(x)[:, None, None] for x in (diffuse, light, logarithm)
    )
    one = jnp.ones_like(light)
    columns = make_columns((diffuse,), light, one, one[:, None])
    box = Box((0, 0), (1, 1), 0, 7)
    lobes, start = PowerLobes(BlinnPhong()), start[None, None]
    return refine_exponents(columns, lobes, logarithm, start, box, 2, bend)


def test_a_step_too_short_to_see_leaves_the_curvature_as_it_was():
    """The difference of two slopes is rounding there: it sent pixels far away."""
    root = float(jnp.finfo(floats(0).dtype).eps ** 0.5)
    best = float(refined(floats(BEST), floats(1.0)).t[0, 0])
    assert best == pytest.approx(BEST, abs=0.05)
    for moved, kept in ((3 * root, True), (1000 * root, False)):
        bend = float(refined(floats(best + moved), floats(5.0)).bend[0, 0])
        assert bend == 5 if kept else bend == pytest.approx(1, abs=0.3)
