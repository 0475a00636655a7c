"""Samples of photographs of a textured surface, with the texels that they see."""

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from phongfit.fitting.problem.inputs import Observation
from phongfit.fitting.problem.noise import (
    Moments,
    end_steps,
    film_moments,
    rounding_steps,
)
from phongfit.fitting.texels.sums import AbstractTexels, Touched
from phongfit.geometry.meshes import Mesh
from phongfit.programs import program
from phongfit.rendering.film import Film
from phongfit.rendering.pixels import PixelTerms, resolve
from phongfit.rendering.terms import check_exponents
from phongfit.scene import Scene

BASIS = ("ambient", "diffuse", "specular", "emission")
"""The basis images of [`PixelTerms.basis`][], in its order."""


ROOM = 150_000_000
"""Bytes of traced images that are kept; other images are traced again each time."""


LEFT = 0.01
"""Least share of a variance that is left after that of rounding is subtracted."""


class LitImage(NamedTuple):
    """One photograph's samples: n pixels of three channels.

    - `place`: index of each pixel in the image, counted row by row.
    - `touched`: texels that each pixel sees.
    - `target`, `weight`: measured light, and its relative inverse variance.
    - `ends`: width of the first and last rounding step; 0 if nothing was rounded.
    """

    place: Int[np.ndarray, " n"]
    pixels: PixelTerms
    touched: Touched
    material: Int[np.ndarray, " n"]
    target: Float[np.ndarray, "n 3"]
    weight: Float[np.ndarray, "n 3"]
    ends: tuple[float, float]

    @property
    def bytes(self) -> int:
        """Memory of all arrays, in bytes."""
        return sum(getattr(one, "nbytes", 0) for one in jax.tree.leaves(self))


@dataclasses.dataclass(frozen=True, eq=False)
class Photographs:
    """Photographs that are turned into [`LitImage`][] objects on demand.

    A traced image takes about 100 bytes a pixel. Images beyond `room` bytes are not
    kept but traced again whenever they are needed.

    **Arguments:**

    - `given`: images and scenes; scenes have only the known textures.
    - `films`: each image's film.
    - `grid`: places of the texels on the mesh.
    - `room`: bytes of traced images to keep.
    - `every`: use only every n-th pixel of the surface.
    """

    given: tuple[Observation, ...]
    films: tuple[Film, ...]
    grid: AbstractTexels
    room: int = ROOM
    every: int = 1
    kept: dict[int, LitImage] = dataclasses.field(default_factory=dict, init=False)

    def __iter__(self) -> Iterator[LitImage]:
        return (self.at(k) for k in range(len(self.given)))

    def at(self, k: int) -> LitImage:
        """Image `k`, kept from before or traced now."""
        if k in self.kept:
            return self.kept[k]
        found = see(self.given[k], self.films[k], self.grid, self.every)
        if found.bytes + sum(one.bytes for one in self.kept.values()) <= self.room:
            self.kept[k] = found
        return found

    def image(self, k: int) -> Float[np.ndarray, "height width 3"]:
        """One whole photograph, without negative values if its film clips."""
        return _exposed(self.given[k].image, self.films[k])

    def step(self, k: int) -> Float[np.ndarray, "height width 3"] | None:
        """Rounding steps of image `k`, or None if it was not rounded."""
        film = self.films[k]
        rounded = film.bits is not None
        return rounding_steps(self.given[k].image, film) if rounded else None


class Basis(NamedTuple):
    """Light for parameters of 1, and the derivative of the highlight by log f."""

    light: Float[np.ndarray, "4 n 3"]
    slope: Float[np.ndarray, "n 3"]
    fog: Float[np.ndarray, "n 3"]


def see(
    photograph: Observation, film: Film, grid: AbstractTexels, every: int = 1
) -> LitImage:
    """Trace a photograph's scene.

    **Arguments:** `every`: use only every n-th pixel of the surface.
    """
    gbuffer, pixels = resolve(photograph.scene)
    size = gbuffer.mask.shape
    weight = np.broadcast_to(photograph.weight, photograph.image.shape)
    seen = np.asarray(gbuffer.mask) & (weight > 0).any(axis=-1)
    place = np.flatnonzero(seen)[::every].astype(np.int32)
    chosen = jnp.asarray(place)
    material = pixels.material_index()
    of = np.zeros(size, np.int32) if material is None else np.asarray(material)
    own = of.ravel()[place].astype(np.int32, copy=False)
    layer = own if grid.shape[0] > 1 else None
    return LitImage(
        place,
        pixels.select(chosen),
        grid.touched(gbuffer.select(chosen), layer),
        own,
        _exposed(photograph.image.reshape(-1, 3)[place], film),
        weight[np.unravel_index(place, size)],
        end_steps(film),
    )


def _exposed(light: np.ndarray, film: Film) -> np.ndarray:
    return np.maximum(light, 0) if film.clamp else light


def without(scene: Scene, names: tuple[str, ...]) -> Scene:
    """The scene without the textures that are unknown.

    **Raises:** `ValueError` if exponents are unknown and the shading has none.
    """
    surface = scene.surface
    if "shininess" in names:
        check_exponents(scene)
    if not isinstance(surface, Mesh) or surface.textures is None:
        return scene
    none = dict.fromkeys(names)
    left = [dataclasses.replace(one, **none) for one in surface.textures]
    return dataclasses.replace(scene, surface=surface.with_textures(left))


def basis(
    image: LitImage,
    shininess: Float[np.ndarray, " materials"],
    own: Float[np.ndarray, " n"] | None = None,
) -> Basis:
    """The basis images of an image's samples.

    **Arguments:** `own`: each sample's exponent, instead of the materials' exponents.
    """
    pixels, dtype = image.pixels, image.target.dtype
    if own is not None:
        pixels = eqx.tree_at(
            lambda one: one.terms.exponents,
            pixels,
            jnp.asarray(own, dtype),
            is_leaf=lambda leaf: leaf is None,
        )
        shininess = np.ones(len(shininess))
    found = _basis(pixels, jnp.log(jnp.asarray(shininess, dtype)))
    return Basis(*(np.asarray(one) for one in found))


@program()
def _basis(pixels: PixelTerms, exponents: Array) -> tuple[Array, Array, Array]:
    def at(exponents: Array) -> Array:
        return jnp.moveaxis(pixels.basis(jnp.exp(exponents)[:, None]), -1, 0)

    # Each sample has one material, so one directional derivative serves all exponents.
    light, slope = jax.jvp(at, (exponents,), (jnp.ones_like(exponents),))
    return light, slope[2], pixels.fog_light()


def film_response(
    light: np.ndarray,
    deviation: np.ndarray,
    clamp: bool,
    ends: tuple[float, float] = (0.0, 0.0),
) -> Moments:
    """The film's response to light with noise of standard deviation `deviation`."""
    if clamp:
        deviation = before_rounding(light, deviation, ends)
    found = _moments(jnp.asarray(light), jnp.asarray(deviation), clamp)
    return jax.tree.map(lambda part: np.asarray(part, float), found)


def before_rounding(
    light: np.ndarray, deviation: np.ndarray, ends: tuple[float, float]
) -> np.ndarray:
    r"""Noise level at which clipping alone gives the mean of clipping and rounding.

    Rounding to 0 lowers the mean by $p h^2 / 24$, as in the midpoint rule, for steps h
    and density p of samples at black. The mean of clipped noise grows with its variance
    at slope p / 2. Noise whose variance includes that of rounding, $h^2 / 12$, would
    therefore raise the mean by $p h^2 / 24$. Both are corrected together by subtracting
    $h^2 / 6$ from the variance.
    """
    if not any(ends):
        return deviation
    step = np.where(light < 0.5, *ends).astype(deviation.dtype)
    return np.sqrt(np.maximum(deviation**2 - step**2 / 6, LEFT * deviation**2))


_moments = program("clamp")(film_moments)
