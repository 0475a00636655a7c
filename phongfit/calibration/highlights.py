"""A lamp's highlight in a chrome sphere: where it may be, how well that is known."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

WIDEST = 0.15
"""What is wider, as a share of the sphere's radius, is a window or a wall, no lamp."""

FINE, COARSE = 0.02, 0.06
"""A lamp stands out between these widths, as shares of the radius: dust and sparkles on
the sphere are smaller, mirrored things larger."""

KEPT = 6
"""Candidates that are kept, the best first."""

FAINTEST = 0.1
"""Candidates stand out at least this much, of the one that does so most."""

INSIDE = 0.97
"""Share of the radius up to which highlights are looked for: the rim mirrors a lot."""

CORE = (0.5, 0.35, 0.2)
"""Thresholds for a highlight's core, of its brightest pixel, until it is large."""

LARGE_ENOUGH = 4
"""Pixels of a core, for its centroid to be one of more than noise."""


class Highlight(NamedTuple):
    """A blob that may be the lamp.

    - `pixel`: its centroid, pixels from the upper left corner.
    - `error`: standard deviation of the centroid along each axis, pixels.
    - `size`: radius of the disk of its area, pixels.
    - `score`: in (0, 1]: how far it stands out, of the one that does so most.
    """

    pixel: Float[np.ndarray, "2"]
    error: float
    size: float
    score: float


def find_highlights(
    image: Float[np.ndarray, "height width"],
    outline: Float[np.ndarray, "3"],
    still: Float[np.ndarray, "height width"] | None = None,
) -> list[Highlight]:
    """Bright spots within a sphere's outline, the likeliest lamp first.

    Spots are where a difference of two Gaussians is largest, once what is wide has been
    taken away; each is measured by the centroid of its core.

    **Arguments:**

    - `image`: grey linear light.
    - `outline`: x, y and radius of the sphere, pixels.
    - `still`: what the sphere shows in every photograph, and is no lamp that moves.
    """
    from scipy import ndimage

    x, y, radius = outline
    left, top = (max(int(v - radius) - 1, 0) for v in (x, y))
    crop = (slice(top, int(y + radius) + 2), slice(left, int(x + radius) + 2))
    light = image[crop]
    if still is not None:
        light = np.maximum(light - still[crop], 0)
    rows, columns = np.mgrid[: light.shape[0], : light.shape[1]]
    columns, rows = columns + left + 0.5, rows + top + 0.5
    inside = np.hypot(columns - x, rows - y) < INSIDE * radius
    light = np.where(inside, light, 0)
    width = 2 * max(round(WIDEST * radius), 3) + 1
    narrow = light - ndimage.grey_opening(light, width)
    fine, coarse = max(FINE * radius, 0.8), max(COARSE * radius, 2.4)
    standing = ndimage.gaussian_filter(narrow, fine) - ndimage.gaussian_filter(
        narrow, coarse
    )
    standing = np.where(inside, standing, 0)
    most = standing.max(initial=0)
    if most <= 0:
        return []
    near = 2 * round(coarse) + 1
    peaks = standing == ndimage.maximum_filter(standing, near)
    peaks &= standing > FAINTEST * most
    order = np.argsort(-standing[peaks])[:KEPT]
    found = []
    for row, column in np.argwhere(peaks)[order].tolist():
        reach = int(np.ceil(2 * coarse))
        box = (
            slice(max(row - reach, 0), row + reach + 1),
            slice(max(column - reach, 0), column + reach + 1),
        )
        score = float(standing[row, column] / most)
        here = (row - box[0].start, column - box[1].start)
        found.append(_measure(narrow[box], columns[box], rows[box], here, fine, score))
    return found


def _measure(
    light: np.ndarray,
    columns: np.ndarray,
    rows: np.ndarray,
    here: tuple[int, int],
    fine: float,
    score: float,
) -> Highlight:
    """The core of the spot that stands out at a pixel."""
    from scipy import ndimage

    away = np.hypot(columns - columns[here], rows - rows[here])
    brightest = light[away <= max(2 * fine, 1.5)].max()
    core = away < 1
    for level in CORE:
        labels = np.zeros(light.shape, np.int32)
        ndimage.label(light >= level * brightest, np.ones((3, 3)), labels)
        # The piece that is nearest to where the spot stands out.
        nearest = np.where(labels > 0, away, np.inf)
        core = labels == labels.flat[np.argmin(nearest)]
        if core.sum() >= LARGE_ENOUGH:
            break
    # One pixel more all round: what the rim's pixels are covered by counts.
    grown = np.zeros(core.shape, bool)
    ndimage.binary_dilation(core, np.ones((3, 3)), output=grown)
    weight = light[grown] / light[grown].sum()
    pixel = np.array([np.sum(weight * columns[grown]), np.sum(weight * rows[grown])])
    size = float(np.sqrt(core.sum() / np.pi))
    # The rim's pixels move a centroid this much; and glare is not centred on the lamp.
    error = float(np.hypot(0.15 / np.sqrt(size), 0.05 * size))
    return Highlight(pixel, error, size, score)
