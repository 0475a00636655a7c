"""Surfaces given as a function F(p) that is 0 on them, traced ray by ray."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from phongfit.checks import as_function, as_vector, require
from phongfit.edge import checked
from phongfit.geometry.cameras import AbstractCamera, Ray
from phongfit.geometry.normals import implicit_normal
from phongfit.geometry.surfaces import AbstractSurface, GBuffer, trace_rays
from phongfit.programs import program
from phongfit.vectors import Scalar, Vec3, dot


class ImplicitSurface(AbstractSurface):
    r"""The points p of a box where $F(p) = 0$, seen from where $F > 0$."""

    function: Callable[[Vec3], Scalar]
    lower: Float[Array, "3"]
    upper: Float[Array, "3"]
    steps: int = eqx.field(static=True)

    @checked
    def __init__(
        self,
        function: Callable[[Vec3], Scalar],
        lower: Any = (-1.0, -1.0, -1.0),
        upper: Any = (1.0, 1.0, 1.0),
        *,
        steps: int = 128,
    ):
        """**Arguments:**

        - `function`: p → F(p) of one point, shape (3,), world units; positive outside,
            written in `jax.numpy`. A callable `equinox.Module` if its numbers should
            have gradients.
        - `lower`, `upper`: corners of the box that is searched, world units.
        - `steps`: number of steps along a ray through the box; parts of the surface
            that are thinner than a step can be missed.

        **Raises:** `ValueError` that names the argument.
        """
        if steps < 1:
            raise ValueError(f"steps: expected a whole number ≥ 1, got {steps!r}")
        self.function = as_function("function", function)
        self.lower = as_vector("lower", lower)
        self.upper = as_vector("upper", upper)
        size = self.upper - self.lower
        wanted = "a corner above lower on each axis"
        require("upper", size, lambda a: a > 0, wanted)
        self.steps = steps

    @checked
    @program()
    def trace(self, camera: AbstractCamera) -> GBuffer:
        return trace_rays(self.intersect, camera)

    def intersect(self, ray: Ray) -> tuple[Vec3, Vec3, Bool[Array, ""]]:
        """The first point where one ray enters the object (F turns negative).

        **Returns:** position, unit normal, and whether the ray hits; if it does not,
        the first two are finite placeholders.
        """
        near, far = self._span(ray)
        hit, before, after = self._first_entry(ray, near, far)
        distance = self._polish(ray, self._bisect(ray, before, after), hit)
        position = ray.at(distance)
        position = jnp.where(hit, position, (self.lower + self.upper) / 2)
        normal = implicit_normal(self.function, position)
        return position, jnp.where(hit, normal, -ray.direction), hit

    @program()
    def reached(
        self,
        position: Float[Array, "*batch 3"],
        normal: Float[Array, "*batch 3"],
        to_light: Float[Array, "*batch 3"],
        distance: Float[Array, "*batch"],
    ) -> Bool[Array, "*batch"]:
        # Off the surface by a fraction of a step, since smaller details are missed
        # anyway.
        lift = 0.05 * jnp.max(self.upper - self.lower) / self.steps

        def one(
            position: Vec3, normal: Vec3, to_light: Vec3, distance: Scalar
        ) -> Array:
            """Whether light reaches one point: from the front, with nothing between."""
            in_front = dot(normal, to_light) > 0
            ray = Ray(position + lift * normal, to_light)
            near, far = self._span(ray)
            far = jnp.minimum(far, distance)
            hit, _, _ = self._first_entry(ray, near, far)
            return in_front & ~hit

        for _ in distance.shape:
            one = jax.vmap(one)
        return one(position, normal, to_light, distance)

    def _span(self, ray: Ray) -> tuple[Scalar, Scalar]:
        """Distances (≥ 0, world units) at which a ray enters the box and leaves it.

        If the ray misses the box, the first distance is the larger one.
        """
        along = ray.direction
        # Instead of zero, by which the lines below would divide.
        tiny = jnp.finfo(along.dtype).tiny
        along = jnp.where(jnp.abs(along) > tiny, along, tiny)
        one = (self.lower - ray.origin) / along
        other = (self.upper - ray.origin) / along
        near = jnp.max(jnp.minimum(one, other))
        return jnp.maximum(near, 0), jnp.min(jnp.maximum(one, other))

    def _first_entry(
        self, ray: Ray, near: Scalar, far: Scalar
    ) -> tuple[Bool[Array, ""], Scalar, Scalar]:
        """The first step along the ray in which F falls from positive to ≤ 0.

        **Arguments:** `near`, `far`: distances between which the ray is searched.

        **Returns:** whether there is one, and the distances of its two ends.
        """
        near, far = jax.lax.stop_gradient((near, far))
        through = far > near
        near, far = jnp.where(through, near, 0), jnp.where(through, far, 1)
        length = (far - near) / self.steps

        def value(distance: Scalar) -> Scalar:
            return self.function(ray.at(distance))

        def step(carry: tuple[Array, Array, Array], i: Array) -> tuple[Any, None]:
            # `entry`: end of the step that enters; `last`: F at the step's start.
            has_entered, entry, last = carry
            end = near + (i + 1).astype(near.dtype) * length
            now = value(end)
            enters = ~has_entered & (last > 0) & (now <= 0)
            return (has_entered | enters, jnp.where(enters, end, entry), now), None

        start = (jnp.array(False), far, value(near))
        (has_entered, entry, _), _ = jax.lax.scan(step, start, jnp.arange(self.steps))
        return has_entered & through, entry - length, entry

    def _polish(self, ray: Ray, distance: Scalar, hit: Bool[Array, ""]) -> Scalar:
        r"""Improve `distance` by a Newton step; derivatives of every order are exact.

        By the implicit function theorem, from $F(o + t d) = 0$:
        $\partial t = -\partial F / (\nabla F \cdot d)$ for any parameter of $F$, $o$ or
        $d$. To differentiate the Newton step itself would give exact first derivatives
        only, since it holds the point of intersection fixed.
        """

        def residual(along: Scalar) -> Scalar:
            # If the ray misses or only grazes the surface, the root is `distance`.
            return jnp.where(enters, self.function(ray.at(along)), along - distance)

        def solve(_: Any, start: Scalar) -> Scalar:
            value, slope = jax.value_and_grad(residual)(start)
            return start - value / slope

        def divide(linear: Callable[[Scalar], Scalar], change: Scalar) -> Scalar:
            # The solution of the scalar equation linear(x) = change.
            return change / linear(jnp.ones_like(change))

        distance = jax.lax.stop_gradient(distance)
        slope = dot(jax.grad(self.function)(ray.at(distance)), ray.direction)
        enters = jax.lax.stop_gradient(hit & (slope < 0))
        return jax.lax.custom_root(residual, distance, solve, divide)

    def _bisect(self, ray: Ray, before: Scalar, after: Scalar) -> Scalar:
        """Distance of the root of F between two distances, F > 0 at the first."""

        def halve(_: Any, span: tuple[Array, Array]) -> tuple[Array, Array]:
            low, high = span
            middle = (low + high) / 2
            outside = self.function(ray.at(middle)) > 0
            return jnp.where(outside, middle, low), jnp.where(outside, high, middle)

        # Two thirds of the digits: the Newton step of `_polish` gives the others.
        halvings = 2 * np.finfo(before.dtype).nmant // 3
        low, high = jax.lax.fori_loop(0, halvings, halve, (before, after))
        return (low + high) / 2
