r"""Basis of the light of pixels: $I = \rho_a A + \rho_d D + \rho_s S(f)$."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from phongfit.maps.pixel.lamps import Lamps, at_pixels
from phongfit.maps.pixel.lighting import Lighting
from phongfit.maps.pixel.lobes import AbstractLobes, Angles
from phongfit.maps.pixel.samples import Tile, pixels_last
from phongfit.maps.pixel.settings import MapSettings
from phongfit.maps.pixel.small import Numbers
from phongfit.reflectance import lambert
from phongfit.vectors import Scalar, Vec3, dot


class Basis(NamedTuple):
    r"""The basis of pixels. An image of several lights has a highlight for each.

    - `ambient`, `diffuse`: A and D, light for $\rho_a = 1$ and $\rho_d = 1$.
    - `strength`: light of each highlight at its centre, for $\rho_s = 1$.
    - `angles`: arguments of each highlight's lobe: see [`AbstractLobes`][].
    """

    ambient: Float[Array, "images #channels #pixels"]
    diffuse: Float[Array, "images #channels pixels"]
    strength: Float[Array, "images lobes #channels #pixels"]
    angles: Angles

    def specular(
        self, lobes: AbstractLobes, t: Float[Array, "groups #pixels"]
    ) -> Float[Array, "images channels pixels"]:
        """Highlights S at exponents e^t."""
        return jax.lax.map(self._highlight(lobes, t), (self.strength, self.angles))

    def light_of_image(
        self,
        columns: tuple[str, ...],
        point: Numbers,
        lobes: AbstractLobes | None,
        t: Float[Array, "groups pixels"],
    ) -> "Callable[[Basis], Float[Array, 'channels pixels']]":
        """A function from one image's basis to its light.

        **Arguments:** `point`: the reflectances of `columns`, then ρ_s; without the
        highlight if `lobes` is `None`.
        """
        highlight = None if lobes is None else self._highlight(lobes, t)

        def light(image: Basis) -> Array:
            total = jnp.zeros_like(image.diffuse)
            for name, x in zip(columns, point, strict=False):
                total = total + x * getattr(image, name)
            if highlight is None:
                return total
            return total + point[-1] * highlight((image.strength, image.angles))

        return light

    def _highlight(
        self, lobes: AbstractLobes, t: Float[Array, "groups #pixels"]
    ) -> Callable[[tuple], Array]:
        """A function from an image's strengths and angles to its highlight S."""
        height = lobes.at(t)

        def highlight(image: tuple) -> Array:
            strength, angles = image
            light = jnp.zeros((strength.shape[1], t.shape[1]), t.dtype)
            for j, one in enumerate(strength):
                angle = jax.tree.map(lambda a, j=j: a[j][None], angles)
                light = light + one * height(angle)[0]
            return light

        return highlight


def make_basis(
    tile: Tile, lighting: Lighting, lamps: Lamps, settings: MapSettings
) -> tuple[Basis, Float[Array, "images pixels"]]:
    """The basis of a tile's pixels, and 1 for images that light a pixel, else 0.

    An image lights a pixel if one of its lights arrives at a cosine above
    `settings.min_cosine`, or if the image has only light from all around.
    """
    model, lobes = settings.model, settings.lobes
    normal = pixels_last(tile.normal)
    directed = jnp.asarray(lighting.directed)
    seen = tile.visibility

    def pixel(normal: Vec3, light: Vec3, viewer: Vec3) -> tuple[Scalar, Scalar, PyTree]:
        share = model.diffuse_scale() * lambert(normal, light)
        return share, dot(normal, light), model.cosine(normal, light, viewer)

    def image(each: tuple) -> tuple[Array, PyTree, Array]:
        lights, intensity, directed, seen = each
        diffuse = jnp.zeros((intensity.shape[1], normal.shape[1]), normal.dtype)
        lit = jnp.broadcast_to(~jnp.any(directed), normal.shape[1:])
        angles = []
        for j, light in enumerate(lights):
            share, reached, cosine = at_pixels(pixel, normal, light, lamps.to_viewer)
            diffuse = diffuse + share[None] * intensity[j]
            reaches = directed[j] & (reached > settings.min_cosine)
            lit = lit | (reaches if seen is None else reaches & (seen[j] > 0))
            angles.append(lobes.angles(cosine))
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *angles)
        return diffuse, stacked, lit.astype(normal.dtype)

    each = lamps.to_light, lamps.diffuse, directed, seen
    diffuse, angles, lit = jax.lax.map(image, each)
    around = lighting.around(tile.position, tile.normal)
    if around is not None:
        diffuse = diffuse + around
    return Basis(lamps.ambient, diffuse, lamps.specular, angles), lit
