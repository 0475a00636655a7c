r"""Test of whether fitted normals belong to a surface or to its mirror image.

Slopes $p = -n_x / n_z$ and $q = -n_y / n_z$ of a surface satisfy $p_y = q_x$. If the
sign of the lights' y is wrong, so is that of the normals, and $p_y = -q_x$. The
residuals do not show it, since the mirrored object looks the same.
"""

import numpy as np
from jaxtyping import Bool, Float

from phongfit.rendering.render import block_means

# Number of blocks across the shorter side, over which normals are averaged first.
ACROSS = 24
# Slopes belong to the mirror image if the mean error for it is below this fraction of
# the error for the surface, with at least `PLACES` blocks of n_z above `STEEPEST`.
PLAINLY = 0.5
PLACES = 50
STEEPEST = 0.2


def is_mirrored(
    normals: Float[np.ndarray, "height width 3"],
    known: Bool[np.ndarray, "height width"],
) -> bool:
    """True if the slopes are consistent only with the sign of y, or of x, reversed.

    **Arguments:**

    - `normals`: in the camera's axes: x right, y up, z towards it.
    - `known`: true for reliable normals.
    """
    size = max(min(known.shape) // ACROSS, 1)
    share = block_means(known[..., None], size)
    mean = block_means(np.where(known[..., None], normals, 0), size)
    mean = mean / np.where(share > 0, share, 1)
    # Blocks of which half is known.
    inside = (share[..., 0] > 0.5) & (mean[..., 2] > STEEPEST)
    z = np.where(inside, mean[..., 2], 1)
    p, q = -mean[..., 0] / z, -mean[..., 1] / z
    # Row numbers increase downwards, y upwards.
    rise = (p[:-1] - p[1:])[:, :-1]
    run = (q[:, 1:] - q[:, :-1])[:-1]
    whole = inside[:-1, :-1] & inside[1:, :-1] & inside[:-1, 1:]
    if whole.sum() < PLACES:
        return False
    as_it_is, turned = (np.mean(np.abs(rise + sign * run)[whole]) for sign in (-1, 1))
    return bool(turned < PLAINLY * as_it_is)
