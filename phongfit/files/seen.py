"""The surface before a camera: a ball from its circle, or a surface from its normals.

If normals are to be fitted, the surface is a plane.
"""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from phongfit.calibration.outlines import View, as_circle, sphere_behind
from phongfit.calibration.result import Calibration
from phongfit.files.arrays import read_array, unpack
from phongfit.files.inputs import naming, read_bytes
from phongfit.geometry.cameras import (
    AbstractCamera,
    OrthographicCamera,
    PerspectiveCamera,
)
from phongfit.geometry.planes import plane_before
from phongfit.geometry.surfaces import AbstractSurface, NormalMap, Sphere

SOUGHT = "fit"
"""Value in place of a file of normals, if normals are to be fitted."""

OFF = 0.03
"""Largest mean distance of positions from their pixels' rays, relative to the
surface's size."""


def seen_in(
    height: int,
    width: int,
    calibration: Calibration | None,
    sphere: Sequence[float] | None,
    normals: str | os.PathLike[str] | None,
    fov: float | None = None,
) -> tuple[AbstractCamera, AbstractSurface]:
    """The camera of photographs, and the surface before it, in the camera's axes.

    Without a calibration a ball's radius is the unit of length. The camera then has
    parallel rays, and a ball's centre lies in the plane z = 0; or, with `fov`, the
    camera is a pinhole at the origin, with `fov` degrees from the lower to the upper
    edge, and normals without positions lie on a plane.

    If normals are to be fitted, the surface is a plane perpendicular to the camera's
    axis: through the calibration's reference point, or at distance 1.

    **Arguments:** one of `sphere` and `normals`, as in [`open_captured`][].

    **Raises:** `ValueError` that names the file or the argument.
    """
    camera = camera_of(height, width, calibration, fov)
    view = View(width, height, fov or None) if calibration is None else calibration.view
    if normals == SOUGHT:
        camera = camera or OrthographicCamera(width, height)
        through = None if calibration is None else calibration.reference
        return camera, plane_before(camera, through)
    if normals is not None:
        surface = read_normals(Path(normals))
        if tuple(surface.mask.shape) != (height, width):
            raise ValueError(
                f"{normals}: expected {width} × {height} normals, as the photographs "
                f"have pixels, got {surface.mask.shape[1]} × {surface.mask.shape[0]}"
            )
        if surface.positions is None and calibration is None and camera is not None:
            # A plane is accurate if the camera is much further away than the object's
            # depth.
            places = plane_before(camera).positions
            return camera, NormalMap(surface.normals, surface.mask, places)
        if surface.positions is None or camera is None:
            # Assume a long lens: other cameras need positions.
            return OrthographicCamera(width, height), surface
        _check_positions(str(normals), surface, camera)
        return camera, surface
    assert sphere is not None
    circle = as_circle("sphere", sphere, view)
    if calibration is not None:
        return calibration.camera, _ball(calibration, circle)
    if camera is None:
        camera = OrthographicCamera(width, height, view_height=height / circle[2])
    # Adding 0 turns −0 into 0, which reads better in a scene file.
    return camera, Sphere(sphere_behind(circle, view, 1.0) + 0.0, 1.0)


def camera_of(
    height: int, width: int, calibration: Calibration | None, fov: float | None
) -> AbstractCamera | None:
    """The camera of photographs, from a calibration or `fov`; else `None`.

    **Raises:** `ValueError` that names the argument.
    """
    if calibration is None:
        if fov is None or fov == 0:
            return None
        if not 0 < fov < 180:
            raise ValueError(f"fov: expected degrees ≥ 0 and < 180, got {fov:g}")
        return PerspectiveCamera(width, height, fov_y=fov, position=(0, 0, 0))
    if fov is not None:
        raise ValueError("fov: expected none, since the calibration has the camera")
    view, depth = calibration.view, calibration.reference[2]
    if (view.height, view.width) != (height, width):
        raise ValueError(
            f"lights: expected a calibration of {width} × {height} pixels, as the "
            f"photographs have, got {view.width} × {view.height}"
        )
    if view.focal is not None and not depth < 0:
        raise ValueError(
            "lights: expected a calibration whose reference point lies before the "
            f"camera, at z < 0, got z = {depth:g}"
        )
    return calibration.camera


def _check_positions(name: str, surface: NormalMap, camera: AbstractCamera) -> None:
    """Check that the camera sees positions in their pixels.

    **Raises:** `ValueError` that names the file.
    """
    there = np.flatnonzero(np.asarray(surface.mask))
    if not len(there):
        return
    # About a thousand positions are enough.
    some = there[:: max(len(there) // 1000, 1)]
    rays = camera.rays()
    origin, direction, places = (
        np.asarray(part, float).reshape(-1, 3)[some]
        for part in (rays.origin, rays.direction, surface.positions)
    )
    off = np.linalg.norm(np.cross(places - origin, direction), axis=1).mean()
    size = np.linalg.norm(places - places.mean(axis=0), axis=1).mean()
    if off > OFF * size:
        raise ValueError(
            f"{name}: expected positions in the axes of the calibration, whose camera "
            "stands at the origin and looks along −z, got some that it does not see in "
            "their pixels"
        )


def _ball(calibration: Calibration, circle: Float[np.ndarray, "3"]) -> Sphere:
    """The ball behind a circle, at the depth of the calibration's reference point."""
    view: View = calibration.view
    if view.focal is None:
        assert calibration.view_height is not None
        radius = circle[2] * calibration.view_height / view.height
        return Sphere(sphere_behind(circle, view, radius), radius)
    centre = sphere_behind(circle, view, 1.0)
    radius = calibration.reference[2] / centre[2]
    return Sphere(centre * radius, radius)


def read_normals(path: Path) -> NormalMap:
    """A surface from a file of normals, with its positions and mask if it has them.

    **Raises:** `ValueError` that names the file.
    """
    normals = read_array(path, "normals")
    others = {} if path.suffix.lower() == ".npy" else unpack(read_bytes(path))
    with naming(str(path)):
        if normals.ndim != 3 or normals.shape[-1] != 3:
            raise ValueError(
                f"normals: expected (height, width, 3), got {normals.shape}"
            )
        there = np.any(normals != 0, axis=-1)
        return NormalMap(normals, others.get("mask", there), others.get("positions"))
