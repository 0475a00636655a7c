"""Pixels as the vertices of a surface: triangles between neighbours."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from phongfit.geometry.cameras import Ray
from phongfit.geometry.raytracing import blocked

LIFT = 0.5
"""How far from its pixel a shadow's ray starts, in pixels: past its own triangles."""


def grid_faces(height: int, width: int) -> Int[np.ndarray, "faces 3"]:
    """Two triangles between every four neighbours, by the pixels' flat indices.

    Their common side runs from the upper left to the lower right.
    """
    at = np.arange(height * width).reshape(height, width)
    a, b, c, d = at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]
    halves = ((a, b, c), (a, c, d))
    return np.concatenate([np.stack(half, -1).reshape(-1, 3) for half in halves])


def faces_within(mask: Bool[np.ndarray, "height width"]) -> Int[np.ndarray, "faces 3"]:
    """Those of all whose corners lie inside the mask."""
    faces = grid_faces(*mask.shape)
    return faces[mask.ravel()[faces].all(axis=1)]


def in_shadow(
    positions: Float[Any, "height width 3"],
    mask: Bool[Any, "height width"],
    start: Float[Any, "*batch 3"],
    to_light: Float[Any, "*batch 3"],
    distance: Float[Any, "*batch"],
) -> Bool[Array, "*batch"]:
    """Whether the triangles between pixels lie on the way from points of them to light.

    **Arguments:**

    - `positions`, `mask`: where pixels' points are, world units, and which have one.
    - `start`, `to_light`, `distance`: points of the surface, unit vectors to the light,
        and how far away it is (may be inf).
    """
    positions, mask = jnp.asarray(positions), jnp.asarray(mask)
    faces = grid_faces(*mask.shape)
    whole = mask.ravel()[faces].all(axis=1)
    # Of no size, which no ray meets: as many faces whatever the mask.
    faces = jnp.where(whole[:, None], faces, 0)
    lift = LIFT * pixel_size(positions, mask)
    rays = Ray(jnp.asarray(start) + lift * to_light, to_light)
    return blocked(positions.reshape(-1, 3), faces, rays, distance - lift)


def pixel_size(
    positions: Float[Any, "height width 3"], mask: Bool[Any, "height width"]
) -> Float[Array, ""]:
    """About how far apart neighbours are, as the camera sees them; world units."""
    height, width = mask.shape
    rows, columns = jnp.indices((height, width))
    points, mask = jnp.asarray(positions), jnp.asarray(mask)

    def span(values: Array, inside: Array) -> Array:
        high = jnp.max(jnp.where(inside, values, -jnp.inf), axis=(0, 1))
        return high - jnp.min(jnp.where(inside, values, jnp.inf), axis=(0, 1))

    across = jnp.linalg.norm(span(points, mask[..., None]))
    where = jnp.stack([rows, columns], axis=-1).astype(points.dtype)
    pixels = jnp.linalg.norm(span(where, mask[..., None]))
    return jnp.where(mask.any(), across / jnp.maximum(pixels, 1), 1)
