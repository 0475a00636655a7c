"""Edges at the same place under all lamps: the outlines of objects."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

SMOOTHING = 1.2
"""Standard deviation of the smoothing before the gradient, pixels."""

CLEAR = 6.0
"""A gradient of this many times the noise has weight 1/2; weights are below 1."""


class Edges(NamedTuple):
    """An edge map.

    - `strength`: in [0, 1): the fraction of photographs with an edge at this pixel.
        Low for shadows, which move with the lamp; high for outlines.
    - `direction`: unit vectors (x, y) across the edge.
    """

    strength: Float[np.ndarray, "height width"]
    direction: Float[np.ndarray, "height width 2"]


def gradient(
    image: Float[np.ndarray, "height width"], width: float
) -> tuple[Float[np.ndarray, "height width"], Float[np.ndarray, "height width"]]:
    """Derivatives to the right and down, after smoothing by `width` pixels."""
    from scipy.ndimage import gaussian_filter1d

    across = gaussian_filter1d(gaussian_filter1d(image, width, 0), width, 1, 1)
    down = gaussian_filter1d(gaussian_filter1d(image, width, 1), width, 0, 1)
    return across, down


def find_edges(photographs: Float[np.ndarray, "count height width"]) -> Edges:
    """Edges that are common to photographs of one camera.

    The gradient is that of the square root of light, whose photon noise is uniform.
    With m its size in units of noise, the weight is m² / (m² + CLEAR²): a faint outline
    in all photographs weighs as much as a bright one.

    **Arguments:** `photographs`: grey linear light; each under another lamp.
    """
    strength = np.zeros(photographs.shape[1:])
    tensor = np.zeros((*photographs.shape[1:], 3))
    for light in photographs:
        image = np.sqrt(np.maximum(light, 0))
        across, down = gradient(image, SMOOTHING)
        squared = across**2 + down**2
        # In pure noise the median of a gradient's size is 1.18 σ of its components;
        # this holds, since most of a photograph is smooth.
        noise = max(np.median(squared) / 1.18**2, 1e-8)
        strength += squared / (squared + CLEAR**2 * noise)
        share = 1 / (squared + CLEAR**2 * noise)
        tensor += np.stack([across**2, across * down, down**2], -1) * share[..., None]
    # The principal axis of the gradients, whose sign is arbitrary.
    angle = 0.5 * np.arctan2(2 * tensor[..., 1], tensor[..., 0] - tensor[..., 2])
    direction = np.stack([np.cos(angle), np.sin(angle)], -1)
    return Edges(strength / len(photographs), direction)
