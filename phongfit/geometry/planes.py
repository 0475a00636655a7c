"""A plane perpendicular to a camera's axis, in place of an unknown surface."""

from typing import Any

import numpy as np

from phongfit.geometry.cameras import AbstractCamera, OrthographicCamera
from phongfit.geometry.surfaces import NormalMap


def plane_before(camera: AbstractCamera, through: Any = None) -> NormalMap:
    """A plane perpendicular to the camera's axis, seen by every pixel.

    **Arguments:** `through`: a point of it, world units. Default: 1 in front of a
    pinhole; the origin for parallel rays.
    """
    rays = camera.rays()
    axis = np.asarray(camera.rotation)[:, 2]
    origin, direction = np.asarray(rays.origin), np.asarray(rays.direction)
    if through is not None:
        point = np.asarray(through)
    elif isinstance(camera, OrthographicCamera):
        point = np.zeros(3)
    else:
        point = np.asarray(camera.position) - axis
    along = ((point - origin) @ axis) / (direction @ axis)
    places = origin + along[..., None] * direction
    return NormalMap(np.broadcast_to(axis, places.shape), positions=places)
