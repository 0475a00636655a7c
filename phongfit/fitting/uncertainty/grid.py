"""Test whether an image was a JPEG file: residuals jump between blocks of 8 × 8 pixels.

Each block was rounded separately, so neighbours differ more across a block's edge than
on both sides of it. Without blocks all eight positions are equivalent. Each change is
compared only with the changes next to it. All positions of the blocks' edges are
tested, since an image may be cropped.
"""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

SIDE = 8
# Standard deviations, along both axes, of the largest of eight positions; exceeded by
# chance once in 30 000 images.
SIGNIFICANT = 3.2
# Number of comparisons at each position from which their mean is nearly normal.
LEAST = 16

Grid = Float[Any, "2 8 3"]
"""For both axes and eight positions: number of comparisons, sum, sum of squares."""


def sum_at_places(
    residual: Float[Array, "height width 3"], used: Bool[Array, "height width 3"]
) -> Grid:
    """Sums of comparisons of changes from pixel to pixel with those next to them."""
    # JPEG files round colour differences most; grey images have none.
    light = residual[..., 0] - 0.7 * residual[..., 2]
    seen = used[..., 0] & used[..., 2]
    return jnp.stack([_along_rows(light, seen), _along_rows(light.T, seen.T)])


def _along_rows(
    light: Float[Array, "height width"], seen: Bool[Array, "height width"]
) -> Float[Array, "8 3"]:
    height, width = light.shape
    if height < 2 or width < 2 * SIDE:
        return jnp.zeros((SIDE, 3), light.dtype)
    change = (light[:, 1:] - light[:, :-1]) ** 2
    known = seen[:, 1:] & seen[:, :-1]
    # Two rows are added, since a single change is too noisy.
    rows = height // 2 * 2
    change = change[:rows:2] + change[1:rows:2]
    known = known[:rows:2] & known[1:rows:2]
    known = known[:, 1:-1] & known[:, :-2] & known[:, 2:]
    middle = change[:, 1:-1]
    sides = change[:, :-2], change[:, 2:]
    larger = sum((middle > side).astype(light.dtype) for side in sides)
    larger = jnp.where(known, larger, 0)
    parts = known.astype(larger.dtype), larger, larger**2
    sums = jnp.stack([part.sum(axis=0) for part in parts])
    sums = jnp.pad(sums, [(0, 0), (0, -(width - 3) % SIDE)])
    return sums.reshape(3, -1, SIDE).sum(axis=1).T


def grid_significance(images: Sequence[Grid]) -> float:
    """Significance of block edges in standard deviations: the lesser of both axes.

    Stripes in an image may be significant along one axis.
    """
    sums = np.sum([np.asarray(one, float) for one in images], axis=0)
    if sums[..., 0].min() < LEAST:
        return 0.0
    count, total, squares = np.moveaxis(sums, -1, 0)
    whole = count.sum(axis=1, keepdims=True)
    mean = total.sum(axis=1, keepdims=True) / whole
    variance = squares.sum(axis=1, keepdims=True) / whole - mean**2
    deviation = np.sqrt(np.maximum(variance, 1e-12) * (1 / count - 1 / whole))
    beyond = (total / count - mean) / deviation
    return float(beyond.max(axis=1).min())
