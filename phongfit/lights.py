"""Lights: the direction and the colours of the light that arrives at a point.

A light has no parameters of materials. As in OpenGL it has a colour for each term:
`intensity` for the diffuse one, `specular` (by default the intensity) and `ambient` (by
default 0).
"""

import abc
import math
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from phongfit.checks import (
    as_floats,
    as_light,
    as_scalar,
    as_vector,
    at_least,
    finite,
    nonzero,
    require,
)
from phongfit.vectors import Rgb, Scalar, Vec3, dot, norm, normalize, power


class Illumination(eqx.Module):
    """One light as it arrives at a point, with attenuation and spot cone applied.

    **Fields:**

    - `to_light`: unit vector from the point to the light.
    - `intensity`, `specular`, `ambient`: RGB that arrives for the diffuse, specular and
        ambient term.
    - `distance`: from the point to the light, world units; inf for parallel rays.
    """

    to_light: Vec3
    intensity: Vec3
    specular: Vec3
    ambient: Vec3
    distance: Scalar


class AbstractLight(eqx.Module):
    """Base class of lights: `illuminate` gives the [`Illumination`][] of one point.

    Some lights have a sharp edge, such as the rim of a spot's cone. `covers` is true
    for points inside of it; `jumps` names the fields that only move the edge. The light
    at a point jumps as they change, so derivatives with respect to them are zero or
    undefined.

    Light from all around has `directed = False`, and `surround` gives its RGB.
    """

    jumps: ClassVar[tuple[str, ...]] = ()
    directed: ClassVar[bool] = True

    def covers(self, position: Vec3) -> Bool[Array, ""]:
        """Whether `position` (world units) is inside of the light's edge, if any."""
        del position
        return jnp.array(True)

    @abc.abstractmethod
    def illuminate(self, position: Vec3) -> Illumination:
        """Direction and light that arrives at `position` (world units)."""

    def surround(self, normal: Vec3) -> Vec3:
        """RGB for the diffuse term from all around, where the unit normal is `normal`.

        Zero for lights with a direction.
        """
        return jnp.zeros_like(normal)


def _as_colour(name: str, value: Any) -> Vec3 | None:
    """`value` as RGB light; `None`, which stands for a light's intensity, is kept."""
    return None if value is None else as_light(name, value)


def brighter(light: AbstractLight, factor: Any) -> AbstractLight:
    """A copy of a light whose intensity, specular and ambient colour are multiplied.

    **Arguments:** `factor`: a number, or RGB.

    **Raises:** `ValueError` if the light has no intensity that can be multiplied.
    """
    names = [
        name
        for name in ("intensity", "ambient", "specular")
        if getattr(light, name, None) is not None
    ]
    if "intensity" not in names:
        raise ValueError(
            f"lights: expected lights with an intensity, got a {type(light).__name__}, "
            "which has none"
        )

    def parts(light: AbstractLight) -> list[Any]:
        return [getattr(light, name) for name in names]

    more = [part * jnp.asarray(factor, part.dtype) for part in parts(light)]
    return eqx.tree_at(parts, light, more)


class DirectionalLight(AbstractLight):
    """Parallel rays: the sun, or a lamp far away."""

    direction: Float[Array, "3"]
    intensity: Rgb
    specular: Rgb | None
    ambient: Rgb

    def __init__(
        self,
        direction: Any,
        intensity: Any = 1.0,
        *,
        specular: Any = None,
        ambient: Any = 0.0,
    ):
        """**Arguments:**

        - `direction`: from the scene *to* the light, in the world's axes; any length
            but 0.
        - `intensity`: RGB ≥ 0, or one number for all three.
        - `specular`, `ambient`: RGB or one number, for the specular and the ambient
            term; default `intensity` and 0.

        **Raises:** `ValueError` for a zero direction or a negative colour.
        """
        self.direction = nonzero("direction", as_vector("direction", direction))
        self.intensity = as_light("intensity", intensity)
        self.specular = _as_colour("specular", specular)
        self.ambient = as_light("ambient", ambient)

    def illuminate(self, position: Vec3) -> Illumination:
        far = jnp.full((), jnp.inf, position.dtype)
        return _arriving(self, normalize(self.direction), far)


def _as_attenuation(value: Any) -> Vec3:
    """`value` as three attenuation coefficients ≥ 0, not all 0; else `ValueError`."""
    attenuation = at_least("attenuation", as_vector("attenuation", value), 0)
    wanted = "one coefficient above 0"
    return require("attenuation", attenuation, lambda a: (a > 0).any(), wanted)


def _attenuation(coefficients: Vec3, distance: Scalar) -> Scalar:
    """The factor 1 / (a0 + a1 d + a2 d²) on light at a distance d, in world units."""
    constant, linear, quadratic = coefficients
    denominator = constant + linear * distance + quadratic * distance**2
    positive = denominator > 0
    # At distance 0 and without a constant term the factor is set to 0: the direction to
    # the light is zero there, and 0 times infinity would be NaN.
    return jnp.where(positive, 1 / jnp.where(positive, denominator, 1), 0)


class PointLight(AbstractLight):
    r"""A bulb: light falls off with distance d as $1 / (a_0 + a_1 d + a_2 d^2)$."""

    position: Float[Array, "3"]
    attenuation: Float[Array, "3"]
    intensity: Rgb
    specular: Rgb | None
    ambient: Rgb

    def __init__(
        self,
        position: Any,
        intensity: Any = 1.0,
        *,
        attenuation: Any = (1.0, 0.0, 0.0),
        specular: Any = None,
        ambient: Any = 0.0,
    ):
        """**Arguments:**

        - `position`: world units.
        - `intensity`: RGB ≥ 0, or one number for all three.
        - `attenuation`: $a_0$ without unit, $a_1$ per world unit and $a_2$ per square
            of it; all ≥ 0, not all 0. The default does not fall off.
        - `specular`, `ambient`: RGB or one number, for the specular and the ambient
            term; default `intensity` and 0.

        **Raises:** `ValueError` that names the argument.
        """
        self.position = as_vector("position", position)
        self.intensity = as_light("intensity", intensity)
        self.attenuation = _as_attenuation(attenuation)
        self.specular = _as_colour("specular", specular)
        self.ambient = as_light("ambient", ambient)

    def illuminate(self, position: Vec3) -> Illumination:
        return _from_bulb(self, position)


class SpotLight(AbstractLight):
    r"""A point light in a hood: $\cos^e$ of the angle from its axis, 0 past the cutoff.

    It falls off with distance as a [`PointLight`][] does.

    ??? cite "Source"
        Segal and Akeley, *The OpenGL graphics system, version 1.5*, section 2.14.1.
    """

    jumps: ClassVar[tuple[str, ...]] = ("cutoff",)

    position: Float[Array, "3"]
    axis: Float[Array, "3"]
    cutoff: Float[Array, ""]
    exponent: Float[Array, ""]
    attenuation: Float[Array, "3"]
    intensity: Rgb
    specular: Rgb | None
    ambient: Rgb

    def __init__(
        self,
        position: Any,
        axis: Any,
        intensity: Any = 1.0,
        *,
        cutoff: Any = 45.0,
        exponent: Any = 0.0,
        attenuation: Any = (1.0, 0.0, 0.0),
        specular: Any = None,
        ambient: Any = 0.0,
    ):
        """**Arguments:**

        - `position`: world units.
        - `axis`: from the light towards the scene, in the world's axes: the middle of
            the cone. Any length but 0.
        - `intensity`: RGB ≥ 0, or one number for all three.
        - `cutoff`: half the cone's angle in degrees, in (0, 90].
        - `exponent`: $e$ ≥ 0; 0 is even light inside the cone.
        - `attenuation`, `specular`, `ambient`: as in [`PointLight`][].

        **Raises:** `ValueError` that names the argument.
        """
        self.position = as_vector("position", position)
        self.axis = nonzero("axis", as_vector("axis", axis))
        angle = as_scalar("cutoff", cutoff)
        self.cutoff = require(
            "cutoff", angle, lambda a: (a > 0) & (a <= 90), "degrees in (0, 90]"
        )
        self.exponent = at_least("exponent", as_scalar("exponent", exponent), 0)
        self.intensity = as_light("intensity", intensity)
        self.attenuation = _as_attenuation(attenuation)
        self.specular = _as_colour("specular", specular)
        self.ambient = as_light("ambient", ambient)

    def illuminate(self, position: Vec3) -> Illumination:
        spot = power(self._cosine(position), self.exponent)
        return _from_bulb(self, position, jnp.where(self.covers(position), spot, 0))

    def covers(self, position: Vec3) -> Bool[Array, ""]:
        return self._cosine(position) >= jnp.cos(jnp.deg2rad(self.cutoff))

    def _cosine(self, position: Vec3) -> Scalar:
        """Cosine of the angle between the axis and the direction to a point."""
        return dot(normalize(position - self.position), normalize(self.axis))


# Norms of the real harmonics up to order 2: _Y0 of 1; _Y1 of x, y, z; _Y2 of xy, yz and
# xz; _Y20 of 3z² − 1; _Y22 of x² − y². And the factors A_l / π by order l, with which
# Lambert's cosine multiplies them.
_Y0, _Y1 = math.sqrt(1 / (4 * math.pi)), math.sqrt(3 / (4 * math.pi))
_Y2 = math.sqrt(15 / (4 * math.pi))
_Y20, _Y22 = _Y2 / math.sqrt(12), _Y2 / 2
_LAMBERT = 1.0, 2 / 3, 1 / 4


class HarmonicLight(AbstractLight):
    r"""Light from all around that changes slowly with direction: sky, walls, a room.

    Its radiance is $L(\omega) = \sum_{lm} L_{lm} Y_{lm}(\omega)$ with real spherical
    harmonics up to order 2, and a matte surface with normal $m$ sends back
    $\rho_d E(m) / \pi$ of the irradiance

    $$E(m) = \sum_{lm} A_l L_{lm} Y_{lm}(m) \qquad A_0 = \pi,\; A_1 = 2\pi/3,\;
    A_2 = \pi/4$$

    which approximates the irradiance of any distant surroundings to a few per cent.
    Where the nine coefficients give a negative irradiance it is set to 0. It enters the
    diffuse term and is multiplied by ρ_d; the scene's `ambient` light is multiplied by
    ρ_a. It makes no highlight and casts no shadow.

    ??? cite "Source"
        Ramamoorthi and Hanrahan, *An efficient representation for irradiance
        environment maps*, SIGGRAPH 2001.
    """

    directed: ClassVar[bool] = False

    coefficients: Float[Array, "9 3"]

    def __init__(self, coefficients: Any):
        r"""**Arguments:**

        - `coefficients`: $L_{00}$; $L_{1,-1}$, $L_{10}$, $L_{11}$ (of y, z, x);
            $L_{2,-2}$, $L_{2,-1}$, $L_{20}$, $L_{21}$, $L_{22}$ (of xy, yz, 3z² − 1,
            xz, x² − y²), in the world's axes: (9, 3) RGB, or (9,) or (9, 1) for all
            channels.
            Light of 1 from everywhere, which shows white as 1, is $L_{00} =
            \sqrt{4\pi}$ alone.

        **Raises:** `ValueError` that names the argument.
        """
        array = as_floats("coefficients", coefficients)
        if array.shape not in ((9,), (9, 1), (9, 3)):
            raise ValueError(
                f"coefficients: expected shape (9,) or (9, 3), got {array.shape}"
            )
        array = jnp.broadcast_to(array.reshape(9, -1), (9, 3))
        self.coefficients = require("coefficients", array, finite, "finite numbers")

    def illuminate(self, position: Vec3) -> Illumination:
        none = jnp.zeros_like(position)
        # Light from all around has no direction; shadow rays need a unit vector. It has
        # no effect, since no light comes from there.
        nowhere = jnp.array([0, 0, 1], position.dtype)
        far = jnp.full((), jnp.inf, position.dtype)
        return Illumination(nowhere, none, none, none, far)

    def surround(self, normal: Vec3) -> Vec3:
        x, y, z = normal
        # The order of `basis` is that of the coefficients.
        order_0, order_1, order_2 = _LAMBERT
        band = order_2 * _Y2
        basis = (
            order_0 * _Y0 * jnp.ones_like(x),
            *(order_1 * _Y1 * part for part in (y, z, x)),
            *(band * part for part in (x * y, y * z)),
            order_2 * _Y20 * (3 * z * z - 1),
            band * x * z,
            order_2 * _Y22 * (x * x - y * y),
        )
        total = jnp.zeros_like(normal)
        for value, light in zip(basis, self.coefficients, strict=True):
            total = total + value * light
        return jnp.maximum(total, 0)


def _from_bulb(
    light: PointLight | SpotLight, position: Vec3, spot: Scalar | float = 1.0
) -> Illumination:
    """Light of a point light or spot that arrives at `position`, world units.

    **Arguments:** `spot`: fraction of the light that a hood sends in this direction.
    """
    offset = light.position - position
    distance = norm(offset)
    fraction = spot * _attenuation(light.attenuation, distance)
    return _arriving(light, normalize(offset), distance, fraction)


def _arriving(
    light: DirectionalLight | PointLight | SpotLight,
    to_light: Vec3,
    distance: Scalar,
    fraction: Scalar | float = 1.0,
) -> Illumination:
    """A light as it arrives at a point: `fraction` times its colours."""
    specular = light.intensity if light.specular is None else light.specular
    return Illumination(
        to_light,
        fraction * light.intensity,
        fraction * specular,
        fraction * light.ambient,
        distance,
    )
