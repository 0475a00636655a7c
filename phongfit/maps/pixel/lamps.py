"""Light that arrives at pixels from all lights, independent of the normals."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from phongfit.maps.pixel.lighting import Lighting
from phongfit.vectors import Scalar

T = TypeVar("T")


class Lamps(NamedTuple):
    """Light at pixels. The last axis is the pixels, or 1 if all get equal light.

    - `to_light`: (images, lights, 3, pixels) unit vectors; zeros where an image has
        fewer lights than another.
    - `diffuse`, `specular`: (images, lights, channels, pixels): reflected light of a
        surface that faces the light for ρ_d = 1, and of a highlight's centre for
        ρ_s = 1.
    - `ambient`, `veil`: (images, channels, pixels): ambient light for ρ_a = 1, and the
        light that fog adds.
    - `to_viewer`: (3, pixels) unit vectors.
    - `around`: (images, channels, pixels): reflected light from all around for ρ_d = 1;
        only if the normals are known.
    """

    to_light: Float[Array, "images lights 3 #pixels"]
    diffuse: Float[Array, "images lights channels #pixels"]
    specular: Float[Array, "images lights channels #pixels"]
    ambient: Float[Array, "images channels #pixels"]
    veil: Float[Array, "images channels #pixels"]
    to_viewer: Float[Array, "3 #pixels"]
    around: Float[Array, "images channels #pixels"] | None = None


def make_lamps(
    lighting: Lighting,
    position: Float[Array, "#pixels 3"],
    to_viewer: Float[Array, "#pixels 3"],
    visibility: Float[Array, "images lobes #pixels"] | None = None,
) -> Lamps:
    """Light at pixels in all images, in the order of the lighting's rows.

    **Arguments:**

    - `position`: world units, (pixels, 3), or (1, 3) if equal for all pixels.
    - `to_viewer`: unit vectors, (pixels, 3) or (1, 3).
    - `visibility`: fraction of each light that arrives, in [0, 1]; `None`: 1.
    """
    over_pixels = jax.vmap(lighting.arriving, in_axes=(None, 0), out_axes=-1)
    parts = [
        jax.vmap(over_pixels, in_axes=(0, None))(kind, position)
        for kind in lighting.kinds
    ]
    leaves = zip(*parts, strict=True)
    light, diffuse, specular, ambient, veil = map(jnp.concatenate, leaves)
    if visibility is not None:
        seen = visibility[:, :, None]
        diffuse, specular = diffuse * seen, specular * seen
    return Lamps(light, diffuse, specular, ambient, veil, to_viewer.T)


def at_pixels(function: Callable[..., T], *vectors: Float[Array, "3 #pixels"]) -> T:
    """Apply a function of one pixel's vectors to all pixels, which come last.

    Each component of a vector is passed as a separate array over the pixels. As rows of
    an array with an axis of three, XLA would process them one by one, which takes five
    times as long.
    """
    pixels = max(vector.shape[1] for vector in vectors)

    def of_numbers(*numbers: tuple[Scalar, ...]) -> T:
        return function(*map(jnp.stack, numbers))

    # Vectors that are equal for all pixels are not batched, so they are used once.
    each = [vector.shape[1] == pixels for vector in vectors]
    rows = [
        tuple(vector) if own else tuple(vector[:, 0])
        for own, vector in zip(each, vectors, strict=True)
    ]
    axes = tuple(0 if own else None for own in each)
    return jax.vmap(of_numbers, in_axes=axes, out_axes=-1)(*rows)


def grey(lamps: Lamps) -> Lamps:
    """Lamps with one channel: the mean over the channels."""
    return lamps._replace(
        diffuse=jnp.mean(lamps.diffuse, axis=2, keepdims=True),
        specular=jnp.mean(lamps.specular, axis=2, keepdims=True),
        ambient=jnp.mean(lamps.ambient, axis=1, keepdims=True),
        veil=jnp.mean(lamps.veil, axis=1, keepdims=True),
    )


def facing(lamps: Lamps) -> Float[Array, "images 3 pixels"]:
    r"""Light vector $\sum_j e_j s_j$ of each image, grey.

    A matte surface shows $\rho\, n$ times this vector if none of the image's lights is
    behind it.
    """
    strength = jnp.mean(lamps.diffuse, axis=2, keepdims=True)
    return jnp.sum(lamps.to_light * strength, axis=1)
