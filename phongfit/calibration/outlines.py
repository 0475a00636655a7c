"""Spheres by their outlines: from a circle in an image to a sphere before the camera.

The calibrating camera stands at the origin of its own axes: x right, y up, z back to
the viewer. Seen by a pinhole, a sphere's outline is an ellipse, a little longer away
from the image's centre; by its outline `(x, y, radius)` is meant the circle with the
ellipse's centre and area, pixels from the upper left corner.

All functions broadcast over leading axes, in NumPy and double precision: a calibration
has few numbers, and compiling would take longer than all of it.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from phongfit.edge import shown

SMALLEST = 5.0
"""Of the radii of spheres that can be looked at, pixels."""

SLACK = 2.0
"""A sphere that touches the edge may reach so far beyond it, as circles are given."""

Vectors = Float[np.ndarray, "... 3"]
Pixels = Float[np.ndarray, "... 2"]
Outlines = Float[np.ndarray, "... 3"]


@dataclass(frozen=True)
class View:
    """A camera by what calibration needs of it.

    - `width`, `height`: of the photographs, pixels; the principal point is in the
        middle.
    - `fov_y`: angle from the lower to the upper edge, degrees; `None` for parallel
        rays.
    """

    width: int
    height: int
    fov_y: float | None = None

    @property
    def centre(self) -> Float[np.ndarray, "2"]:
        """The principal point, pixels from the upper left corner."""
        return np.array([self.width / 2, self.height / 2])

    @property
    def focal(self) -> float | None:
        """Focal length in pixels; `None` for parallel rays."""
        if self.fov_y is None:
            return None
        return float(self.height / 2 / np.tan(np.radians(self.fov_y) / 2))


def unit(vectors: Vectors) -> Vectors:
    """Vectors of length 1; a zero vector stays zero."""
    length = np.sqrt(dots(vectors, vectors))
    return vectors / np.where(length > 0, length, 1)


def dots(a: Vectors, b: Vectors) -> Float[np.ndarray, "... 1"]:
    """Scalar products along the last axis, which stays."""
    return np.vecdot(a, b)[..., None]


def sphere_behind(outline: Outlines, view: View, radius: float) -> Vectors:
    r"""Centre of the sphere of a known radius behind an outline, in the radius' unit.

    For a pinhole, the rays that touch the sphere form a cone of half-angle α about an
    axis at the angle θ from the optical axis. On the image plane at distance 1 it is an
    ellipse with centre and semi-axes

    $$ρ = \frac{\sin θ \cos θ}{\cos^2 θ - \sin^2 α},\quad
       a = \frac{\sin α \cos α}{\cos^2 θ - \sin^2 α},\quad
       b = \frac{\sin α}{\sqrt{\cos^2 θ - \sin^2 α}},$$

    which is solved for θ and α by a few steps of a contraction; then
    $|c| = r / \sin α$.

    For parallel rays the centre lies in the plane z = 0.
    """
    across = (outline[..., :2] - view.centre) * (1, -1)
    if view.focal is None:
        place = across * (radius / outline[..., 2:])
        return np.concatenate([place, 0 * place[..., :1]], axis=-1)
    across = across / view.focal
    distance = np.linalg.norm(across, axis=-1, keepdims=True)
    size = outline[..., 2:] / view.focal
    shrink = np.ones_like(distance)
    cos2, sin2 = 1 / (1 + distance**2), np.minimum(size**2, 0.5)
    for _ in range(20):
        before, room = shrink, np.maximum(cos2 - sin2, 1e-6)
        shrink = room / cos2
        cos2 = 1 / (1 + (distance * shrink) ** 2)
        sin2 = np.minimum(size**2 * room**1.5 / np.sqrt(1 - sin2), 0.5)
        if np.all(np.abs(shrink - before) < 1e-15):
            break
    axis = np.concatenate([across * shrink, -np.ones_like(distance)], axis=-1)
    return unit(axis) * radius / np.sqrt(sin2)


def stretch(outline: Float[np.ndarray, "3"], view: View) -> Float[np.ndarray, "2"]:
    """How much longer than wide an outline is, as a vector along its longer axis.

    In pixels' axes (x right, y down): 0 for a circle, of length a / b − 1 else.
    """
    if view.focal is None:
        return np.zeros(2)
    centre = sphere_behind(outline, view, 1.0)
    sin2 = 1 / np.sum(centre**2)
    cos2 = centre[2] ** 2 * sin2
    away = outline[:2] - view.centre
    length = np.hypot(*away)
    ratio = np.sqrt((1 - sin2) / (cos2 - sin2))
    return (ratio - 1) * away / length if length > 0 else np.zeros(2)


def as_circle(
    name: str, value: Any, view: View, *, least: float = 0.0
) -> Float[np.ndarray, "3"]:
    """A circle that was given: x, y and radius in pixels, wholly in the photograph.

    **Arguments:** `least`: the smallest radius that is accepted.

    **Raises:** `ValueError` that names the argument.
    """
    try:
        circle = np.array(value, float)
    except (TypeError, ValueError):
        circle = np.zeros(0)
    if circle.shape != (3,) or not np.isfinite(circle).all() or circle[2] <= 0:
        raise ValueError(
            f"{name}: expected x, y and radius in pixels, got {shown(value)}"
        )
    x, y, radius = circle
    if radius < least:
        raise ValueError(
            f"{name}: expected a radius of at least {least:g} pixels, got {radius:g}"
        )
    reach = radius - SLACK
    if not (reach < x < view.width - reach and reach < y < view.height - reach):
        raise ValueError(
            f"{name}: expected a sphere that lies wholly in the {view.width} × "
            f"{view.height} pixels of the photographs, got x {x:g}, y {y:g}, radius "
            f"{radius:g}"
        )
    return circle


class Seen(NamedTuple):
    """Points of a sphere that pixels see; past the outline, the rim's nearest."""

    position: Vectors
    normal: Vectors
    to_viewer: Vectors


def seen(pixel: Pixels, outline: Outlines, view: View, radius: float) -> Seen:
    """What image points see of the sphere behind an outline.

    **Arguments:**

    - `pixel`: image points, pixels from the upper left corner.
    - `outline`, `radius`: as of [`sphere_behind`][].
    """
    centre = sphere_behind(outline, view, radius)
    across = (pixel - view.centre) * (1, -1)
    back = np.ones_like(across[..., :1])
    if view.focal is None:
        # A pixel has the size that the sphere's radius gives it.
        place = across * (radius / outline[..., 2:])
        origin = np.concatenate([place, 0 * back], axis=-1)
        direction = np.concatenate([0 * across, -back], axis=-1)
    else:
        origin = np.zeros(3)
        direction = unit(np.concatenate([across / view.focal, -back], axis=-1))
    offset = origin - centre
    nearest = offset - dots(offset, direction) * direction
    squared = radius**2 - dots(nearest, nearest)
    normal = unit(nearest - np.sqrt(np.maximum(squared, 0)) * direction)
    return Seen(
        centre + radius * normal, normal, np.broadcast_to(-direction, normal.shape)
    )


class Ray(NamedTuple):
    """From a sphere's surface to what is mirrored there, along unit vectors."""

    position: Vectors
    direction: Vectors


def mirrored(pixel: Pixels, outline: Outlines, view: View, radius: float) -> Ray:
    r"""Where what pixels see in a chrome sphere lies: $s = 2 (n \cdot v) n - v$.

    **Arguments:** as of [`seen`][].
    """
    at = seen(pixel, outline, view, radius)
    back = 2 * dots(at.normal, at.to_viewer) * at.normal - at.to_viewer
    return Ray(at.position, back)


def across(direction: Vectors) -> Float[np.ndarray, "... 2 3"]:
    """Two unit vectors across each unit vector."""
    # From the axis that is farthest from it.
    axis = np.eye(3)[np.argmin(np.abs(direction), axis=-1)]
    first = unit(np.cross(axis, direction))
    return np.stack([first, np.cross(direction, first)], axis=-2)
