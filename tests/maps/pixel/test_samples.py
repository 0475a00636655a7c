"""Samples of a tile."""

import numpy as np

from phongfit.maps.pixel.samples import Tile


def test_padding_is_not_used():
    light, used = np.ones((2, 5, 3)), np.ones((1, 5, 1), bool)
    tile = Tile(light, used, np.ones((8, 3)), np.ones((1, 3)), np.ones((1, 3)))
    for part, few in zip(tile.parts(4), (4, 1), strict=True):
        whole = part.padded()
        assert whole.target.shape == (2, 4, 3) and whole.used.shape == (1, 4, 1)
        assert whole.target[:, :few].all() and not whole.target[:, few:].any()
        assert whole.used[:, :few].all() and not whole.used[:, few:].any()
