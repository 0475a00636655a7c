"""Pixels as the vertices of a surface: triangles between neighbours."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from phongfit.geometry.cameras import Ray
from phongfit.geometry.raytracing import blocked

LIFT = 0.5
"""Offset of a shadow ray's start towards the light, in distances between pixels.

So the triangles around its own pixel do not block the ray."""


def grid_faces(height: int, width: int) -> Int[np.ndarray, "faces 3"]:
    """Two triangles between every four neighbouring pixels.

    Their common side runs from the upper left to the lower right pixel.

    **Returns:** flat indices (row · width + column) of the corners, counter-clockwise
    in an image with row 0 at the top.
    """
    index = np.arange(height * width).reshape(height, width)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    halves = ((a, b, c), (a, c, d))
    return np.concatenate([np.stack(half, -1).reshape(-1, 3) for half in halves])


def faces_within(mask: Bool[np.ndarray, "height width"]) -> Int[np.ndarray, "faces 3"]:
    """Faces of a pixel grid whose corners all lie inside the mask."""
    faces = grid_faces(*mask.shape)
    return faces[mask.ravel()[faces].all(axis=1)]


class Triangles(NamedTuple):
    """Triangles between neighbouring pixels, which cast shadows.

    - `vertices`: the points of all pixels, world units.
    - `faces`: indices of the triangles' corners.
    - `lift`: offset of a shadow ray's start towards the light, world units.
    """

    vertices: Float[Array, "pixels 3"]
    faces: Int[Array, "faces 3"]
    lift: Float[Array, ""]

    def shadowed(
        self,
        start: Float[Any, "*batch 3"],
        to_light: Float[Array, "*batch 3"],
        distance: Float[Array, "*batch"],
    ) -> Bool[Array, "*batch"]:
        """Whether triangles block the light on its way to points of the surface.

        **Arguments:** `start`: the points; `to_light`: unit vectors to the light;
        `distance`: how far away it is (may be inf), world units.
        """
        if not len(self.faces):
            return jnp.zeros(distance.shape, bool)
        rays = Ray(jnp.asarray(start) + self.lift * to_light, to_light)
        return blocked(self.vertices, self.faces, rays, distance - self.lift)


def triangles(
    positions: Float[Any, "height width 3"], mask: Bool[Any, "height width"]
) -> Triangles:
    """The triangles between pixels inside a mask.

    **Arguments:** `positions`: the point that each pixel sees, world units.
    """
    if isinstance(mask, Tracer):
        # The number of faces must not depend on a traced mask: faces outside of it
        # become a single point, which no ray meets.
        every = grid_faces(*mask.shape)
        faces = jnp.where(mask.ravel()[every].all(axis=1)[:, None], every, 0)
    else:
        faces = jnp.asarray(faces_within(np.asarray(mask)), jnp.int32)
    points, inside = jnp.asarray(positions), jnp.asarray(mask)
    return Triangles(points.reshape(-1, 3), faces, LIFT * pixel_size(points, inside))


def pixel_size(
    points: Float[Array, "height width 3"], mask: Bool[Array, "height width"]
) -> Float[Array, ""]:
    """Approximate distance between the points of neighbouring pixels, world units.

    The diagonal of the box around all points inside the mask, over that in pixels; 1
    if the mask is empty.
    """
    height, width = mask.shape
    rows, columns = jnp.indices((height, width))

    def span(values: Array, inside: Array) -> Array:
        high = jnp.max(jnp.where(inside, values, -jnp.inf), axis=(0, 1))
        return high - jnp.min(jnp.where(inside, values, jnp.inf), axis=(0, 1))

    across = jnp.linalg.norm(span(points, mask[..., None]))
    indices = jnp.stack([rows, columns], axis=-1).astype(points.dtype)
    pixels = jnp.linalg.norm(span(indices, mask[..., None]))
    return jnp.where(mask.any(), across / jnp.maximum(pixels, 1), 1)
