"""Spheres in photographs: find, classify and crop them."""

from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from phongfit.calibration.circles import (
    EXCESS,
    SEEN_OF_BALL,
    Placed,
    find_circles,
    find_largest_arc,
    outermost,
    place,
)
from phongfit.calibration.highlights import find_highlights
from phongfit.calibration.matte import points_on, shaded_directions
from phongfit.calibration.outlines import View, seen, stretch
from phongfit.rendering.render import block_means

Kind = Literal["chrome", "matte"]
Outline = Float[np.ndarray, "3"]
Images = Sequence[Float[np.ndarray, "height width 3"]]

SEARCHED = 1000
"""Largest longer side of photographs in the search, pixels; larger ones are shrunk."""

SEEN = 0.85
"""Visible fraction of the arc of a sphere that is found, or placed without a look
around."""

LARGE_ENOUGH = 40
"""Smallest radius of an outline that is looked for in means of pixels, in their
sides."""

AROUND = 0.25
"""Largest distance, in radii, of an outline from the circle given for it."""

NOT_ROUND = {"chrome": (0.06, 0.06, 0.15), "matte": (0.06, 0.06, 0.08)}
"""Smallest errors of a sphere's circle, pixels: x, y and radius. Those of a mirror's
radius are larger, since its rim mirrors the background and has little contrast."""

NESTED = 0.9
"""Smallest radius of such an outline, in radii of the given circle: a chrome sphere
mirrors its surroundings as smaller circles."""


class Crop(NamedTuple):
    """A sphere with its surroundings.

    - `light`: in each photograph, linear.
    - `corner`: x and y of its upper left corner, pixels.
    """

    light: Float[np.ndarray, "count height width 3"]
    corner: Float[np.ndarray, "2"]

    @property
    def grey(self) -> Float[np.ndarray, "count height width"]:
        """The mean of the channels."""
        return self.light.mean(axis=-1)

    def within(self, outline: Outline) -> Outline:
        """An outline in the coordinates of the crop."""
        return outline - np.append(self.corner, 0)


def names_of(photographs: Images, names: Sequence[str] | None) -> tuple[str, ...]:
    """A name for each photograph: those given, or its number."""
    count = len(photographs)
    if count == 0:
        raise ValueError("photographs: expected at least one, got none")
    if names is None:
        return tuple(f"photograph {number}" for number in range(1, count + 1))
    if len(names) != count:
        raise ValueError(f"names: expected {count}, one a photograph, got {len(names)}")
    return tuple(names)


def looked_at(
    photographs: Images, names: Sequence[str]
) -> Iterator[Float[np.ndarray, "height width 3"]]:
    """The photographs one by one, after a check of their shapes.

    **Raises:** `ValueError` that names a photograph of another size than the first.
    """
    first: tuple[int, ...] = ()
    for image, name in zip(photographs, names, strict=True):
        shape = np.shape(image)
        if len(shape) != 3 or shape[2] != 3 or 0 in shape:
            raise ValueError(f"{name}: expected (height, width, 3), got {shape}")
        first = first or shape
        if shape != first:
            raise ValueError(
                f"{name}: expected {first[1]} × {first[0]} pixels, as {names[0]} has, "
                f"got {shape[1]} × {shape[0]}: the camera must stand still"
            )
        yield np.asarray(image)


def cut_out(
    photographs: Images,
    names: Sequence[str],
    outlines: Sequence[Outline],
    size: tuple[int, int],
) -> list[Crop]:
    """Crops of spheres with their surroundings; each photograph is read once.

    **Arguments:** `size`: height and width of the photographs.
    """
    height, width = size
    boxes = []
    for x, y, radius in outlines:
        margin = 1.2 * radius + 12
        left, top = max(int(x - margin), 0), max(int(y - margin), 0)
        right = min(int(x + margin) + 1, width)
        bottom = min(int(y + margin) + 1, height)
        boxes.append((left, top, right, bottom))
    crops: list[list[np.ndarray]] = [[] for _ in boxes]
    for image in looked_at(photographs, names):
        for crop, (left, top, right, bottom) in zip(crops, boxes, strict=True):
            crop.append(np.asarray(image[top:bottom, left:right], np.float32))
    return [
        Crop(np.stack(crop).astype(float), np.array(box[:2], float))
        for crop, box in zip(crops, boxes, strict=True)
    ]


def eye_error(radius: float) -> float:
    """Standard deviation of x, y and radius of a circle drawn by eye, in pixels.

    It is 1 % of the radius, and at least a pixel.
    """
    return max(1.0, 0.01 * radius)


def place_sphere(crop: Crop, outline: Outline, kind: Kind, view: View) -> Placed:
    """Move a sphere's circle onto the outline that is seen near it.

    Noise can hide the outline in pixels and not in means of several. A part of an
    outline does not place a circle better than the eye: if at least half is seen, it
    replaces circles that it contradicts; otherwise the circle is returned as it is.
    """
    near, longer = crop.within(outline), stretch(outline, view)
    eye = eye_error(outline[2])
    kept: Placed | None = None
    for size in (1, 2, 4):
        if size > 1 and outline[2] < LARGE_ENOUGH * size:
            break
        means = [block_means(image, size).mean(axis=-1) for image in crop.light]
        placed = _seen_near(np.stack(means), near / size, longer, kind)
        if placed.excess < EXCESS:
            continue
        moved = placed.outline * size + np.append(crop.corner, 0)
        spread = placed.covariance * size**2 + np.diag(NOT_ROUND[kind]) ** 2
        placed = placed._replace(outline=moved, covariance=spread)
        if placed.coverage >= SEEN:
            return placed
        if kept is None or placed.coverage > kept.coverage:
            kept = placed
    given = Placed(outline, eye**2 * np.eye(3), 0.0, 0.0)
    if kept is None:
        return given
    distance = np.abs(kept.outline - outline).max()
    if kept.coverage < SEEN_OF_BALL or distance < 2 * eye:
        return given._replace(coverage=kept.coverage)
    return kept._replace(covariance=kept.covariance + given.covariance)


def _seen_near(
    grey: Float[np.ndarray, "count height width"],
    circle: Outline,
    longer: Float[np.ndarray, "2"],
    kind: Kind,
) -> Placed:
    """The outline nearest to a circle; `longer` is its `stretch`."""
    placed = place(grey, circle, longer, mirrors=kind == "chrome")
    if placed.coverage < SEEN:
        others = [
            other
            for other in find_circles(grey)
            if other.coverage >= SEEN_OF_BALL
            and other.outline[2] > NESTED * circle[2]
            and np.abs(other.outline - circle).max() < AROUND * circle[2]
        ]
        if others:
            start = max(others, key=lambda other: other.arc).outline
            placed = place(grey, start, longer, mirrors=kind == "chrome")
    return placed


def _shrunk(
    photographs: Images, names: Sequence[str]
) -> tuple[Float[np.ndarray, "count height width"], int]:
    """Grey photographs of at most [`SEARCHED`][] pixels, and how often smaller."""
    shrink, small = 1, []
    for image in looked_at(photographs, names):
        shrink = max(1, -(-max(image.shape) // SEARCHED))
        small.append(block_means(image, shrink).mean(axis=-1))
    return np.stack(small), shrink


def find_spheres(
    photographs: Images, names: Sequence[str]
) -> list[tuple[Kind, Outline]]:
    """Search for spheres: round outlines whose inside looks like a sphere.

    A sphere is matte if Lambert's law explains its light, and chrome if it shows a
    compact highlight in nearly every photograph, which moves with the lamp.

    **Raises:** `ValueError` with the likeliest circles, if there is no sphere.
    """
    small, shrink = _shrunk(photographs, names)
    found = []
    circles = find_circles(small)
    for placed in outermost(c for c in circles if c.coverage >= SEEN):
        x, y, radius = placed.outline
        margin = int(radius) + 3
        left, top = max(int(x) - margin, 0), max(int(y) - margin, 0)
        part = small[:, top : int(y) + margin, left : int(x) + margin]
        inside = placed.outline - (left, top, 0)
        kind = _kind(part, inside)
        if kind is not None:
            found.append((kind, placed.outline * shrink))
    if not found:
        likely = [one.outline * shrink for one in outermost(circles)[:3]]
        words = " or ".join("{:.0f} {:.0f} {:.0f}".format(*one) for one in likely)
        raise ValueError(
            "chrome: no sphere is seen in the photographs; give its circle, x, y and "
            f"radius in pixels{words and f', perhaps {words}'}"
        )
    return found


def find_ball(photographs: Images, names: Sequence[str]) -> Outline | None:
    """The outline of the ball in photographs from one camera.

    Its kind is not determined, and its dark side need not be visible.

    **Returns:** x, y and radius in pixels from the upper left corner; `None` if no
    circle is clear enough.
    """
    small, shrink = _shrunk(photographs, names)
    found = find_largest_arc(small)
    return None if found is None else found.outline * shrink


def _kind(
    light: Float[np.ndarray, "count height width"], outline: Outline
) -> Kind | None:
    if _lambertian(light, outline) > 0.9:
        return "matte"
    still = light.min(axis=0)
    # The likeliest highlight of each; it must be small and move between photographs.
    best = [find_highlights(one, outline, still)[:1] for one in light]
    small = [h for found in best for h in found if h.size < 0.15 * outline[2]]
    if len(small) < 0.7 * len(light):
        return None
    spread = np.std([h.pixel for h in small], axis=0).max()
    return "chrome" if spread > 0.05 * outline[2] or len(light) < 3 else None


def _lambertian(
    light: Float[np.ndarray, "count height width"], outline: Outline
) -> float:
    """Fraction of the variance on a disk that Lambert's law with one lamp explains."""
    view = View(light.shape[2], light.shape[1])
    points = points_on(light[..., None], np.zeros(2), outline)
    normals = seen(points.pixel, outline, view, 1.0).normal
    directions = shaded_directions(points, normals)
    explained, total = 0.0, 1e-12
    for one, direction in zip(points.light[..., 0], directions, strict=True):
        model = np.maximum(normals @ direction, 0)
        columns = np.stack([model, np.ones_like(model)], 1)
        rest = one - columns @ np.linalg.lstsq(columns, one, rcond=None)[0]
        total += np.sum((one - one.mean()) ** 2)
        explained += np.sum((one - one.mean()) ** 2) - np.sum(rest**2)
    return explained / total
