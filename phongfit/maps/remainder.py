"""Residual images of maps, interpolated over light direction by kriging.

They contain cast shadows, interreflections and errors of the maps, and differ little
between lamps at similar directions. The correlation of two lamps is
exp(−angle / width), with the width that best predicts each photograph's residual image
from the others.

??? cite "Source"
    Rasmussen and Williams, *Gaussian Processes for Machine Learning*, 2006, equations
    2.25 and, for cross-validation from a single inverse, 5.12.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from phongfit.files.budget import afford
from phongfit.files.inputs import naming
from phongfit.lights import AbstractLight
from phongfit.maps.stacks import AbstractStack
from phongfit.scene import Scene

WIDTHS = np.geomspace(0.05, 5, 60)
"""Widths that are tried, radians: from below lamps' angles to over a hemisphere."""

NUGGET = 1e-6
"""Added to the diagonal of the correlation, since two lamps may have one position."""

SAMPLE = 30_000
"""Approximate number of pixels from which the width is estimated."""


class Remainder(NamedTuple):
    """Residual images of photographs, scaled to lamps of strength 1.

    - `middle`: point at which lamps' directions and strengths are taken, world units.
    - `directions`: unit vectors to the lamps.
    - `images`: linear light, of half precision.
    - `width`: angle of the correlation between lamps, radians.
    """

    middle: Float[np.ndarray, "3"]
    directions: Float[np.ndarray, "lamps 3"]
    images: Float[np.ndarray, "lamps height width 3"]
    width: float

    def under(self, light: AbstractLight) -> Float[np.ndarray, "height width 3"]:
        """Interpolated residual image under another lamp, linear light."""
        direction, strength = _lamp("lights", light, self.middle)
        shared = _common(self.directions, direction[None], self.width)[:, 0]
        weights = np.linalg.solve(_among(self.directions, self.width), shared)
        total = np.zeros(self.images.shape[1:], np.float32)
        for weight, image in zip(weights, self.images, strict=True):
            total += np.float32(weight) * image
        return total * strength.astype(np.float32)


def find_remainder(
    show: Callable[[AbstractLight, Any], np.ndarray],
    scenes: Sequence[Scene],
    stack: AbstractStack,
    middle: Float[np.ndarray, "3"],
) -> Remainder:
    """Compute the residual images of maps and the width of their correlation.

    A masked or white sample is a lower bound of the light, so its residual is at
    least 0.

    **Arguments:**

    - `show`: function from a light and ambient light to the maps' image, (H, W, 3).
    - `scenes`, `stack`: the photographs, one lamp each.
    - `middle`: middle of the object.

    **Raises:** `ValueError` that names the argument.
    """
    count, height, width = stack.shape
    if len(scenes) != count:
        raise ValueError(f"scenes: expected {count}, one an image, got {len(scenes)}")
    size = 2 * count * height * width * 3
    with naming("images"):
        afford(size, f"{count} photographs of {height} × {width} pixels to relight")
    images = np.empty((count, height, width, 3), np.float16)
    directions, every = np.empty((count, 3)), np.arange(height * width)
    for k, scene in enumerate(scenes):
        if len(scene.lights) != 1:
            raise ValueError(
                f"scenes[{k}]: expected one light, got {len(scene.lights)}"
            )
        (light,) = scene.lights
        directions[k], strength = _lamp(f"scenes[{k}]", light, middle)
        shown = show(light, scene.ambient)
        (taken,) = stack.take(every, [k])
        seen = np.ma.getdata(taken).reshape(shown.shape)
        hidden = np.ma.getmaskarray(taken).reshape(shown.shape) | (seen >= 1)
        left = np.where(hidden, np.maximum(seen - shown, 0), seen - shown)
        # A channel without light is not scaled, to avoid a division by 0.
        left = left / np.where(strength > 0, strength, 1)
        images[k] = np.nan_to_num(left, posinf=0, neginf=0)
    return Remainder(middle, directions, images, _width(directions, images))


def _lamp(
    name: str, light: AbstractLight, middle: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Direction and strength of a lamp at a point."""
    if not light.directed:
        raise ValueError(f"{name}: expected a lamp, got light from all around")
    found = light.illuminate(jnp.asarray(middle, jnp.result_type(float)))
    return np.asarray(found.to_light, float), np.asarray(found.intensity, float)


def _common(
    some: Float[np.ndarray, "m 3"], others: Float[np.ndarray, "n 3"], width: float
) -> Float[np.ndarray, "m n"]:
    """Correlation between lamps, from the angles between them."""
    # The chord is more precise than a cosine for small angles.
    apart = np.linalg.norm(some[:, None] - others, axis=-1)
    angle = 2 * np.arcsin(np.minimum(apart / 2, 1))
    return np.exp(-angle / width)


def _among(directions: Float[np.ndarray, "n 3"], width: float) -> np.ndarray:
    """Correlation matrix of the photographs' lamps, with the nugget."""
    own = NUGGET * np.eye(len(directions))
    return _common(directions, directions, width) + own


def _width(
    directions: Float[np.ndarray, "lamps 3"], images: Float[np.ndarray, "lamps h w 3"]
) -> float:
    """The width of least cross-validation error: Rasmussen and Williams, 5.12."""
    flat = images.reshape(len(images), -1, 3)
    some = flat[:, :: max(flat.shape[1] // SAMPLE, 1)].reshape(len(images), -1)
    products = some.astype(float) @ some.astype(float).T

    def missed(width: float) -> float:
        inverse = np.linalg.inv(_among(directions, width))
        return float(
            (np.diag(inverse @ products @ inverse) / np.diag(inverse) ** 2).sum()
        )

    return float(min(WIDTHS, key=missed))
