"""Spheres by their outlines: from a circle in an image to a sphere before the camera.

Coordinates are those of the calibrating camera, which stands at the origin: x right, y
up, z back to the viewer. Seen by a pinhole, a sphere's outline is an ellipse, slightly
elongated away from the image's centre; its outline `(x, y, radius)` is the circle with
the ellipse's centre and area, pixels from the upper left corner.

Functions of vectors broadcast over leading axes, for arrays of NumPy or JAX.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from phongfit.edge import shown
from phongfit.rendering.jpeg import namespace

SMALLEST = 5.0
"""Smallest radius of a sphere, pixels."""

SLACK = 2.0
"""Tolerance of given circles: a sphere may extend this far beyond the image, pixels."""

# Arrays of NumPy or JAX.
Vectors = Any
Pixels = Any
Outlines = Any


@dataclass(frozen=True)
class View:
    """The camera of a calibration: its size and its angle of view.

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
    xp, squared = namespace(vectors), dots(vectors, vectors)
    return vectors / xp.sqrt(xp.where(squared > 0, squared, 1))


def dots(a: Vectors, b: Vectors) -> Any:
    """Scalar products along the last axis, which stays."""
    return (a * b).sum(axis=-1, keepdims=True)


def sphere_behind(outline: Outlines, view: View, radius: float) -> Vectors:
    r"""Centre of the sphere of a known radius behind an outline, in the radius' unit.

    For a pinhole, the rays that touch the sphere form a cone of half-angle α about an
    axis at the angle θ from the optical axis. On the image plane at distance 1 it is an
    ellipse with centre and semi-axes

    $$ρ = \frac{\sin θ \cos θ}{\cos^2 θ - \sin^2 α},\quad
       a = \frac{\sin α \cos α}{\cos^2 θ - \sin^2 α},\quad
       b = \frac{\sin α}{\sqrt{\cos^2 θ - \sin^2 α}},$$

    which is solved for θ and α by steps of a contraction; then $|c| = r / \sin α$.

    For parallel rays the centre lies in the plane z = 0.

    **Arguments:** `outline`: x, y and radius in pixels, (..., 3).
    """
    xp = namespace(outline)
    across = (outline[..., :2] - view.centre) * np.array([1.0, -1.0])
    if view.focal is None:
        place = across * (radius / outline[..., 2:])
        return xp.concatenate([place, 0 * place[..., :1]], axis=-1)
    across = across / view.focal
    squared, size = dots(across, across), outline[..., 2:] / view.focal

    def closer(_: Any, at: Any) -> Any:
        """The next cos²θ, sin²α and shift of the axis: an error falls by sin²α."""
        cos2, sin2, _ = at
        room = xp.maximum(cos2 - sin2, 1e-6)
        shrink = room / cos2
        cos2 = 1 / (1 + squared * shrink**2)
        return cos2, xp.minimum(size**2 * room**1.5 / xp.sqrt(1 - sin2), 0.5), shrink

    at = 1 / (1 + squared), xp.minimum(size**2, 0.5), xp.ones_like(size)
    if xp is np:
        for step in range(20):
            at = closer(step, at)
    else:
        # An unrolled loop would take seconds to compile.
        at = jax.lax.fori_loop(0, 20, closer, at)
    _, sin2, shrink = at
    axis = xp.concatenate([across * shrink, -xp.ones_like(size)], axis=-1)
    return unit(axis) * radius / xp.sqrt(sin2)


def stretch(outline: Float[np.ndarray, "3"], view: View) -> Float[np.ndarray, "2"]:
    """Elongation of an outline: a vector along its longer axis.

    In pixels' axes (x right, y down), of length a / b − 1; 0 for a circle.
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
    """A given circle, checked: x, y and radius in pixels, wholly in the photograph.

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
    """Points of a sphere that pixels see; outside the outline, those of the rim.

    Unit vectors `normal` and `to_viewer` belong to each point.
    """

    position: Vectors
    normal: Vectors
    to_viewer: Vectors


def seen(pixel: Pixels, outline: Outlines, view: View, radius: float) -> Seen:
    """The points that pixels see on the sphere behind an outline.

    **Arguments:**

    - `pixel`: image points, pixels from the upper left corner.
    - `outline`, `radius`: as in [`sphere_behind`][].
    """
    xp, centre = namespace(outline), sphere_behind(outline, view, radius)
    across = (pixel - view.centre) * np.array([1.0, -1.0])
    back = xp.ones_like(across[..., :1])
    if view.focal is None:
        # The sphere's radius in pixels determines the size of a pixel.
        place = across * (radius / outline[..., 2:])
        origin = xp.concatenate([place, 0 * back], axis=-1)
        direction = xp.concatenate([0 * across, -back], axis=-1)
    else:
        origin = np.zeros(3)
        direction = unit(xp.concatenate([across / view.focal, -back], axis=-1))
    offset = origin - centre
    nearest = offset - dots(offset, direction) * direction
    squared = radius**2 - dots(nearest, nearest)
    # Double where: the root has an infinite slope at the rim.
    depth = xp.where(squared > 0, xp.sqrt(xp.where(squared > 0, squared, 1)), 0)
    normal = unit(nearest - depth * direction)
    return Seen(
        centre + radius * normal, normal, xp.broadcast_to(-direction, normal.shape)
    )


class Ray(NamedTuple):
    """A ray from a sphere's surface to the mirrored object, with a unit direction."""

    position: Vectors
    direction: Vectors


def mirrored(pixel: Pixels, outline: Outlines, view: View, radius: float) -> Ray:
    r"""The rays that a chrome sphere mirrors into pixels: $s = 2 (n \cdot v) n - v$.

    **Arguments:** as in [`seen`][].
    """
    at = seen(pixel, outline, view, radius)
    back = 2 * dots(at.normal, at.to_viewer) * at.normal - at.to_viewer
    return Ray(at.position, back)
