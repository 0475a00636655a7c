import numpy as np
import pytest

from experiments.adding_light import EXPERIMENT


@pytest.mark.extended
def test_linear_light_adds_and_too_much_changes_colour(found):
    finding = found(EXPERIMENT)
    numbers = finding.numbers
    assert not finding.failed_checks
    assert numbers["sum_error"] < 1e-6
    # Pictures as a screen shows them do not add up.
    assert numbers["shown_error"] > 0.1
    clipped, hue = numbers["clipped"], numbers["hue"]
    assert clipped[0] == 0 and np.all(np.diff(clipped) > 0)
    # Orange turns yellow, channel by channel.
    assert hue[0] == hue[1] < 25 < hue[2] < hue[3] and abs(hue[3] - 60) < 1
