"""What maps leave of their photographs: cast shadows, light that bounced, rough edges.

It is as true as a photograph is, and differs little between lamps that stand close
together. So it can be shown under other lamps: interpolated by kriging, with
exp(−angle / width) for how much lamps at an angle have in common. The width is the one
that tells best each photograph's remainder from the others'.

??? cite "Source"
    Rasmussen and Williams, *Gaussian Processes for Machine Learning*, 2006, equations
    2.25 and, for leaving one out without solving anew, 5.12.
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
"""Angles that are tried, radians: from far below lamps' distance to a hemisphere."""

NUGGET = 1e-6
"""Of what lamps have in common, kept apart: two may stand in one place."""

SAMPLE = 30_000
"""Pixels, about, that the width is found from."""


class Remainder(NamedTuple):
    """What is left of photographs, each for a lamp of strength 1.

    - `middle`: from where lamps' directions and strengths are taken, world units.
    - `directions`: unit vectors to the lamps.
    - `images`: linear light, of half precision.
    - `width`: angle over which lamps have something in common, radians.
    """

    middle: Float[np.ndarray, "3"]
    directions: Float[np.ndarray, "lamps 3"]
    images: Float[np.ndarray, "lamps height width 3"]
    width: float

    def under(self, light: AbstractLight) -> Float[np.ndarray, "height width 3"]:
        """The remainder under another lamp, linear light."""
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
    """What maps leave of photographs.

    A sample that is masked, or white, tells no more than that its light is not less.

    **Arguments:**

    - `show`: what the maps show of a light, and of ambient light: (H, W, 3).
    - `scenes`, `stack`: the photographs, one lamp each.
    - `middle`: of the object.

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
        # Where no lamp's light arrives there is nothing to tell its strength by.
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
    """How much lamps have in common, by the angles between them."""
    # Better than a cosine where lamps are close.
    apart = np.linalg.norm(some[:, None] - others, axis=-1)
    angle = 2 * np.arcsin(np.minimum(apart / 2, 1))
    return np.exp(-angle / width)


def _among(directions: Float[np.ndarray, "n 3"], width: float) -> np.ndarray:
    """The same of the photographs' own lamps."""
    own = NUGGET * np.eye(len(directions))
    return _common(directions, directions, width) + own


def _width(
    directions: Float[np.ndarray, "lamps 3"], images: Float[np.ndarray, "lamps h w 3"]
) -> float:
    """That tells each image best from the others: Rasmussen and Williams, 5.12."""
    flat = images.reshape(len(images), -1, 3)
    some = flat[:, :: max(flat.shape[1] // SAMPLE, 1)].reshape(len(images), -1)
    products = some.astype(float) @ some.astype(float).T

    def missed(width: float) -> float:
        inverse = np.linalg.inv(_among(directions, width))
        return float(
            (np.diag(inverse @ products @ inverse) / np.diag(inverse) ** 2).sum()
        )

    return float(min(WIDTHS, key=missed))
