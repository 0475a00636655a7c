"""A height for every pixel: points, triangles, and the shadows that they throw."""

import dataclasses
from collections.abc import Iterable, Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from phongfit.checks import as_array
from phongfit.edge import checked
from phongfit.geometry.cameras import AbstractCamera
from phongfit.geometry.grids import faces_within, triangles
from phongfit.geometry.meshes import Mesh
from phongfit.geometry.tracing import towards
from phongfit.lights import AbstractLight

CENTRES = ((0, 0),)
CORNERS = ((-1, -1), (1, -1), (-1, 1), (1, 1))
"""Points of a pixel that are tested for shadow: its centre, or four around it.

By their offsets (right, down) from the centre, in quarters of a pixel."""


@dataclasses.dataclass(frozen=True, repr=False)
class HeightField:
    """A surface as a height for every pixel of a camera, in arrays of NumPy.

    **Fields:**

    - `height`: (H, W), the coordinate of the surface along the camera's z axis, which
        points from the scene to the camera: 0 at the world's origin, world units; NaN
        outside.
    - `pieces`: (H, W), number of the mask's connected piece, from 1 on; 0 outside.
    - `camera`: the camera of these pixels.
    - `warnings`: what the normals do not determine, and what to try.
    """

    height: Float[np.ndarray, "height width"]
    pieces: Int[np.ndarray, "height width"]
    camera: AbstractCamera
    warnings: tuple[str, ...] = ()

    @property
    def mask(self) -> Bool[np.ndarray, "height width"]:
        """Pixels that have a height."""
        return np.isfinite(self.height)

    def positions(self) -> Float[np.ndarray, "height width 3"]:
        """Points of the surface in the world's axes, world units; 0 outside."""
        return positions_at(self.height, self.camera)

    def mesh(self) -> Mesh:
        """A mesh with two triangles, facing the camera, for each 2 × 2 pixels.

        Triangles with a corner outside the mask are left out.

        **Raises:** `ValueError` if no triangle has its corners in the mask.
        """
        faces = faces_within(self.mask)
        if not len(faces):
            raise ValueError("height: expected neighbouring pixels, got none")
        used, renumbered = np.unique(faces, return_inverse=True)
        return Mesh(self.positions().reshape(-1, 3)[used], renumbered.reshape(-1, 3))

    def __str__(self) -> str:
        height, width = self.height.shape
        known = self.height[self.mask]
        count = int(self.pieces.max(initial=0))
        lines = [
            f"phongfit: heights of {height} × {width} pixels, {known.size:,} in "
            f"{count} piece{'' if count == 1 else 's'}"
        ]
        if known.size:
            lines.append(f"  from {known.min():.4g} to {known.max():.4g} world units")
        return "\n".join([*lines, *(f"  warning: {words}" for words in self.warnings)])

    def __repr__(self) -> str:
        return str(self)


def positions_at(
    height: Float[np.ndarray, "height width"], camera: AbstractCamera
) -> Float[np.ndarray, "height width 3"]:
    """Points that pixels see at given heights, in the world's axes; 0 for NaN.

    **Arguments:** `height`: as in [`HeightField`][], world units.
    """
    # Heights are along the camera's z axis, the third column of its rotation.
    rays, axis = camera.rays(), np.asarray(camera.rotation, float)[:, 2]
    origin, direction = (np.asarray(a, float) for a in (rays.origin, rays.direction))
    along = (height - origin @ axis) / (direction @ axis)
    points = origin + along[..., None] * direction
    return np.where(np.isfinite(height)[..., None], points, 0)


@checked
def cast_shadows(
    height: Float[np.ndarray, "height width"],
    camera: AbstractCamera,
    lights: Iterable[AbstractLight],
) -> Bool[np.ndarray, "lights height width"]:
    """Pixels in cast shadow, where the surface itself blocks the light.

    Attached shadow, where the surface faces away from the light (n·l ≤ 0), is not
    included.

    **Arguments:**

    - `height`: (H, W), as in [`HeightField`][]: NaN outside, where nothing casts
        shadows.
    - `camera`: the camera of these pixels.
    - `lights`: lights with a direction, distant or near.

    **Returns:** for each light, true in its shadow; false outside.

    **Raises:** `ValueError` that names the argument.
    """
    height = as_map("height", height, (camera.height, camera.width)).astype(float)
    fractions = shadow_shares(height, camera, lights, CENTRES)
    shadows = [fraction > 0.5 for fraction in fractions]
    return np.stack(shadows) if shadows else np.zeros((0, *height.shape), bool)


def shadow_shares(
    height: Float[np.ndarray, "height width"],
    camera: AbstractCamera,
    lights: Iterable[AbstractLight],
    places: tuple[tuple[int, int], ...] = CORNERS,
) -> Iterator[Float[np.ndarray, "height width"]]:
    """Fraction of each pixel that lies in cast shadow, for one light after the other.

    **Arguments:** as in [`cast_shadows`][]; `places`: points of a pixel that are
    tested, by their offsets (right, down) in quarters of a pixel.

    **Returns:** numbers in [0, 1]; 0 outside.
    """
    mask, points = np.isfinite(height), positions_at(height, camera)
    surface = triangles(points, mask)
    starts = np.stack([_offset_points(points, mask, place)[mask] for place in places])
    for light in lights:
        fraction = np.zeros(height.shape)
        if mask.any():
            to_light, distance = towards(light, jnp.asarray(starts))
            hit = surface.shadowed(starts, to_light, distance)
            fraction[mask] = np.asarray(hit).mean(axis=0)
        yield fraction


def as_map(name: str, value: Any, size: tuple[int, ...]) -> np.ndarray:
    """`value` as an array of numbers, one for each pixel; `ValueError` names `name`."""
    array = as_array(name, value)
    if array.shape != size or array.dtype.kind not in "bfiu":
        raise ValueError(
            f"{name}: expected numbers of shape {size}, one a pixel, got "
            f"{array.dtype} of shape {array.shape}"
        )
    return array


def _offset_points(
    points: Float[np.ndarray, "height width 3"],
    mask: Bool[np.ndarray, "height width"],
    offset: tuple[int, int],
) -> Float[np.ndarray, "height width 3"]:
    """Points of the triangles between pixels, a quarter of a pixel beside each pixel.

    A neighbour outside the mask counts as if it had the pixel's own point.

    **Arguments:** `offset`: (right, down), each −1 or 1, or (0, 0) for the pixels'
    own points.
    """
    right, down = offset
    if not right and not down:
        return points
    x, y = _neighbour(points, mask, right, 0), _neighbour(points, mask, 0, down)
    if right == down:
        # On the side that the two triangles share.
        return points + 0.25 * (_neighbour(points, mask, right, down) - points)
    return points + 0.25 * (x - points) + 0.25 * (y - points)


def _neighbour(
    points: np.ndarray, mask: np.ndarray, right: int, down: int
) -> np.ndarray:
    """The point of each pixel's neighbour; its own where there is none.

    **Arguments:** `right`, `down`: steps to the neighbour in pixels, −1, 0 or 1.
    """
    padded = np.pad(points, ((1, 1), (1, 1), (0, 0)), mode="edge")
    has_point = np.pad(mask, 1)
    height, width = mask.shape
    at = np.s_[1 + down : 1 + down + height, 1 + right : 1 + right + width]
    return np.where(has_point[at][..., None], padded[at], points)
