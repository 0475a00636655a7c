import dataclasses

import numpy as np
import pytest

import phongfit as pf
from experiments.highlights import EXPERIMENT, LAMP, IdealMirror, profile
from tests.helpers import floats, unit


@pytest.mark.extended
def test_phongs_exponent_is_a_quarter_of_blinns(found):
    finding = found(EXPERIMENT)
    ratio, residual = finding.numbers["ratio"], finding.numbers["residual"]
    assert not finding.failed_checks
    # Lamp beside the viewer, narrow highlights: the rule holds to 2 %.
    np.testing.assert_allclose(ratio[-2:, 0], 0.25, rtol=0.02)
    # It is off for wide ones, and for lamps far around, where no exponent fits.
    assert ratio[0, 0] < 0.22 and np.all(ratio[:, -1] > 0.35)
    assert residual[-1, 0] < 0.01 < 0.1 < residual[-1, -1]


def test_profiles():
    degrees = np.array([0.0, 4.0, 8.0])
    f = 50.0
    phong = profile(pf.Phong(), degrees, f)
    assert phong == pytest.approx(np.cos(np.deg2rad(2 * degrees)) ** f, rel=1e-4)
    # Half as fast: what Phong's has at an angle, Blinn's has at twice the angle.
    assert profile(pf.BlinnPhong(), 2 * degrees, f) == pytest.approx(phong, rel=1e-4)
    # A mirror turns by twice the normal's angle: the lamp's disc ends at half of it.
    edge = np.array([0.49, 0.51]) * LAMP
    assert profile(IdealMirror(), edge, f).tolist() == [1, 0]


def test_the_mirror_sends_light_the_mirrored_way_only():
    model = dataclasses.replace(IdealMirror(), radius=5.0)
    up, lamp = unit(0, 0, 1), unit(1, 0, 1)

    def seen(view):
        return float(model.lobe(model.cosine(up, lamp, view), floats(1.0)))

    assert seen(unit(-1, 0, 1)) == 1 and seen(unit(-1.1, 0, 1)) == 1
    assert seen(unit(-1.4, 0, 1)) == 0 and seen(unit(1, 0, 1)) == 0
