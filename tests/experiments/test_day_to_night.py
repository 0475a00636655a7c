import numpy as np
import pytest

from experiments.day_to_night import EXPERIMENT, SOURCES, elevation


@pytest.mark.extended
def test_where_the_light_comes_from(found):
    finding = found(EXPERIMENT)
    numbers = finding.numbers
    assert not finding.failed_checks and numbers["sum_error"] < 1e-6
    hours, light_by_source = numbers["hours"], numbers["light_by_source"]
    sun, moon, lamp, sky, fog = (
        light_by_source[:, SOURCES.index(name)] for name in SOURCES
    )
    day = (hours > 7) & (hours < 17)
    night = (hours < 5) | (hours > 19)
    assert np.all(sun[day] > 0) and np.all(sun[night] == 0)
    assert np.all(lamp[night] > moon[night]) and np.all(moon[night] > 0)
    assert np.all(lamp[day] == 0) and np.all(sky > 0)
    noon = int(np.argmin(np.abs(hours - 12)))
    assert sun[noon] == sun.max() and sun[noon] > sky[noon]
    assert light_by_source[noon].sum() > 4 * light_by_source[0].sum()
    # Fog is thickest in the morning.
    assert 5 < hours[np.argmax(fog / light_by_source.sum(axis=1))] < 9


@pytest.mark.extended
def test_the_animation_is_a_day(found):
    frames = found(EXPERIMENT).frames
    assert frames.shape == (12, 48, 48, 3)
    mean = frames.mean(axis=(1, 2, 3))
    assert mean[6] > 4 * mean[0]


def test_the_sun():
    assert elevation(12) == 1 and abs(elevation(6)) < 1e-12 and elevation(0) == -1
