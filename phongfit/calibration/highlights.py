"""Candidates for a lamp's highlight in a chrome sphere, with their errors."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

WIDEST = 0.15
"""Largest width of a lamp, as a fraction of the sphere's radius: windows and walls are
wider."""

FINE, COARSE = 0.02, 0.06
"""Widths between which a lamp stands out, as fractions of the radius: dust and sparkles
on the sphere are smaller, mirrored objects larger."""

KEPT = 6
"""Maximum number of candidates."""

FAINTEST = 0.1
"""Smallest score of a candidate, relative to the best one."""

INSIDE = 0.97
"""Fraction of the radius within which highlights are searched for: the rim mirrors most
of the surroundings."""

CORE = (0.5, 0.35, 0.2)
"""Thresholds for a highlight's core, relative to its brightest pixel; tried until the
core is large enough."""

LARGE_ENOUGH = 4
"""Smallest number of pixels of a core, so that noise does not dominate its centroid."""


class Highlight(NamedTuple):
    """A bright spot that may be the lamp.

    - `pixel`: its centroid, pixels from the upper left corner.
    - `error`: standard deviation of the centroid along each axis, pixels.
    - `size`: radius of the disk of its area, pixels.
    - `score`: in (0, 1]: contrast relative to the clearest spot.
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

    Spots are maxima of a difference of two Gaussians, after wide features have been
    subtracted; each is measured by the centroid of its core.

    **Arguments:**

    - `image`: grey linear light.
    - `outline`: x, y and radius of the sphere, pixels.
    - `still`: light that the sphere shows in every photograph, which is subtracted.
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
    """Measure the core of the spot at a pixel."""
    from scipy import ndimage

    away = np.hypot(columns - columns[here], rows - rows[here])
    brightest = light[away <= max(2 * fine, 1.5)].max()
    core = away < 1
    for level in CORE:
        labels = np.zeros(light.shape, np.int32)
        ndimage.label(light >= level * brightest, np.ones((3, 3)), labels)
        # The piece nearest to the maximum.
        nearest = np.where(labels > 0, away, np.inf)
        core = labels == labels.flat[np.argmin(nearest)]
        if core.sum() >= LARGE_ENOUGH:
            break
    # Grown by one pixel, to include pixels that the spot covers partly.
    grown = np.zeros(core.shape, bool)
    ndimage.binary_dilation(core, np.ones((3, 3)), output=grown)
    weight = light[grown] / light[grown].sum()
    pixel = np.array([np.sum(weight * columns[grown]), np.sum(weight * rows[grown])])
    size = float(np.sqrt(core.sum() / np.pi))
    # Errors of the centroid by pixels at the rim, and by glare off the lamp's centre.
    error = float(np.hypot(0.15 / np.sqrt(size), 0.05 * size))
    return Highlight(pixel, error, size, score)
