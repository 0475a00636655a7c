"""A plane perpendicular to a camera's axis, in place of an unknown surface."""

from typing import Any

import numpy as np

from phongfit.geometry.cameras import AbstractCamera
from phongfit.geometry.height import positions_at
from phongfit.geometry.surfaces import NormalMap


def plane_before(camera: AbstractCamera, through: Any = None) -> NormalMap:
    """A plane perpendicular to the camera's axis, seen by every pixel.

    **Arguments:** `through`: a point of it, world units. Default: the origin for
    parallel rays; for other cameras a point 1 in front of their position.
    """
    # The camera's z axis, which points from the scene to the camera.
    axis = np.asarray(camera.rotation)[:, 2]
    if through is not None:
        point = np.asarray(through)
    elif camera.parallel:
        point = np.zeros(3)
    else:
        point = np.asarray(camera.position) - axis
    height = np.full((camera.height, camera.width), point @ axis)
    positions = positions_at(height, camera)
    return NormalMap(np.broadcast_to(axis, positions.shape), positions=positions)
