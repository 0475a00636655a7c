"""What pixels measure, and which of their channels differ."""

import jax
import numpy as np
import pytest

from phongfit.maps.pixel.lamps import Lamps
from phongfit.maps.pixel.samples import (
    Samples,
    Tile,
    differing_channels,
    of_one_channel,
)
from tests.helpers import floats

IMAGES, PIXELS = 4, 5
DIFFERING = jax.jit(differing_channels)


def samples_in(color, ambient=(0.3, 0.3, 0.3)) -> Samples:
    """One distant lamp an image, of growing strength."""
    strength = np.arange(1.0, IMAGES + 1)[:, None, None, None]
    light = floats(strength * np.asarray(color)[:, None])
    around = floats(np.tile(np.asarray(ambient)[:, None], (IMAGES, 1, 1)))
    ahead = np.zeros((IMAGES, 1, 3, 1))
    ahead[:, :, 2] = 1
    none = floats(np.zeros(around.shape))
    lamps = Lamps(floats(ahead), light, light, around, none, floats(ahead[0, 0]))
    ones = floats(np.ones((IMAGES, 3, PIXELS)))
    return Samples(ones, ones, lamps)


def test_channels_in_white_light_differ_by_their_samples_alone():
    samples = samples_in((0.7, 0.7, 0.7))
    assert not DIFFERING(samples).any()
    share = np.array(samples.share)
    share[2, 1, 3], share[:, :, 4] = 0, 0.5
    differ = DIFFERING(samples._replace(share=floats(share)))
    assert np.array_equal(np.flatnonzero(differ), [3])


@pytest.mark.parametrize(
    ("color", "ambient"),
    [((1.0, 0.9, 0.8), (0.3, 0.3, 0.3)), ((1.0, 1.0, 1.0), (0.3, 0.3, 0.4))],
)
def test_in_coloured_light_all_differ(color, ambient):
    assert DIFFERING(samples_in(color, ambient)).all()


def test_one_channel_stands_for_all():
    one = of_one_channel(samples_in((0.7, 0.7, 0.7)))
    assert one.target.shape == (IMAGES, 3, PIXELS)
    assert one.share.shape == (IMAGES, 1, PIXELS)
    assert [leaf.shape for leaf in one.lamps[1:4]] == [
        (IMAGES, 1, 1, 1),
        (IMAGES, 1, 1, 1),
        (IMAGES, 1, 1),
    ]


def test_padding_is_not_used():
    light, used = np.ones((2, 5, 3)), np.ones((1, 5, 1), bool)
    tile = Tile(light, used, np.ones((8, 3)), np.ones((1, 3)), np.ones((1, 3)))
    for part, few in zip(tile.parts(4), (4, 1), strict=True):
        whole = part.padded()
        assert whole.target.shape == (2, 4, 3) and whole.used.shape == (1, 4, 1)
        assert whole.target[:, :few].all() and not whole.target[:, few:].any()
        assert whole.used[:, :few].all() and not whole.used[:, few:].any()
