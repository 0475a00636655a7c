"""Find outlines of spheres in an edge map, to a fraction of a pixel."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

SECTORS = 48
"""Number of pieces of an arc."""

SEEN_OF_BALL = 0.45
"""Smallest fraction of a ball's arc with a visible edge: its shadowed side, before a
dark background, has none."""

LARGE = 0.04
"""Smallest radius of a ball, as a fraction of the photograph's shorter side."""

CLEARLY = 0.1
"""A piece has a visible edge if the edge passes on this fraction of its radii, in the
mean of the photographs."""

MARKED = 0.25
"""Smallest weight of an edge point."""

CLOSE = 0.75
"""Largest distance of an edge on a circle, pixels."""

EXCESS = 3.0
"""Smallest excess of edges on a circle. Mere noise has circles with 2."""

VOTED, MOST = 0.1, 20
"""Smallest fraction of a circle that votes for it; largest number of circles tried
with radii within a factor of 2."""


FINE = 0.7
"""Standard deviation of the smoothing when an outline is placed, pixels."""


OUTWARD = 0.75
"""Weight of a mirror's edges outside the circle; those inside have 1 − OUTWARD.

Near its rim a mirror reflects its immediate surroundings, so an edge is visible only
where the two differ: at the rim or, mostly, slightly inside.
"""


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


class Placed(NamedTuple):
    """A circle fitted to an edge map.

    - `outline`: x, y and radius in pixels from the upper left corner.
    - `covariance`: of these three, pixels².
    - `coverage`: fraction of the arc on which there is an edge.
    - `excess`: by how many standard deviations more edges lie on the circle than if
        they were anywhere near it.
    """

    outline: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"]
    coverage: float
    excess: float

    @property
    def arc(self) -> float:
        """Length of the visible arc, in units of 2π pixels."""
        return self.coverage * self.outline[2]


class _Ring(NamedTuple):
    """Search points for edges: along radii, up to `reach` pixels from an outline.

    - `away`: unit vectors along the radii.
    - `offsets`: steps along each, pixels from the outline.
    - `where`: rows and columns of these steps, counted from the first pixel's centre.
    """

    outline: Float[np.ndarray, "3"]
    reach: float
    away: Float[np.ndarray, "radii 2"]
    offsets: Float[np.ndarray, " steps"]
    where: Float[np.ndarray, "2 radii steps"]


class _EdgePoints(NamedTuple):
    """Possible places of an outline, from a number of `photographs`.

    - `angle`: of the radius.
    - `offset`: pixels outward from the ring's outline.
    - `weight`: in [0, 1), as the strength of [`Edges`][].
    """

    angle: Float[np.ndarray, " points"]
    offset: Float[np.ndarray, " points"]
    weight: Float[np.ndarray, " points"]
    photographs: int


def place(
    photographs: Float[np.ndarray, "count height width"],
    outline: Float[np.ndarray, "3"],
    stretch: Float[np.ndarray, "2"] | None = None,
    reach: float = 4.0,
    mirrors: bool = False,
) -> Placed:
    """Move a circle onto the edge that most photographs show all along it.

    Along each radius of each photograph the gradient's local maxima are possible places
    of the outline. The circle is placed where most of them agree, since mirror images
    in a chrome sphere move with the lamp, or cross few radii. It is the maximum of a
    kernel density, whose kernel is narrowed step by step.

    **Arguments:**

    - `photographs`: grey linear light.
    - `outline`: initial circle, within `reach` pixels of the outline.
    - `stretch`: of an ellipse's longer axis: see `stretch` of `outlines`.
    - `mirrors`: true for a chrome sphere.
    """
    stretch = np.zeros(2) if stretch is None else np.asarray(stretch)
    ring = _ring(np.asarray(outline, float), stretch, reach)
    return _placed(ring, _edge_points(photographs, [ring])[0], mirrors)


def _placed(ring: _Ring, points: _EdgePoints, mirrors: bool = False) -> Placed:
    """The circle on which most points agree."""
    outline, reach = ring.outline, ring.reach
    angles, offsets, weights = points.angle, points.offset, points.weight
    away = np.stack([np.cos(angles), np.sin(angles), np.ones_like(angles)], 1)

    def kernel(step: np.ndarray, width: float) -> np.ndarray:
        """Weights of points by their distance from a moved circle."""
        return weights * np.exp(-0.5 * ((offsets - away @ step) / width) ** 2)

    def moved(near: np.ndarray) -> np.ndarray:
        """The move of the circle to the least squares fit of weighted points."""
        normal = away.T @ (near[:, None] * away) + 1e-9 * np.eye(3)
        return np.linalg.solve(normal, away.T @ (near * offsets))

    best, highest = np.zeros(3), -np.inf
    for start in np.arange(-reach, reach + 0.1, 0.5):
        step, near = np.array([0, 0, start]), weights
        for width in (1.5, 0.8, 0.4, 0.25, 0.25, 0.25):
            near = kernel(step, width)
            step = moved(near)
        density = near.sum()
        if density > highest and np.abs(step).max() < 2 * reach:
            best, highest = step, density
    for _ in range(30 if mirrors else 0):
        near = kernel(best, 0.6)
        best = moved(near * np.where(offsets > away @ best, OUTWARD, 1 - OUTWARD))
    rest, near = offsets - away @ best, kernel(best, 0.25)
    # Points within the smoothing, and photographs of one edge, are not independent.
    count = max(2 * np.pi * outline[2] / 3, 8)
    spread = np.sum(near * rest**2) / max(np.sum(near), 1e-9)
    normal = away.T @ (near[:, None] * away) / max(np.sum(near), 1e-9) * count
    covariance = max(spread, 0.05**2) * np.linalg.pinv(normal + 1e-9 * np.eye(3))
    sector = np.floor(angles * SECTORS / (2 * np.pi)).astype(int)
    close = weights * (np.abs(rest) < CLOSE)
    shown = np.bincount(sector, close, SECTORS) / (points.photographs * len(ring.away))
    coverage = np.mean(shown * SECTORS > CLEARLY)
    chance = CLOSE / reach
    excess = close.sum() / max(weights.sum(), 1e-9) - chance
    excess /= np.sqrt(chance * (1 - chance) / count)
    return Placed(outline + best, covariance, float(coverage), float(excess))


def _ring(outline: np.ndarray, stretch: np.ndarray, reach: float) -> _Ring:
    reach = min(reach, outline[2] / 3)
    count = int(np.clip(2 * np.pi * outline[2], 48, 1000))
    angles = np.arange(count) * (2 * np.pi / count)
    away = np.stack([np.cos(angles), np.sin(angles)], 1)
    # To first order an ellipse of equal area: half the stretch longer along its axis.
    size = np.hypot(*stretch)
    along = (away @ (stretch / size)) ** 2 if size > 0 else np.full(count, 0.5)
    radius = outline[2] * (1 + size * (along - 0.5))
    offsets = np.arange(-reach, reach + 0.26, 0.25)
    at = outline[:2] + (radius[:, None] + offsets)[..., None] * away[:, None]
    # Pixel centres are at half integers.
    where = np.moveaxis(at[..., ::-1], -1, 0) - 0.5
    return _Ring(outline, reach, away, offsets, where)


def _edge_points(
    photographs: Float[np.ndarray, "count height width"], rings: Sequence[_Ring]
) -> list[_EdgePoints]:
    """Edge points of each ring; each photograph's gradient is computed once."""
    found: list[list[np.ndarray]] = [[] for _ in rings]
    for light in photographs:
        slopes = gradient(np.sqrt(np.maximum(light, 0)), FINE)
        squared = slopes[0] ** 2 + slopes[1] ** 2
        noise = max(float(np.median(squared)) / 1.18**2, 1e-8)
        for ring, points in zip(rings, found, strict=True):
            points.append(_along(ring, slopes, noise))
    together = [np.concatenate(points, axis=1) for points in found]
    return [
        _EdgePoints(angle, offset, weight, len(photographs))
        for angle, offset, weight in together
    ]


def _along(
    ring: _Ring, slopes: tuple[np.ndarray, np.ndarray], noise: float
) -> Float[np.ndarray, "3 points"]:
    """Angle, offset and weight of a photograph's edge points along one ring."""
    from scipy import ndimage

    # Only the radial gradient, since edges along a radius are not the outline's.
    towards = [ndimage.map_coordinates(part, ring.where, order=1) for part in slopes]
    radial = towards[0] * ring.away[:, :1] + towards[1] * ring.away[:, 1:]
    height = radial**2 / (radial**2 + CLEAR**2 * noise)
    left, middle, right = height[:, :-2], height[:, 1:-1], height[:, 2:]
    row, column = np.nonzero((middle >= left) & (middle > right) & (middle > MARKED))
    a, b, c = (part[row, column] for part in (left, middle, right))
    shift = 0.5 * (a - c) / np.minimum(a - 2 * b + c, -1e-12)
    offset = ring.offsets[column + 1] + 0.25 * np.clip(shift, -1, 1)
    return np.stack([row * (2 * np.pi / len(ring.away)), offset, b])


def find_circles(
    photographs: Float[np.ndarray, "count height width"],
) -> list[Placed]:
    """Circles that may be outlines of round objects, in no order.

    Every edge votes for centres along its gradient (Hough's transform with the
    gradient's direction), over all radii. Circles with many votes are moved onto the
    edges.

    **Arguments:** `photographs`: grey linear light.

    ??? cite "Source"
        Kimme, Ballard and Sklansky, *Finding circles by an array of accumulators*,
        CACM 18(2), 1975.
    """
    edges = find_edges(photographs)
    if len(photographs) > 1:
        # The mean has less noise, so it shows outlines that each photograph hides.
        mean = find_edges(photographs.mean(axis=0, keepdims=True))
        clearer = mean.strength > edges.strength
        edges = Edges(
            np.where(clearer, mean.strength, edges.strength),
            np.where(clearer[..., None], mean.direction, edges.direction),
        )
    height, width = edges.strength.shape
    shrink = max(1, round(max(height, width) / 480))
    rings = [
        _ring(np.array([x, y, radius]), np.zeros(2), reach=2.0 * shrink + 2)
        for x, y, radius in _vote(edges, shrink)
        if radius < x < width - radius and radius < y < height - radius
    ]
    found = map(_placed, rings, _edge_points(photographs, rings))
    return [placed for placed in found if placed.excess > EXCESS]


def outermost(circles: Iterable[Placed]) -> list[Placed]:
    """Circles whose centre lies in no larger one, those with the longest arc first.

    A chrome sphere mirrors its surroundings as circles within its outline.
    """
    kept: list[Placed] = []
    for placed in sorted(circles, key=lambda placed: -placed.outline[2]):
        x, y, _ = placed.outline
        if all(
            np.hypot(x - other.outline[0], y - other.outline[1]) > other.outline[2]
            for other in kept
        ):
            kept.append(placed)
    return sorted(kept, key=lambda placed: -placed.arc)


def find_largest_arc(
    photographs: Float[np.ndarray, "count height width"],
) -> Placed | None:
    """The circle with the longest visible arc, for a photograph of one ball.

    About half of the arc is enough, since a ball under one lamp has a dark side.

    **Arguments:** `photographs`: grey linear light.

    **Returns:** `None` if no circle is clear enough.
    """
    smallest = LARGE * min(photographs.shape[1:])
    arcs = [
        placed
        for placed in find_circles(photographs)
        if placed.coverage >= SEEN_OF_BALL and placed.outline[2] >= smallest
    ]
    return max(arcs, key=lambda placed: placed.arc, default=None)


def _vote(edges: Edges, shrink: int) -> list[np.ndarray]:
    """Circles with the most votes of edges: (x, y, radius) in pixels."""
    from scipy import ndimage

    height, width = (n // shrink for n in edges.strength.shape)
    strength = edges.strength[: height * shrink, : width * shrink]
    peaks = ndimage.maximum_filter(strength, 3)
    # Only ridges vote, since broad edges would vote many times.
    ridge = (strength == peaks) | _is_ridge(edges)[: height * shrink, : width * shrink]
    rows, columns = np.nonzero(ridge & (strength > MARKED))
    across = edges.direction[rows, columns]
    weight = 1.0 / shrink
    x, y = (columns + 0.5) / shrink, (rows + 0.5) / shrink
    radii = np.arange(max(6.0, 0.02 * min(height, width)), 0.5 * min(height, width))
    if not len(radii):
        return []
    votes = np.zeros((len(radii), height, width), np.float32)
    for number, radius in enumerate(radii):
        for sign in (-1, 1):
            column = np.floor(x + sign * radius * across[:, 0]).astype(int)
            row = np.floor(y + sign * radius * across[:, 1]).astype(int)
            fits = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            place = row[fits] * width + column[fits]
            counts = np.bincount(place, minlength=height * width) * weight
            votes[number] += counts.reshape(height, width)
        votes[number] /= 2 * np.pi * radius
    # Smoothed, since errors of the gradient's direction scatter the votes.
    votes = ndimage.gaussian_filter(votes, (0.7, 1.5, 1.5), truncate=3)
    votes *= 2 * np.pi * 1.5**2
    best = (votes == ndimage.maximum_filter(votes, 5)) & (votes > VOTED)
    number, row, column = np.nonzero(best)
    found = np.stack([column + 0.5, row + 0.5, radii[number]], 1) * shrink
    found = found[np.argsort(-votes[number, row, column])]
    # Noise makes many small circles, which must not displace the large ones.
    octave = np.floor(np.log2(found[:, 2] / radii[0])).astype(int)
    return [circle for n in np.unique(octave) for circle in found[octave == n][:MOST]]


def _is_ridge(edges: Edges) -> np.ndarray:
    """Mask of local maxima of the edge map across the edge."""
    from scipy import ndimage

    height, width = edges.strength.shape
    row, column = np.mgrid[:height, :width].astype(float)
    higher = np.ones((height, width), bool)
    for sign in (-1, 1):
        where = [
            row + sign * edges.direction[..., 1],
            column + sign * edges.direction[..., 0],
        ]
        beside = ndimage.map_coordinates(edges.strength, where, order=1)
        higher &= edges.strength >= beside
    return higher
