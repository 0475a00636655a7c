"""Cameras: from a pixel to the ray through it, and from a point to its image.

A camera looks along its own −z, with x to the right and y up. Image points (x, y) are
in pixels from the top left corner of the image, with y down, so that the centre of the
first pixel is at (0.5, 0.5).
"""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from equinox import AbstractVar
from jaxtyping import Array, Bool, Float

from phongfit.checks import (
    as_floats,
    as_positive,
    as_scalar,
    as_vector,
    nonzero,
    require,
)
from phongfit.edge import checked
from phongfit.geometry.distortion import AbstractDistortion, PlanePoint, flat
from phongfit.programs import program
from phongfit.vectors import Scalar, Vec3, normalize


class Ray(eqx.Module):
    """Points `origin + t direction`, t ≥ 0; `direction` is a unit vector."""

    origin: Float[Array, "*batch 3"]
    direction: Float[Array, "*batch 3"]

    def at(self, distance: Scalar) -> Vec3:
        """The point of one ray at a distance from its origin, world units."""
        return self.origin + distance * self.direction


class AbstractCamera(eqx.Module):
    """A grid of `height` × `width` square pixels, each with a ray."""

    width: AbstractVar[int]
    height: AbstractVar[int]
    position: AbstractVar[Float[Array, "3"]]
    rotation: AbstractVar[Float[Array, "3 3"]]

    @abc.abstractmethod
    def ray(self, x: Scalar, y: Scalar) -> Ray:
        """Ray through image point (x, y), in pixels from the top left corner.

        In the world's axes and units. A finite placeholder if there is no such ray: see
        `covered`.
        """

    @abc.abstractmethod
    def project(self, position: Vec3) -> Float[Array, "2"]:
        """Image of a point of the scene, (x, y) in pixels from the top left corner.

        The inverse of `ray`. NaN for points without an image: behind a pinhole, and
        where a lens's formula folds the image back on itself.
        """

    @abc.abstractmethod
    def to_viewer(self, position: Vec3) -> Vec3:
        """Unit vector from a point of the scene (world units) towards the viewer."""

    def covered(self) -> Bool[Array, "height width"] | None:
        """Mask of the pixels that have a ray; `None` if all have one.

        Some distortions have no direction for pixels near the corners.
        """
        return None

    @property
    def parallel(self) -> bool:
        """Whether all rays are parallel, with the viewer in one direction."""
        return False

    def rays(self) -> Ray:
        """Rays through all pixel centres, of shape (height, width, 3)."""
        return over_pixels(self.ray, self)

    def finer(self, times: int) -> "AbstractCamera":
        """A camera with the same view and `times` as many rows and columns."""
        if times == 1:
            return self
        return WindowCamera(self, 0, 0, self.width * times, self.height * times, times)

    def depth(self, position: Vec3) -> Scalar:
        """Distance of a point along the viewing axis, world units; > 0 in front."""
        # The third column of the rotation points back, from the scene to the camera.
        return jnp.sum((self.position - position) * self.rotation[:, 2])

    def _seen_from(self, position: Vec3) -> Vec3:
        """Coordinates of a point in the camera's axes: right, up, back; world units."""
        # A GPU would otherwise multiply in reduced precision.
        offset = position - self.position
        return jnp.matmul(offset, self.rotation, precision="highest")


def over_pixels(
    function: Callable[[Scalar, Scalar], Any], camera: AbstractCamera
) -> Any:
    """Evaluate a function of an image point at all pixel centres of a camera.

    **Returns:** the function's results with leading axes (height, width).
    """
    dtype = camera.position.dtype
    x = jnp.arange(camera.width, dtype=dtype) + 0.5
    y = jnp.arange(camera.height, dtype=dtype) + 0.5
    along_row = jax.vmap(function, in_axes=(0, None))
    return jax.vmap(along_row, in_axes=(None, 0))(x, y)


def _as_size(name: str, value: Any) -> int:
    """`value` as a whole number ≥ 1; else a `ValueError` that names `name`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise ValueError(f"{name}: expected a whole number ≥ 1, got {value!r}")
    return int(value)


def _as_rotation(value: Any) -> Float[Array, "3 3"]:
    """`value` as a rotation matrix, orthonormal to 1e-4; else `ValueError`."""
    rotation = as_floats("rotation", value)
    if rotation.shape != (3, 3):
        raise ValueError(f"rotation: expected shape (3, 3), got {rotation.shape}")

    def fine(r: Any) -> Any:
        xp = np if isinstance(r, np.ndarray) else jnp
        orthonormal = abs(r.T @ r - np.eye(3, dtype=r.dtype)) < 1e-4
        # x × y = z excludes reflections, which would swap left and right.
        right_handed = abs(xp.cross(r[:, 0], r[:, 1]) - r[:, 2]) < 1e-3
        return orthonormal.all() & right_handed.all()

    return require("rotation", rotation, fine, "orthonormal, right-handed axes")


@checked
def look_at(position: Any, target: Any, up: Any = (0, 1, 0)) -> Float[Array, "3 3"]:
    """Rotation of a camera at `position` that sees `target` in its centre.

    **Arguments:** three vectors in world units; `up` points upwards in the image.

    **Returns:** the camera's x (right), y (up) and z (back) axes as columns.

    **Raises:** `ValueError` if `position` is `target`, or `up` is zero or lies along
    the view.
    """
    back = as_vector("position", position) - as_vector("target", target)
    wanted = "a point other than target"
    back = normalize(require("position", back, lambda a: (a != 0).any(), wanted))
    right = jnp.cross(normalize(nonzero("up", as_vector("up", up))), back)
    wanted = "a direction not along the view"
    right = normalize(require("up", right, lambda a: abs(a).max() > 1e-6, wanted))
    return jnp.stack([right, jnp.cross(back, right), back], axis=1)


class OrthographicCamera(AbstractCamera):
    """Parallel rays: a very long lens, far away."""

    view_height: Float[Array, ""]
    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)
    position: Float[Array, "3"]
    rotation: Float[Array, "3 3"]

    @checked
    def __init__(
        self,
        width: int = 256,
        height: int = 256,
        *,
        view_height: Any = 2.2,
        position: Any = (0.0, 0.0, 5.0),
        rotation: Any = None,
    ):
        """**Arguments:**

        - `width`, `height`: pixels.
        - `view_height`: world units from the image's lower to its upper edge.
        - `position`: centre of the image plane, world units; nothing behind it is seen.
        - `rotation`: the camera's axes x (right), y (up) and z (back) as columns of a
            (3, 3) matrix; default the world's axes, so that it looks along the world's
            −z.

        **Raises:** `ValueError` that names the argument.
        """
        self.width = _as_size("width", width)
        self.height = _as_size("height", height)
        self.view_height = as_positive("view_height", view_height)
        self.position = as_vector("position", position)
        self.rotation = _as_rotation(np.eye(3) if rotation is None else rotation)

    @classmethod
    def look_at(
        cls,
        position: Any,
        target: Any = (0.0, 0.0, 0.0),
        up: Any = (0.0, 1.0, 0.0),
        *,
        width: int = 256,
        height: int = 256,
        view_height: Any = 2.2,
    ) -> "OrthographicCamera":
        """A camera at `position` with `target` in its centre: see [`look_at`][]."""
        return cls(
            width,
            height,
            view_height=view_height,
            position=position,
            rotation=look_at(position, target, up),
        )

    @property
    def parallel(self) -> bool:
        return True

    def ray(self, x: Scalar, y: Scalar) -> Ray:
        # Size of a pixel in world units.
        pixel = self.view_height / self.height
        right = (x - self.width / 2) * pixel
        up = (self.height / 2 - y) * pixel
        offset = self.rotation @ jnp.stack([right, up, jnp.zeros_like(right)])
        # The camera looks along its −z axis, the third column.
        return Ray(self.position + offset, -self.rotation[:, 2])

    def project(self, position: Vec3) -> Float[Array, "2"]:
        right, up, _ = self._seen_from(position)
        # Pixels per world unit.
        pixels = self.height / self.view_height
        return jnp.stack(
            [self.width / 2 + right * pixels, self.height / 2 - up * pixels]
        )

    def to_viewer(self, position: Vec3) -> Vec3:
        # The camera's z axis, for all points.
        del position
        return self.rotation[:, 2]


class PerspectiveCamera(AbstractCamera):
    """A pinhole camera whose axis goes through the middle of its image.

    For calibrated cameras, see [`PinholeCamera`][].
    """

    fov_y: Float[Array, ""]
    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)
    position: Float[Array, "3"]
    rotation: Float[Array, "3 3"]

    @checked
    def __init__(
        self,
        width: int = 256,
        height: int = 256,
        *,
        fov_y: Any = 30.0,
        position: Any = (0.0, 0.0, 5.0),
        rotation: Any = None,
    ):
        """**Arguments:**

        - `width`, `height`: pixels.
        - `fov_y`: angle from the image's lower to its upper edge, degrees in (0, 180).
        - `position`: the pinhole, world units.
        - `rotation`: as in [`OrthographicCamera`][].

        **Raises:** `ValueError` that names the argument.
        """
        self.width = _as_size("width", width)
        self.height = _as_size("height", height)
        self.fov_y = as_positive("fov_y", fov_y, below=180)
        self.position = as_vector("position", position)
        self.rotation = _as_rotation(np.eye(3) if rotation is None else rotation)

    @classmethod
    def look_at(
        cls,
        position: Any,
        target: Any = (0.0, 0.0, 0.0),
        up: Any = (0.0, 1.0, 0.0),
        *,
        width: int = 256,
        height: int = 256,
        fov_y: Any = 30.0,
    ) -> "PerspectiveCamera":
        """A camera at `position` with `target` in its centre: see [`look_at`][]."""
        return cls(
            width,
            height,
            fov_y=fov_y,
            position=position,
            rotation=look_at(position, target, up),
        )

    def ray(self, x: Scalar, y: Scalar) -> Ray:
        # Size of a pixel on the plane at distance 1, of which 2 tan(fov/2) is seen.
        pixel = 2 * jnp.tan(jnp.deg2rad(self.fov_y) / 2) / self.height
        right = (x - self.width / 2) * pixel
        up = (self.height / 2 - y) * pixel
        direction = self.rotation @ jnp.stack([right, up, -jnp.ones_like(right)])
        return Ray(self.position, normalize(direction))

    def project(self, position: Vec3) -> Float[Array, "2"]:
        right, up, back = self._seen_from(position)
        # Focal length in pixels.
        pixels = self.height / (2 * jnp.tan(jnp.deg2rad(self.fov_y) / 2))
        # `flat` has y down and z forward, our cameras y up and z back.
        x, y = pixels * flat(jnp.stack([right, -up, -back]))
        return jnp.stack([self.width / 2 + x, self.height / 2 + y])

    def to_viewer(self, position: Vec3) -> Vec3:
        return normalize(self.position - position)


class PinholeCamera(AbstractCamera):
    r"""A calibrated pinhole camera: focal lengths, principal point, lens distortion.

    A point at $(X, Y, Z)$ from the pinhole, $X$ right, $Y$ down and $Z$ forward, is
    seen at

    $$u = f_x\,x' + s\,y' + c_x \qquad v = f_y\,y' + c_y$$

    pixels from the top left corner. $(x', y')$ is $(X/Z, Y/Z)$ without `distortion`;
    else see [`BrownDistortion`][] and [`FisheyeDistortion`][]. Each pixel has the ray
    that the lens maps to it, so photographs are fitted as they are, with their
    distortion.

    ??? cite "Source"
        Hartley and Zisserman, *Multiple view geometry in computer vision*, 2nd edition,
        2004, section 6.1.
    """

    fx: Float[Array, ""]
    fy: Float[Array, ""]
    cx: Float[Array, ""]
    cy: Float[Array, ""]
    skew: Float[Array, ""]
    distortion: AbstractDistortion | None
    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)
    position: Float[Array, "3"]
    rotation: Float[Array, "3 3"]

    @checked
    def __init__(
        self,
        width: int,
        height: int,
        *,
        fx: Any,
        fy: Any = None,
        cx: Any = None,
        cy: Any = None,
        skew: Any = 0.0,
        distortion: AbstractDistortion | None = None,
        position: Any = (0.0, 0.0, 0.0),
        rotation: Any = None,
    ):
        """**Arguments:**

        - `width`, `height`: pixels.
        - `fx`, `fy`: focal lengths > 0, in pixels; default of `fy`: `fx`.
        - `cx`, `cy`: the principal point, in pixels from the top left corner of the
            image, where the first pixel has its centre at 0.5 (as for COLMAP; OpenCV
            has it at 0, see [`camera_from_opencv`][]); default the middle.
        - `skew`: $s$, in pixels; 0 where rows and columns are at right angles.
        - `distortion`: of the lens; default none.
        - `position`: the pinhole, world units.
        - `rotation`: as in [`OrthographicCamera`][]; [`camera_pose`][] converts that of
            other programs.

        **Raises:** `ValueError` that names the argument.
        """
        self.width = _as_size("width", width)
        self.height = _as_size("height", height)
        self.fx = as_positive("fx", fx)
        self.fy = self.fx if fy is None else as_positive("fy", fy)
        self.cx = as_scalar("cx", width / 2 if cx is None else cx)
        self.cy = as_scalar("cy", height / 2 if cy is None else cy)
        self.skew = as_scalar("skew", skew)
        self.distortion = distortion
        self.position = as_vector("position", position)
        self.rotation = _as_rotation(np.eye(3) if rotation is None else rotation)

    def ray(self, x: Scalar, y: Scalar) -> Ray:
        (right, down, ahead), _ = self._direction(x, y)
        # Distortion has y down and z forward, our cameras y up and z back.
        direction = self.rotation @ jnp.stack([right, -down, -ahead])
        return Ray(self.position, normalize(direction))

    def _direction(self, x: Scalar, y: Scalar) -> tuple[Vec3, Bool[Array, ""]]:
        """Direction (right, down, ahead) of an image point, and whether there is one.

        In the camera's axes but for signs; of any length.
        """
        place = self.place_of(x, y)
        if self.distortion is None:
            return jnp.append(place, jnp.ones_like(x)), jnp.array(True)
        return self.distortion.direction(place)

    def place_of(self, x: Scalar, y: Scalar) -> PlanePoint:
        """Point of the plane at distance 1, x right and y down, for an image point.

        **Arguments:** `x`, `y`: in pixels from the top left corner.
        """
        down = (y - self.cy) / self.fy
        return jnp.stack([(x - self.cx - self.skew * down) / self.fx, down])

    def pixel_of(self, place: PlanePoint) -> Float[Array, "2"]:
        """Image point (x, y), in pixels, of a point of that plane: see `place_of`."""
        x, y = place
        return jnp.stack([self.fx * x + self.skew * y + self.cx, self.fy * y + self.cy])

    def project(self, position: Vec3) -> Float[Array, "2"]:
        right, up, back = self._seen_from(position)
        direction = jnp.stack([right, -up, -back])
        lens = self.distortion
        return self.pixel_of(flat(direction) if lens is None else lens.place(direction))

    def to_viewer(self, position: Vec3) -> Vec3:
        return normalize(self.position - position)

    def covered(self) -> Bool[Array, "height width"] | None:
        # Without distortion each pixel has a ray.
        return None if self.distortion is None else _covered(self)


@program()
def _covered(camera: PinholeCamera) -> Bool[Array, "height width"]:
    """Mask of the pixels whose centre is the image of a direction."""

    def found(x: Scalar, y: Scalar) -> Bool[Array, ""]:
        return camera._direction(x, y)[1]

    return over_pixels(found, camera)


class WindowCamera(AbstractCamera):
    """A camera for a rectangular part of another camera's image, with finer pixels.

    The part may extend beyond the right and lower edge of that image.
    """

    camera: AbstractCamera
    left: Float[Array, ""]
    top: Float[Array, ""]
    times: int = eqx.field(static=True)
    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)
    position: Float[Array, "3"]
    rotation: Float[Array, "3 3"]

    def __init__(
        self,
        camera: AbstractCamera,
        left: int,
        top: int,
        width: int,
        height: int,
        times: int = 1,
    ):
        """**Arguments:**

        - `camera`: the other camera.
        - `left`, `top`: column and row of the window's first pixel in its image, ≥ 0.
        - `width`, `height`: of the window, pixels.
        - `times`: rows and columns that each pixel of the other camera is split into,
            ≥ 1. All numbers above count these finer pixels.
        """
        self.camera = camera
        # Arrays, not static fields: one compiled program serves all windows.
        self.left = jnp.asarray(left, camera.position.dtype)
        self.top = jnp.asarray(top, camera.position.dtype)
        self.times = _as_size("times", times)
        self.width = _as_size("width", width)
        self.height = _as_size("height", height)
        self.position = camera.position
        self.rotation = camera.rotation

    @property
    def parallel(self) -> bool:
        return self.camera.parallel

    def ray(self, x: Scalar, y: Scalar) -> Ray:
        return self.camera.ray(
            (x + self.left) / self.times, (y + self.top) / self.times
        )

    def project(self, position: Vec3) -> Float[Array, "2"]:
        corner = jnp.stack([self.left, self.top])
        return self.camera.project(position) * self.times - corner

    def to_viewer(self, position: Vec3) -> Vec3:
        return self.camera.to_viewer(position)

    def depth(self, position: Vec3) -> Scalar:
        return self.camera.depth(position)

    def covered(self) -> Bool[Array, "height width"] | None:
        whole = self.camera.covered()
        if whole is None:
            # Each pixel has a ray.
            return None
        size = (self.height, self.width)
        finer = jnp.repeat(jnp.repeat(whole, self.times, axis=0), self.times, axis=1)
        padded = jnp.pad(finer, [(0, side) for side in size])
        start = self.top.astype(int), self.left.astype(int)
        return jax.lax.dynamic_slice(padded, start, size)
