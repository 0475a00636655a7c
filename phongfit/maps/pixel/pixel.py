"""Results of fits of pixels, and the inputs that all pixels share."""

from typing import Any, NamedTuple

from jaxtyping import Array, Float, Int

from phongfit.maps.pixel.lighting import Lighting


class PixelFit(NamedTuple):
    """Fits of pixels, which are the first axis.

    - `ambient`, `diffuse`, `specular`: reflectances; `shininess`: exponents, one for
        each channel or one for all.
    - `stderr`: standard errors of these four by name, infinite if not identified and 0
        if known.
    - `noise`: root mean square of the residuals per degree of freedom, in linear light,
        or in standard deviations of the samples.
    - `samples`: number of samples in use.
    - `flags`: bits of [`Flag`][].
    - `normals`, `normals_stderr`: if fitted, unit vectors in world axes and their
        errors in degrees.
    - `weights`: if pixels share materials, probability of each material.
    """

    ambient: Float[Array, "pixels 3"]
    diffuse: Float[Array, "pixels 3"]
    specular: Float[Array, "pixels 3"]
    shininess: Float[Array, "pixels exponents"]
    stderr: dict[str, Array]
    noise: Float[Array, " pixels"]
    samples: Int[Array, " pixels"]
    flags: Int[Array, " pixels"]
    normals: Float[Array, "pixels 3"] | None = None
    normals_stderr: Float[Array, " pixels"] | None = None
    weights: Float[Array, "pixels materials"] | None = None

    def arrays(self) -> dict[str, Array]:
        """All arrays, by their names in files of maps."""
        named: dict[str, Any] = self._asdict()
        errors = {f"stderr_{name}": e for name, e in named.pop("stderr").items()}
        return {name: a for name, a in named.items() if a is not None} | errors


class Known(NamedTuple):
    """Known parameters of the material, and the start value of the exponent.

    (3,) each, and (1,) for a shared exponent.
    """

    ambient: Float[Array, "3"]
    diffuse: Float[Array, "3"]
    specular: Float[Array, "3"]
    shininess: Float[Array, " exponents"]

    def spread(self) -> "Known":
        """The values with an axis along the pixels, of length 1."""
        return Known(*(leaf[:, None] for leaf in self))


class Outside(NamedTuple):
    """Values that all pixels share: lights, known parameters, and the noise level.

    `noise` is the standard deviation of a sample in linear light, 1 if
    `settings.weighted`; not read if `settings.noise_given` is false.
    """

    lighting: Lighting
    known: Known
    noise: Float[Array, ""]
