"""What arrives at pixels from all lamps, whatever their normals are."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from phongfit.maps.pixel.lighting import Lighting
from phongfit.vectors import Scalar

T = TypeVar("T")


class Lamps(NamedTuple):
    """Light at pixels. The last axis is the pixels, or 1 where all get the same.

    - `to_light`: (images, lights, 3, pixels) unit vectors; zeros where an image has
        fewer lights than another.
    - `diffuse`, `specular`: (images, lights, channels, pixels): what a surface that
        faces the light sends back for ρ_d = 1, and a highlight's centre for ρ_s = 1.
    - `ambient`, `veil`: (images, channels, pixels): ambient light for ρ_a = 1, and what
        fog adds.
    - `to_viewer`: (3, pixels) unit vectors.
    """

    to_light: Float[Array, "images lights 3 #pixels"]
    diffuse: Float[Array, "images lights channels #pixels"]
    specular: Float[Array, "images lights channels #pixels"]
    ambient: Float[Array, "images channels #pixels"]
    veil: Float[Array, "images channels #pixels"]
    to_viewer: Float[Array, "3 #pixels"]


def make_lamps(
    lighting: Lighting,
    position: Float[Array, "#pixels 3"],
    to_viewer: Float[Array, "#pixels 3"],
    visibility: Float[Array, "images lobes #pixels"] | None = None,
) -> Lamps:
    """The lamps of all images, in the order of the lighting's rows.

    **Arguments:**

    - `position`: world units, (pixels, 3), or (1, 3) if it is the same for all.
    - `to_viewer`: unit vectors, likewise.
    - `visibility`: how much of each light arrives, in [0, 1]; `None` for all of it.
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
    """What a function of one pixel's vectors is at all of them; pixels come last.

    The vectors are handed on as numbers that stand side by side: as rows of an array
    with an axis of three, compilers take them one by one, at five times the price.
    """
    pixels = max(vector.shape[1] for vector in vectors)

    def of_numbers(*numbers: tuple[Scalar, ...]) -> T:
        return function(*map(jnp.stack, numbers))

    # What is the same for all is worked out once.
    each = [vector.shape[1] == pixels for vector in vectors]
    rows = [
        tuple(vector) if own else tuple(vector[:, 0])
        for own, vector in zip(each, vectors, strict=True)
    ]
    axes = tuple(0 if own else None for own in each)
    return jax.vmap(of_numbers, in_axes=axes, out_axes=-1)(*rows)


def grey(lamps: Lamps) -> Lamps:
    """The mean over the channels, as one channel."""
    return lamps._replace(
        diffuse=jnp.mean(lamps.diffuse, axis=2, keepdims=True),
        specular=jnp.mean(lamps.specular, axis=2, keepdims=True),
        ambient=jnp.mean(lamps.ambient, axis=1, keepdims=True),
        veil=jnp.mean(lamps.veil, axis=1, keepdims=True),
    )


def facing(lamps: Lamps) -> Float[Array, "images 3 pixels"]:
    r"""$\sum_j e_j s_j$ of each image, grey: a matte surface shows $\rho\, n \cdot$ it.

    While none of its lights is behind the surface.
    """
    strength = jnp.mean(lamps.diffuse, axis=2, keepdims=True)
    return jnp.sum(lamps.to_light * strength, axis=1)
