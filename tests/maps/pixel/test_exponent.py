"""Sums over the lights, by way of products made beforehand, against plain ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from phongfit.maps.pixel.columns import make_columns
from phongfit.maps.pixel.exponent import sum_images, sum_with_slopes
from phongfit.maps.pixel.lobes import PowerLobes
from phongfit.reflectance import BlinnPhong
from tests.helpers import floats

IMAGES = 40


def one_pixel(*layers):
    """Layers whose first axis is the images', as those of a single pixel."""
    return [floats(layer)[..., None] for layer in layers]


LOBES = PowerLobes(BlinnPhong())


@jax.jit
def sums_of(columns, seen, whole, strong, angles, t):
    """Products, sums at one exponent with slopes, at two, and the lobes themselves."""
    made = make_columns(columns, seen, whole, strong)
    several = jnp.stack([jnp.zeros_like(t), t])
    lobes = [LOBES.at(t)(angles[:, j]) for j in range(angles.shape[1])]
    sums, slopes = sum_with_slopes(made, LOBES, angles, t)
    return made, sums, slopes, sum_images(made, LOBES, angles, several), lobes


@pytest.mark.parametrize(
    "lights, channels",
    [
        (2, 3),
        *(
            pytest.param(*several, marks=pytest.mark.extended)
            for several in ((1, 1), (1, 3), (2, 1), (3, 1), (3, 3))
        ),
    ],
)
def test_sums_of_several_highlights(lights, channels):
    rng = np.random.default_rng(lights)
    shape = (channels, IMAGES)
    fixed = [rng.random(shape) for _ in range(2)]
    target, weight = rng.random(shape), (rng.random(shape) > 0.2) * 0.7
    strength = [rng.random(shape) for _ in range(lights)]
    logarithm = -0.3 * rng.random((IMAGES, lights))
    *columns, seen, whole = one_pixel(*(x.T for x in (*fixed, target, weight)))
    (strong,) = one_pixel(np.moveaxis(np.array(strength), -1, 0))
    (angles,) = one_pixel(logarithm)
    columns, sums, slopes, several, found = sums_of(
        tuple(columns), seen, whole, strong, angles, floats([[np.log(12.0)]])
    )
    for one, other in zip(jax.tree.leaves(several), jax.tree.leaves(sums), strict=True):
        np.testing.assert_allclose(one[1], other, rtol=1e-5)
    heights, rises = ([np.asarray(one[k])[..., 0] for one in found] for k in (0, 1))
    light, change = (
        np.sum([s * np.asarray(h) for s, h in zip(strength, parts, strict=True)], 0)
        for parts in (heights, rises)
    )
    # The slope is the lobe's derivative in log f.
    power = 12 * logarithm[:, 0]
    np.testing.assert_allclose(rises[0], power * np.exp(power), rtol=1e-4, atol=1e-6)
    for c in range(channels):
        root = np.sqrt(weight[c])
        matrix = root[:, None] * np.stack([f[c] for f in fixed], axis=1)
        gram = matrix.T @ matrix
        for i in range(2):
            for j in range(i + 1):
                assert float(columns.gram[i][j][c, 0]) == pytest.approx(
                    gram[i, j], 1e-4
                )
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
            value = np.stack(jax.tree.leaves(found))[..., c, 0]
            np.testing.assert_allclose(
                value, np.ravel(wanted), rtol=1e-3, atol=1e-4, err_msg=name
            )
