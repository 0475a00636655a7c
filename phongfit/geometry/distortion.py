r"""Lens distortion: from a direction to the place of its image, and back.

Axes follow the sources of the formulas: x right, y down, z forward. A place is a point
(x, y) of the image plane at distance 1, before multiplication by focal lengths in
pixels. For a fisheye lens its distance from (0, 0) is an angle in radians.
"""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from phongfit.checks import as_scalar
from phongfit.vectors import Vec3, norm

PlanePoint = Float[Array, "2"]

# In the first `CONTINUATION_STEPS` of Newton's method the target moves from the centre
# to its place, so that the solution stays on the branch through the centre. Each later
# step doubles the number of correct digits.
CONTINUATION_STEPS, NEWTON_STEPS = 6, 14
# Tolerance of a round trip through the distortion, relative to 1 + distance.
ROUND_TRIP_TOLERANCE = 1e-3


class AbstractDistortion(eqx.Module):
    """A lens's map from directions to places in the image, and its inverse.

    Both pass through the undistorted place, which `bend` moves to the distorted one.
    """

    @abc.abstractmethod
    def bend(self, place: PlanePoint) -> PlanePoint:
        """The distorted place of an undistorted one. (0, 0) must map to itself."""

    @abc.abstractmethod
    def ideal(self, direction: Vec3) -> PlanePoint:
        """Undistorted place of a direction, which may have any length.

        NaN for directions without one, such as those behind a pinhole.
        """

    @abc.abstractmethod
    def unproject(self, place: PlanePoint) -> Vec3:
        """A direction (of any length) with this undistorted place: see `ideal`."""

    def place(self, direction: Vec3) -> PlanePoint:
        """Distorted place of a direction, which may have any length.

        NaN where the formula folds the image back onto itself, and for directions
        without an undistorted image, such as those behind a pinhole.
        """
        ideal = self.ideal(direction)
        return jnp.where(_is_unfolded(self, ideal), self.bend(ideal), jnp.nan)

    def direction(self, place: PlanePoint) -> tuple[Vec3, Bool[Array, ""]]:
        """The direction (of any length) seen at a place, and whether there is one.

        There is none where the formula folds the image back on itself; the direction is
        then a finite placeholder.
        """
        ideal, found = _invert(self, place)
        return self.unproject(ideal), found


def _invert(
    distortion: AbstractDistortion, place: PlanePoint
) -> tuple[PlanePoint, Bool[Array, ""]]:
    """The undistorted place of a distorted one, and whether there is one.

    Derivatives are exact to second order.
    """
    estimate, found = _search_inverse(*jax.lax.stop_gradient((distortion, place)))
    # Two more steps, from a known start, carry derivatives to second order.
    for _ in range(2):
        move, _ = _newton(distortion, estimate, place)
        estimate = estimate + jnp.where(found, move, 0)
    return estimate, found


def _is_unfolded(distortion: AbstractDistortion, ideal: PlanePoint) -> Bool[Array, ""]:
    """Whether the distortion can be inverted at an undistorted place.

    Where the formula folds the image back, two places have the same distorted place;
    the inverse gives the one nearer to the centre.
    """
    constant, estimate = jax.lax.stop_gradient((distortion, ideal))
    back, found = _search_inverse(constant, constant.bend(estimate))
    tolerance = ROUND_TRIP_TOLERANCE * (1 + norm(estimate))
    return found & (norm(back - estimate) <= tolerance)


def _search_inverse(
    constant: AbstractDistortion, end: PlanePoint
) -> tuple[PlanePoint, Bool[Array, ""]]:
    """The undistorted place of the distorted place `end`, and whether there is one.

    By Newton's method; not differentiable.
    """

    def step(
        number: Array, state: tuple[PlanePoint, Array]
    ) -> tuple[PlanePoint, Array]:
        """Step `number` of Newton's method, while the image is unfolded."""
        estimate, unfolded_so_far = state
        fraction = jnp.minimum((number + 1) / CONTINUATION_STEPS, 1)
        target = end * fraction.astype(end.dtype)
        move, unfolded = _newton(constant, estimate, target)
        unfolded_so_far = unfolded_so_far & unfolded
        return jnp.where(unfolded_so_far, estimate + move, estimate), unfolded_so_far

    start = jnp.zeros_like(end), jnp.array(True)
    estimate, found = jax.lax.fori_loop(0, NEWTON_STEPS, step, start)
    tolerance = 100 * float(jnp.finfo(end.dtype).eps) * (1 + norm(end))
    return estimate, found & (norm(constant.bend(estimate) - end) < tolerance)


def _newton(
    distortion: AbstractDistortion, estimate: PlanePoint, target: PlanePoint
) -> tuple[PlanePoint, Bool[Array, ""]]:
    """A Newton step towards bend(x) = `target`, and whether the image is unfolded.

    It is unfolded where the Jacobian's determinant is positive; elsewhere the step is
    zero.
    """
    (a, b), (c, d) = jax.jacfwd(distortion.bend)(estimate)
    determinant = a * d - b * c
    unfolded = determinant > 0
    x, y = target - distortion.bend(estimate)
    move = jnp.stack([d * x - b * y, a * y - c * x])
    return jnp.where(unfolded, move / jnp.where(unfolded, determinant, 1), 0), unfolded


class BrownDistortion(AbstractDistortion):
    r"""Radial and tangential distortion, as OpenCV and COLMAP have it.

    With $x = X/Z$, $y = Y/Z$ and $r^2 = x^2 + y^2$ the distorted place is

    $$x' = c\,x + 2 p_1 x y + p_2 (r^2 + 2 x^2) \qquad
    y' = c\,y + p_1 (r^2 + 2 y^2) + 2 p_2 x y$$

    $$c = \frac{1 + k_1 r^2 + k_2 r^4 + k_3 r^6}{1 + k_4 r^2 + k_5 r^4 + k_6 r^6}$$

    ??? cite "Source"
        Brown, *Close-range camera calibration*, Photogrammetric Engineering 37(8),
        1971; the denominator and the order of the names are those of OpenCV's calib3d,
        and of COLMAP's `OPENCV` and `FULL_OPENCV`.
    """

    k1: Float[Array, ""]
    k2: Float[Array, ""]
    p1: Float[Array, ""]
    p2: Float[Array, ""]
    k3: Float[Array, ""]
    k4: Float[Array, ""]
    k5: Float[Array, ""]
    k6: Float[Array, ""]

    def __init__(
        self,
        k1: Any = 0.0,
        k2: Any = 0.0,
        p1: Any = 0.0,
        p2: Any = 0.0,
        k3: Any = 0.0,
        k4: Any = 0.0,
        k5: Any = 0.0,
        k6: Any = 0.0,
    ):
        """**Arguments:** the coefficients, in OpenCV's order; no units.

        **Raises:** `ValueError` that names the argument.
        """
        self.k1, self.k2, self.k3 = map(as_scalar, ("k1", "k2", "k3"), (k1, k2, k3))
        self.k4, self.k5, self.k6 = map(as_scalar, ("k4", "k5", "k6"), (k4, k5, k6))
        self.p1, self.p2 = as_scalar("p1", p1), as_scalar("p2", p2)

    def bend(self, place: PlanePoint) -> PlanePoint:
        x, y = place
        r2 = x * x + y * y
        above = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        below = 1 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6))
        radial = above / below
        return jnp.stack(
            [
                radial * x + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x),
                radial * y + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y,
            ]
        )

    def ideal(self, direction: Vec3) -> PlanePoint:
        return flat(direction)

    def unproject(self, place: PlanePoint) -> Vec3:
        return jnp.append(place, jnp.ones_like(place[0]))


class FisheyeDistortion(AbstractDistortion):
    r"""A fisheye lens: the angle $\theta$ off the axis becomes a distance $\theta_d$.

    $\theta_d$ is measured from the image's centre, in focal lengths, and $\theta$ in
    radians.

    $$\theta_d = \theta (1 + k_1 \theta^2 + k_2 \theta^4 + k_3 \theta^6
    + k_4 \theta^8)$$

    Directions beside and behind the camera have an image as well.

    ??? cite "Source"
        Kannala and Brandt, *A generic camera model and calibration method for
        conventional, wide-angle, and fish-eye lenses*, PAMI 28(8), 2006; the order of
        the names is that of OpenCV's `fisheye` and of COLMAP's `OPENCV_FISHEYE`.
    """

    k1: Float[Array, ""]
    k2: Float[Array, ""]
    k3: Float[Array, ""]
    k4: Float[Array, ""]

    def __init__(self, k1: Any = 0.0, k2: Any = 0.0, k3: Any = 0.0, k4: Any = 0.0):
        """**Arguments:** the coefficients; no units.

        **Raises:** `ValueError` that names the argument.
        """
        names = ("k1", "k2", "k3", "k4")
        self.k1, self.k2, self.k3, self.k4 = map(as_scalar, names, (k1, k2, k3, k4))

    def bend(self, place: PlanePoint) -> PlanePoint:
        x, y = place
        a2 = x * x + y * y
        return place * (
            1 + a2 * (self.k1 + a2 * (self.k2 + a2 * (self.k3 + a2 * self.k4)))
        )

    def ideal(self, direction: Vec3) -> PlanePoint:
        """The place at the angle of a direction off the axis, radians, from (0, 0)."""
        across, depth = direction[:2], direction[2]
        length = norm(across)
        off = length > 0
        # On the axis, angle / length is 0 / 0; its limit is 1 / depth.
        ratio = jnp.arctan2(length, depth) / jnp.where(off, length, 1)
        return jnp.where(off, ratio, 1 / jnp.where(depth > 0, depth, 1)) * across

    def unproject(self, place: PlanePoint) -> Vec3:
        angle = norm(place)
        off = angle > 0
        ratio = jnp.where(off, jnp.sin(angle) / jnp.where(off, angle, 1), 1)
        return jnp.append(ratio * place, jnp.cos(angle))


def flat(direction: Vec3) -> PlanePoint:
    """Place (X/Z, Y/Z) of a direction (X, Y, Z); NaN behind the pinhole, for Z ≤ 0."""
    ahead = direction[2] > 0
    return direction[:2] / jnp.where(ahead, direction[2], jnp.nan)
