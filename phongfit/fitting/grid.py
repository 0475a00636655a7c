"""Was an image a JPEG file once? Then residuals jump between blocks of 8 × 8 pixels.

Each block was rounded by itself. So neighbours differ more across a block's edge than
on both sides of it, while without such blocks each place of the eight is like another:
changes there are compared with the changes next to them alone, so that nothing but
their order counts. Where the blocks begin is looked for, since an image may be cropped.
"""

import math
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

SIDE = 8
# Standard deviations, of the largest of 64 places where blocks may begin.
SIGNIFICANT = 5.0
# Comparisons at each place from which on their mean is normally distributed.
LEAST = 16

Grid = Float[Any, "2 8 3"]
"""Along both axes, at each place of eight: comparisons, their sum and its squares."""


def sum_at_places(
    residual: Float[Array, "height width 3"], used: Bool[Array, "height width 3"]
) -> Grid:
    """How changes from pixel to pixel compare with those next to them."""
    turned = jnp.swapaxes(residual, 0, 1), jnp.swapaxes(used, 0, 1)
    return jnp.stack([_along_rows(residual, used), _along_rows(*turned)])


def _along_rows(residual: Array, used: Array) -> Float[Array, "8 3"]:
    height, width, _ = residual.shape
    if height < SIDE or width < 2 * SIDE:
        return jnp.zeros((SIDE, 3), residual.dtype)
    change = jnp.sum((residual[:, 1:] - residual[:, :-1]) ** 2, axis=-1)
    known = jnp.all(used[:, 1:] & used[:, :-1], axis=-1)
    # Eight rows together: a single change says little.
    rows = height // SIDE * SIDE
    change = change[:rows].reshape(-1, SIDE, width - 1).sum(axis=1)
    known = known[:rows].reshape(-1, SIDE, width - 1).all(axis=1)
    known = known[:, 1:-1] & known[:, :-2] & known[:, 2:]
    middle = change[:, 1:-1]
    larger = (middle > change[:, :-2]).astype(residual.dtype)
    larger = jnp.where(known, larger + (middle > change[:, 2:]), 0)
    sums = jnp.stack([known.astype(larger.dtype), larger, larger**2], axis=-1)
    sums = jnp.pad(sums.sum(axis=0), [(0, -(width - 3) % SIDE), (0, 0)])
    return sums.reshape(-1, SIDE, 3).sum(axis=0)


def grid_significance(images: Sequence[Grid]) -> float:
    """How far the largest of the places stands out, in standard deviations."""
    sums = np.sum([np.asarray(one, float) for one in images], axis=0)
    if sums[..., 0].min() < LEAST:
        return 0.0
    count, total, squares = np.moveaxis(sums, -1, 0)
    whole = count.sum(axis=1, keepdims=True)
    mean = total.sum(axis=1, keepdims=True) / whole
    variance = squares.sum(axis=1, keepdims=True) / whole - mean**2
    deviation = np.sqrt(np.maximum(variance, 1e-12) * (1 / count - 1 / whole))
    beyond = (total / count - mean) / deviation
    return float(beyond.max(axis=1).sum()) / math.sqrt(2)
