"""Steps of the search for an exponent."""

import numpy as np
import pytest
from numpy.polynomial import Polynomial

from phongfit.maps.pixel.search import _cubic
from tests.helpers import floats


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
