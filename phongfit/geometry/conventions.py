"""Conversion of cameras from and to the conventions of other programs.

All conventions are right-handed. They differ in where a camera's x, y and z axes point:
see [`AXES`][]. The world's axes are the same in all.
"""

from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from phongfit.checks import as_array
from phongfit.edge import checked, shown
from phongfit.geometry.cameras import AbstractCamera, PinholeCamera
from phongfit.geometry.distortion import (
    AbstractDistortion,
    BrownDistortion,
    FisheyeDistortion,
)

Axes = Literal[
    "phongfit", "opengl", "nerf", "blender", "opencv", "colmap", "pytorch3d", "mitsuba"
]

AXES: dict[Axes, tuple[int, int, int]] = {
    "phongfit": (1, 1, 1),
    "opengl": (1, 1, 1),
    "nerf": (1, 1, 1),
    "blender": (1, 1, 1),
    "opencv": (1, -1, -1),
    "colmap": (1, -1, -1),
    "pytorch3d": (-1, 1, -1),
    "mitsuba": (-1, 1, -1),
}
"""For each convention, whether its camera's x, y and z axis are ours (right, up, back)
or point the other way (left, down, forward)."""

# Largest deviation from 1 of the singular values of a rotation that was rounded.
ROTATION_TOLERANCE = 1e-3
# The first 8 of OpenCV's 4 to 14 coefficients are Brown's; a thin prism's follow.
N_BROWN = 8


class Pose(NamedTuple):
    """Position and rotation of a camera, in the convention of phongfit's cameras.

    - `position`: world units.
    - `rotation`: x (right), y (up) and z (back) axis as columns.
    """

    position: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "3 3"]


@checked
def camera_pose(to_world: Any, axes: Axes) -> Pose:
    """Position and rotation of a camera from its matrix in another convention.

    ```python
    position, rotation = phongfit.geometry.camera_pose(matrix_world, "blender")
    ```

    **Arguments:**

    - `to_world`: (4, 4) or (3, 4): the matrix that maps a point, as a column, from the
        camera's axes to the world's. For a matrix from the world to the camera
        (OpenCV's and COLMAP's R and t, PyTorch3D's Rᵀ and T), give its inverse.
    - `axes`: the convention of the camera's axes: see [`AXES`][].

    **Raises:** `ValueError` that names the argument; the matrix's axes must be
    orthonormal and right-handed, to 0.001.
    """
    matrix = _numbers("to_world", to_world, (3, 4), (4, 4))
    if len(matrix) == 4 and not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6):
        raise ValueError(
            f"to_world: expected 0, 0, 0, 1 as its last row, got {matrix[3].tolist()}"
        )
    rotation = _as_rotation("to_world", matrix[:3, :3])
    return Pose(matrix[:3, 3], rotation * _signs(axes))


@checked
def camera_to_world(camera: AbstractCamera, axes: Axes) -> Float[np.ndarray, "4 4"]:
    """The matrix of a camera in another convention: the inverse of [`camera_pose`][].

    **Arguments:** `axes`: see [`AXES`][].

    **Returns:** (4, 4): it maps a point from the camera's axes to the world's.

    **Raises:** `ValueError` if `axes` is none of the conventions.
    """
    matrix = np.eye(4)
    matrix[:3, :3] = np.asarray(camera.rotation, float) * _signs(axes)
    matrix[:3, 3] = np.asarray(camera.position, float)
    return matrix


@checked
def camera_from_opencv(
    matrix: Any,
    rotation: Any = (0.0, 0.0, 0.0),
    translation: Any = (0.0, 0.0, 0.0),
    *,
    width: int,
    height: int,
    distortion: Any = (),
    fisheye: bool = False,
) -> PinholeCamera:
    """A camera from the results of OpenCV's calibration.

    The centre of the first pixel is at (0, 0) in OpenCV and at (0.5, 0.5) here, so half
    a pixel is added to OpenCV's principal point.

    **Arguments:**

    - `matrix`: K, (3, 3), OpenCV's `cameraMatrix`.
    - `rotation`: from the world's to the camera's axes: OpenCV's `rvec` (3 numbers, the
        axis times the angle in radians), or R of shape (3, 3).
    - `translation`: t of R X + t, OpenCV's `tvec`, world units. The camera's position
        is −Rᵀ t.
    - `width`, `height`: pixels.
    - `distortion`: OpenCV's `distCoeffs`: none, or the first 4, 5 or 8 of k1, k2, p1,
        p2, k3, k4, k5, k6. If there are 12 or 14, those after k6 (of a thin prism and
        of a tilted sensor) must be 0.
    - `fisheye`: whether `distortion` is k1, k2, k3, k4 of OpenCV's `fisheye` module.

    **Raises:** `ValueError` that names the argument.
    """
    k = _numbers("matrix", matrix, (3, 3))
    below_diagonal = k[[1, 2, 2], [0, 0, 1]]
    if np.abs(below_diagonal).max() > 0 or k[2, 2] != 1:
        raise ValueError(
            "matrix: expected fx, s, cx; 0, fy, cy; 0, 0, 1 as its rows, got "
            f"{k.tolist()}"
        )
    given = _numbers("rotation", rotation, (3,), (3, 1), (1, 3), (3, 3))
    if given.size == 3:
        r = _from_rotation_vector(given.ravel())
    else:
        r = _as_rotation("rotation", given)
    t = _numbers("translation", translation, (3,), (3, 1), (1, 3)).ravel()
    return camera_from_extrinsics(
        r,
        t,
        width=width,
        height=height,
        fx=k[0, 0],
        fy=k[1, 1],
        cx=k[0, 2] + 0.5,
        cy=k[1, 2] + 0.5,
        skew=k[0, 1],
        distortion=_opencv_distortion(distortion, fisheye),
    )


@checked
def camera_from_matrix(
    matrix: Any, *, width: int, height: int, first_pixel: float = 0.0
) -> PinholeCamera:
    """A camera from its projection matrix P = K [R | t], by RQ decomposition.

    P is known up to a factor only. The sign of the factor is chosen so that the camera
    is right-handed, with x right, y down and z forward.

    **Arguments:**

    - `matrix`: (3, 4), P: maps a point of the world, (X, Y, Z, 1), to (w·u, w·v, w)
        with its image point (u, v) in pixels, u to the right and v down.
    - `width`, `height`: pixels.
    - `first_pixel`: u and v of the centre of the first pixel: 0 in OpenCV, 0.5 in
        COLMAP.

    **Raises:** `ValueError` that names the argument; P must be that of a pinhole.

    ??? cite "Source"
        Hartley and Zisserman, *Multiple view geometry in computer vision*, 2nd edition,
        2004, section 6.2.4.
    """
    if first_pixel not in (0, 0.5):
        raise ValueError(f"first_pixel: expected 0 or 0.5, got {first_pixel!r}")
    p = _numbers("matrix", matrix, (3, 4))
    # P is known up to a factor: the largest number of its last row becomes 1.
    p = p / max(np.abs(p[2, :3]).max(), np.finfo(float).tiny)
    # Rows are scaled to length 1 for this test: their lengths differ a thousandfold.
    scale = np.linalg.norm(p[:, :3], axis=1, keepdims=True)
    if not scale.all() or abs(np.linalg.det(p[:, :3] / scale)) < 1e-9:
        raise ValueError(
            "matrix: expected the matrix of a pinhole, got one without a centre, as of "
            "parallel rays or of one that is not a projection"
        )
    p = p * np.sign(np.linalg.det(p[:, :3]))
    k, r = _rq(p[:, :3])
    t = np.linalg.solve(k, p[:, 3])
    k = k / k[2, 2]
    # Our cameras have the centre of the first pixel at 0.5.
    half = 0.5 - first_pixel
    return camera_from_extrinsics(
        r,
        t,
        width=width,
        height=height,
        fx=k[0, 0],
        fy=k[1, 1],
        cx=k[0, 2] + half,
        cy=k[1, 2] + half,
        skew=k[0, 1],
    )


def camera_from_extrinsics(
    rotation: Float[np.ndarray, "3 3"],
    translation: Float[np.ndarray, "3"],
    **intrinsics: Any,
) -> PinholeCamera:
    """A camera from a rotation R and translation t: x = R X + t.

    X is a point of the world and x the same point in the camera's axes of OpenCV and
    COLMAP (x right, y down, z forward).

    **Arguments:**

    - `rotation`, `translation`: R and t, t in world units.
    - `intrinsics`: other arguments of [`PinholeCamera`][]; `cx` and `cy` count from the
        corner of the first pixel, not from its centre.
    """
    to_world = np.column_stack([rotation.T, -rotation.T @ translation])
    pose = camera_pose(to_world, "opencv")
    return PinholeCamera(**intrinsics, position=pose.position, rotation=pose.rotation)


def _signs(axes: Axes) -> Float[np.ndarray, "3"]:
    """Factors 1 or −1 from a convention's x, y and z axis of a camera to ours."""
    return np.array(AXES[axes], float)


def _numbers(
    name: str, value: Any, *shapes: tuple[int, ...]
) -> Float[np.ndarray, "..."]:
    """`value` as finite numbers in double precision, of one of these shapes.

    **Raises:** `ValueError` that names `name`.
    """
    array = as_array(name, value)
    if array.dtype.kind not in "biuf" or array.shape not in shapes:
        wanted = " or ".join(map(str, shapes))
        raise ValueError(
            f"{name}: expected numbers of shape {wanted}, got {shown(value)}"
        )
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite numbers, got {shown(value)}")
    return array.astype(float)


def _as_rotation(name: str, matrix: np.ndarray) -> Float[np.ndarray, "3 3"]:
    """The rotation nearest to a matrix, which may differ from one by rounding.

    **Raises:** `ValueError` that names `name` if the difference is larger.
    """
    left, sizes, right = np.linalg.svd(matrix)
    if np.abs(sizes - 1).max() > ROTATION_TOLERANCE or np.linalg.det(matrix) < 0:
        raise ValueError(
            f"{name}: expected a rotation, got axes that are scaled, sheared or "
            f"mirrored: lengths {np.linalg.norm(matrix, axis=0).round(4).tolist()}, "
            f"determinant {np.linalg.det(matrix):.4g}"
        )
    return left @ right


def _from_rotation_vector(vector: np.ndarray) -> Float[np.ndarray, "3 3"]:
    """The rotation about a vector by its length in radians."""
    # Imported here, since SciPy's transforms take long to import.
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(vector).as_matrix()


def _rq(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """RQ decomposition: an upper triangle with positive diagonal, and a rotation."""
    from scipy.linalg import rq

    triangle, rotation = rq(matrix)
    # SciPy's diagonal may be negative: then a column of the triangle and the row of the
    # rotation that it multiplies change sign together.
    signs = np.sign(np.diag(triangle))
    return triangle * signs, signs[:, None] * rotation


def _opencv_distortion(given: Any, fisheye: bool) -> AbstractDistortion | None:
    """The distortion with OpenCV's coefficients; `None` if there is no distortion."""
    array = as_array("distortion", () if given is None else given)
    if array.size == 0:
        # A fisheye lens without coefficients still differs from a pinhole.
        return FisheyeDistortion() if fisheye else None
    counts = (4,) if fisheye else (4, 5, 8, 12, 14)
    if array.size not in counts or array.dtype.kind not in "biuf":
        wanted = " or ".join(map(str, counts))
        raise ValueError(f"distortion: expected {wanted} numbers, got {shown(given)}")
    values = [float(value) for value in array.ravel()]
    if fisheye:
        return FisheyeDistortion(*values)
    if any(values[N_BROWN:]):
        raise ValueError(
            "distortion: expected 0 as coefficients of a thin prism and a tilted "
            f"sensor, which are not modelled, got {values[N_BROWN:]}"
        )
    return BrownDistortion(*values[:N_BROWN]) if any(values) else None
