import numpy as np
import pytest

from experiments.model import EXPERIMENT, EXPONENTS, FRACTIONS, ball, highlight_width


@pytest.mark.extended
def test_what_each_number_does(found):
    finding = found(EXPERIMENT)
    numbers = finding.numbers
    assert not finding.failed_checks
    # Light is proportional to ρ_d and ρ_a; the ambient light is 0.4.
    assert numbers["nonlinearity"] < 1e-6
    np.testing.assert_allclose(numbers["ambient_rise"], 0.4 * np.array(FRACTIONS), 1e-6)
    peak = numbers["diffuse_peak"]
    np.testing.assert_allclose(peak, peak[-1] * np.array(FRACTIONS), atol=1e-6)
    assert 0.99 < peak[-1] <= 1
    # A larger exponent makes a narrower highlight.
    assert np.all(np.diff(numbers["width"]) < 0)
    assert f"{numbers['width'][1]:.1f}° for plastic (f = 5)" in finding.answer


@pytest.mark.parametrize("exponent", [EXPONENTS[0], 25.0, 100.0])
def test_the_width_is_that_of_the_formula(exponent):
    formula = np.rad2deg(np.arccos(0.5 ** (1 / exponent)))
    assert highlight_width(ball(200), exponent) == pytest.approx(formula, rel=0.01)
