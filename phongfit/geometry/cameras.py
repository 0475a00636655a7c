"""Cameras: from a pixel to the ray through it.

A camera looks along its own −z, with x to the right and y up. Pixel (0, 0) is at the
top left; centres are at half integers.
"""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from equinox import AbstractVar
from jaxtyping import Array, Float

from phongfit.checks import as_floats, as_scalar, as_vector, nonzero, require
from phongfit.edge import checked
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
        """Ray through image point (x, y), in pixels from the top left corner."""

    @abc.abstractmethod
    def to_viewer(self, position: Vec3) -> Vec3:
        """Unit vector from a point of the scene towards the viewer."""

    def rays(self) -> Ray:
        """Rays through all pixel centres, of shape (height, width, 3)."""
        dtype = self.position.dtype
        x = jnp.arange(self.width, dtype=dtype) + 0.5
        y = jnp.arange(self.height, dtype=dtype) + 0.5
        along_row = jax.vmap(self.ray, in_axes=(0, None))
        return jax.vmap(along_row, in_axes=(None, 0))(x, y)

    def depth(self, position: Vec3) -> Scalar:
        """Distance of a point along the camera's viewing axis, in world units."""
        return jnp.sum((self.position - position) * self.rotation[:, 2])


def _as_size(name: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise ValueError(f"{name}: expected a whole number ≥ 1, got {value!r}")
    return int(value)


def _as_rotation(value: Any) -> Float[Array, "3 3"]:
    rotation = as_floats("rotation", value)
    if rotation.shape != (3, 3):
        raise ValueError(f"rotation: expected shape (3, 3), got {rotation.shape}")

    def fine(xp: Any) -> Callable[[Any], Any]:
        # x × y = z tells a rotation from a mirror, which would swap left and right.
        return lambda r: (
            (abs(r.T @ r - np.eye(3, dtype=r.dtype)) < 1e-4).all()
            & (abs(xp.cross(r[:, 0], r[:, 1]) - r[:, 2]) < 1e-3).all()
        )

    wanted = "orthonormal, right-handed axes"
    return require("rotation", rotation, fine(np), fine(jnp), wanted)


def _positive(name: str, value: Any, below: float = np.inf) -> Scalar:
    def inside(a: Any) -> Any:
        return (a > 0) & (a < below)

    wanted = "a number > 0" + (f" and < {below:g}" if below < np.inf else "")
    return require(name, as_scalar(name, value), inside, inside, wanted)


@checked
def look_at(position: Any, target: Any, up: Any = (0, 1, 0)) -> Float[Array, "3 3"]:
    """Rotation of a camera at `position` that sees `target` in its centre.

    **Arguments:** three vectors in world units; `up` shows upwards in the image.

    **Returns:** the camera's x (right), y (up) and z (back) axes as columns.

    **Raises:** `ValueError` if `position` is `target`, or `up` lies along the view.
    """
    back = as_vector("position", position) - as_vector("target", target)

    def apart(a: Any) -> Any:
        return (a != 0).any()

    back = require("position", back, apart, apart, "a place other than target")
    back = normalize(back)
    right = jnp.cross(normalize(nonzero("up", as_vector("up", up))), back)

    def aslant(a: Any) -> Any:
        return abs(a).max() > 1e-6

    right = require("up", right, aslant, aslant, "a direction not along the view")
    right = normalize(right)
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
        - `position`: centre of the image plane; nothing behind it is seen.
        - `rotation`: x, y and z axis of the camera as columns of a (3, 3) matrix;
            default the world's own, which looks along −z.

        **Raises:** `ValueError` that names the argument.
        """
        self.width = _as_size("width", width)
        self.height = _as_size("height", height)
        self.view_height = _positive("view_height", view_height)
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

    def ray(self, x: Scalar, y: Scalar) -> Ray:
        pixel = self.view_height / self.height
        right = (x - self.width / 2) * pixel
        up = (self.height / 2 - y) * pixel
        offset = self.rotation @ jnp.stack([right, up, jnp.zeros_like(right)])
        return Ray(self.position + offset, -self.rotation[:, 2])

    def to_viewer(self, position: Vec3) -> Vec3:
        del position
        return self.rotation[:, 2]


class PerspectiveCamera(AbstractCamera):
    """A pinhole camera."""

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
        self.fov_y = _positive("fov_y", fov_y, below=180)
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
        # The image plane at distance 1 is 2 tan(fov/2) high.
        pixel = 2 * jnp.tan(jnp.deg2rad(self.fov_y) / 2) / self.height
        right = (x - self.width / 2) * pixel
        up = (self.height / 2 - y) * pixel
        direction = self.rotation @ jnp.stack([right, up, -jnp.ones_like(right)])
        return Ray(self.position, normalize(direction))

    def to_viewer(self, position: Vec3) -> Vec3:
        return normalize(self.position - position)
