"""Fog between the surface and the camera."""

from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from phongfit.checks import as_light, as_scalar, at_least
from phongfit.edge import checked
from phongfit.vectors import Rgb

FogMode = Literal["linear", "exp", "exp2"]


class Fog(eqx.Module):
    r"""Light that fades into a colour with the depth $z$ along the viewing axis.

    $$I = f\,I_\text{surface} + (1 - f)\,C \qquad f = \frac{e - z}{e - s},
    \quad e^{-\rho z} \quad\text{or}\quad e^{-(\rho z)^2}$$

    for the modes `"linear"`, `"exp"` and `"exp2"`, with $f$ cut to [0, 1]. $C$ is the
    fog's `color`, $s$ its `start`, $e$ its `end` and $\rho$ its `density`.

    ??? cite "Source"
        Segal and Akeley, *The OpenGL graphics system, version 1.5*, section 3.10.
    """

    color: Rgb
    mode: FogMode = eqx.field(static=True)
    density: Float[Array, ""]
    start: Float[Array, ""]
    end: Float[Array, ""]

    @checked
    def __init__(
        self,
        color: Any = 0.5,
        mode: FogMode = "exp",
        *,
        density: Any = 1.0,
        start: Any = 0.0,
        end: Any = 1.0,
    ):
        r"""**Arguments:**

        - `color`: RGB or one number.
        - `mode`: `"linear"`, `"exp"` or `"exp2"`.
        - `density`: ≥ 0, per world unit; used by the two exponential modes only.
        - `start`, `end`: depths at which linear fog begins and hides everything, world
            units; used by `"linear"` only, for which they must differ.

        **Raises:** `ValueError` that names the argument.
        """
        self.color = as_light("color", color)
        self.mode = mode
        self.density = at_least("density", as_scalar("density", density), 0)
        self.start = as_scalar("start", start)
        self.end = as_scalar("end", end)
        # Traced depths cannot be compared here.
        known = not any(isinstance(x, Tracer) for x in (self.start, self.end))
        if mode == "linear" and known and self.start == self.end:
            raise ValueError(f"end: expected a depth other than start, got {end}")

    def transmittance(self, depth: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Fraction in [0, 1] of the surface's light that reaches the camera.

        **Arguments:** `depth`: distance from the camera along its viewing axis, world
        units.
        """
        if self.mode == "linear":
            fraction = (self.end - depth) / (self.end - self.start)
        elif self.mode == "exp":
            fraction = jnp.exp(-self.density * depth)
        else:
            fraction = jnp.exp(-((self.density * depth) ** 2))
        return jnp.clip(fraction, 0, 1)
