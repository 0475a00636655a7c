"""Shapes with an implicit form F(p) for tracing and a parametric one for meshes."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.checks import as_function, as_positive
from phongfit.edge import checked
from phongfit.geometry.implicit import ImplicitSurface
from phongfit.geometry.meshes import Mesh
from phongfit.geometry.parametric import tessellate
from phongfit.vectors import Scalar, Vec3, norm


class AbstractShape(eqx.Module):
    """Base class of surfaces around the origin, in implicit and in parametric form."""

    @abc.abstractmethod
    def implicit(self, position: Vec3) -> Scalar:
        """F(p) of a point p, world units: 0 on the surface, positive outside."""

    @abc.abstractmethod
    def parametric(self, u: Scalar, v: Scalar) -> Vec3:
        """p(u, v) for u and v in [0, 1], world units."""

    @abc.abstractmethod
    def corner(self) -> Float[Array, "3"]:
        """Corner (x, y, z > 0) of the box around the origin that bounds the shape."""

    @checked
    def surface(self, *, steps: int = 128) -> ImplicitSurface:
        """The shape as an implicit surface: see [`ImplicitSurface`][]."""
        corner = self.corner()
        return ImplicitSurface(self.implicit, -corner, corner, steps=steps)

    @checked
    def mesh(
        self, columns: int = 64, rows: int = 32, *, two_sided: bool = False
    ) -> Mesh:
        """The shape cut into triangles, with exact normals: see [`tessellate`][]."""
        return tessellate(
            self.parametric, columns=columns, rows=rows, two_sided=two_sided
        )


# Size of the box over that of the shape in it, which must not touch the box's sides.
ROOM = 1.01


def _turn(fraction: Scalar) -> tuple[Scalar, Scalar]:
    """Cosine and sine of an angle that is given as a fraction of a full turn."""
    angle = 2 * np.pi * fraction
    return jnp.cos(angle), jnp.sin(angle)


class Ball(AbstractShape):
    """A sphere; u is longitude from +x towards −z, v latitude from the pole at −y."""

    radius: Float[Array, ""]

    def __init__(self, radius: Any = 1.0):
        """**Arguments:** `radius` > 0, world units, else `ValueError`."""
        self.radius = as_positive("radius", radius)

    def implicit(self, position: Vec3) -> Scalar:
        return norm(position) - self.radius

    def parametric(self, u: Scalar, v: Scalar) -> Vec3:
        x, z = _turn(-u)
        latitude = np.pi * (v - 0.5)
        ring = jnp.cos(latitude)
        return self.radius * jnp.stack([ring * x, jnp.sin(latitude), ring * z])

    def corner(self) -> Float[Array, "3"]:
        return jnp.broadcast_to(ROOM * self.radius, (3,))


class Torus(AbstractShape):
    """A ring around the z axis; u runs around the axis, v around the tube."""

    major: Float[Array, ""]
    minor: Float[Array, ""]

    def __init__(self, major: Any = 0.75, minor: Any = 0.25):
        """**Arguments:** `major` > 0, from the centre to the middle of the tube, and
        `minor` > 0, the tube's radius, world units, else `ValueError`.
        """
        self.major = as_positive("major", major)
        self.minor = as_positive("minor", minor)

    def implicit(self, position: Vec3) -> Scalar:
        across = norm(position[:2]) - self.major
        return norm(jnp.stack([across, position[2]])) - self.minor

    def parametric(self, u: Scalar, v: Scalar) -> Vec3:
        (x, y), (out, up) = _turn(u), _turn(v)
        ring = self.major + self.minor * out
        return jnp.stack([ring * x, ring * y, self.minor * up])

    def corner(self) -> Float[Array, "3"]:
        outer = self.major + self.minor
        return ROOM * jnp.stack([outer, outer, self.minor])


class Cylinder(AbstractShape):
    """A tube around the y axis, open at both ends and seen from outside.

    u runs around the axis, from +x towards −z; v from the lower to the upper end.
    """

    radius: Float[Array, ""]
    height: Float[Array, ""]

    def __init__(self, radius: Any = 0.5, height: Any = 2.0):
        """**Arguments:** `radius` and `height` (along y), both > 0, world units, else
        `ValueError`.
        """
        self.radius = as_positive("radius", radius)
        self.height = as_positive("height", height)

    def implicit(self, position: Vec3) -> Scalar:
        # Distance from the y axis: of x and z.
        return norm(position[jnp.array([0, 2])]) - self.radius

    def parametric(self, u: Scalar, v: Scalar) -> Vec3:
        x, z = _turn(-u)
        return jnp.stack([self.radius * x, self.height * (v - 0.5), self.radius * z])

    def corner(self) -> Float[Array, "3"]:
        side = ROOM * self.radius
        return jnp.stack([side, self.height / 2, side])


class HeightField(AbstractShape):
    """A relief z = h(x, y) over a rectangle, seen from +z."""

    function: Callable[[Scalar, Scalar], Scalar]
    width: Float[Array, ""]
    height: Float[Array, ""]
    relief: Float[Array, ""]

    @checked
    def __init__(
        self,
        function: Callable[[Scalar, Scalar], Scalar],
        width: Any = 2.0,
        height: Any = 2.0,
        relief: Any = 1.0,
    ):
        """**Arguments:**

        - `function`: (x, y) → h, world units, written in `jax.numpy`.
        - `width` (x), `height` (y): of the rectangle, world units > 0.
        - `relief`: |h| stays below this, world units > 0.

        **Raises:** `ValueError` that names the argument.
        """
        self.function = as_function("function", function)
        self.width = as_positive("width", width)
        self.height = as_positive("height", height)
        self.relief = as_positive("relief", relief)

    def implicit(self, position: Vec3) -> Scalar:
        x, y, z = position
        return z - self.function(x, y)

    def parametric(self, u: Scalar, v: Scalar) -> Vec3:
        x, y = self.width * (u - 0.5), self.height * (v - 0.5)
        return jnp.stack([x, y, self.function(x, y)])

    def corner(self) -> Float[Array, "3"]:
        return jnp.stack([self.width / 2, self.height / 2, self.relief])


def _level(x: Scalar, y: Scalar) -> Scalar:
    """The height 0 everywhere."""
    del y
    return jnp.zeros_like(x)


@checked
def plane(width: Any = 2.0, height: Any = 2.0) -> HeightField:
    """A rectangle in z = 0 around the origin, seen from +z.

    **Arguments:** `width` (x), `height` (y), world units > 0, else `ValueError`.
    """
    return HeightField(_level, width, height)
