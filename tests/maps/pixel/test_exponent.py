"""Sums over the lights, by way of products made beforehand, against plain ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from phongfit.maps.pixel.columns import make_columns
from phongfit.maps.pixel.exponent import sum_lights, sum_slopes
from phongfit.maps.pixel.lobes import PowerLobes
from phongfit.maps.pixel.small import over_channels
from phongfit.reflectance import BlinnPhong
from tests.helpers import floats

IMAGES = 40


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("lights", [1, 2, 3])
def test_sums_of_several_highlights(lights, channels):
    rng = np.random.default_rng(lights)
    shape = (channels, IMAGES)
    fixed = [rng.random(shape) for _ in range(2)]
    target, weight = rng.random(shape), (rng.random(shape) > 0.2) * 0.7
    strength = [rng.random(shape) for _ in range(lights)]
    logarithm = [floats(-0.3 * rng.random(IMAGES)) for _ in range(lights)]
    columns = over_channels(
        make_columns,
        tuple(map(floats, fixed)),
        floats(target),
        floats(weight),
        tuple(map(floats, strength)),
    )
    lobes = PowerLobes(BlinnPhong())
    heights, rises = lobes.at(tuple(logarithm), floats(np.log(12.0)))
    sums = sum_lights(columns, heights)
    slopes = sum_slopes(columns, heights, rises)
    light, change = (
        np.sum([s * np.asarray(h) for s, h in zip(strength, parts, strict=True)], 0)
        for parts in (heights, rises)
    )
    # The slope is the lobe's derivative in log f.
    power = 12 * np.asarray(logarithm[0])
    np.testing.assert_allclose(rises[0], power * np.exp(power), rtol=1e-4, atol=1e-6)
    for c in range(channels):
        root = np.sqrt(weight[c])
        matrix = root[:, None] * np.stack([f[c] for f in fixed], axis=1)
        gram = matrix.T @ matrix
        for i in range(2):
            for j in range(i + 1):
                assert float(columns.gram[i][j][c]) == pytest.approx(gram[i, j], 1e-4)
        best, *_ = np.linalg.lstsq(matrix, root * target[c])
        rest = root * target[c] - matrix @ best
        expected = {
            "cross": (sums.cross, matrix.T @ (root * light[c])),
            "own": (sums.own, light[c] @ (weight[c] * light[c])),
            "moment": (sums.moment, rest @ (root * light[c])),
            "slope cross": (slopes.cross, matrix.T @ (root * change[c])),
            "mixed": (slopes.mixed, light[c] @ (weight[c] * change[c])),
            "slope own": (slopes.own, change[c] @ (weight[c] * change[c])),
            "slope moment": (slopes.moment, rest @ (root * change[c])),
        }
        for name, (found, wanted) in expected.items():
            value = np.asarray(jnp.stack(jax.tree.leaves(found)))[..., c]
            np.testing.assert_allclose(
                value, np.ravel(wanted), rtol=1e-3, atol=1e-4, err_msg=name
            )
