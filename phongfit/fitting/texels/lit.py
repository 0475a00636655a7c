"""What the samples of photographs see of a textured surface, image by image."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from phongfit.fitting.problem.inputs import Observation
from phongfit.fitting.problem.noise import clipped_moments, rounding_steps
from phongfit.fitting.texels.sums import Grid, Touched, merged
from phongfit.geometry.meshes import Mesh
from phongfit.programs import program
from phongfit.rendering.film import Film
from phongfit.rendering.pixels import PixelTerms, resolve
from phongfit.scene import Scene
from phongfit.textures import Filter, texels

BASIS = ("ambient", "diffuse", "specular", "emission")
"""The basis images of [`PixelTerms.basis`][], in its order."""


class LitImage(NamedTuple):
    """One photograph's samples: n pixels of three channels.

    - `scene`: with the textures that are known.
    - `place`: of each pixel in the image, row by row.
    - `target`, `weight`: measured light, and its relative inverse variance.
    """

    scene: Scene
    place: Int[np.ndarray, " n"]
    pixels: PixelTerms
    touched: Touched
    material: Int[np.ndarray, " n"]
    target: Float[np.ndarray, "n 3"]
    weight: Float[np.ndarray, "n 3"]
    image: Float[np.ndarray, "height width 3"]
    step: Float[np.ndarray, "height width 3"] | None


class Basis(NamedTuple):
    """Light for parameters of 1, and the slope of the highlight's in log f."""

    light: Float[np.ndarray, "4 n 3"]
    slope: Float[np.ndarray, "n 3"]
    fog: Float[np.ndarray, "n 3"]


def see(
    photograph: Observation,
    film: Film,
    grid: Grid,
    filter: Filter,
    names: tuple[str, ...],
) -> LitImage:
    """Trace a photograph's scene.

    **Arguments:** `names`: parameters whose textures are unknown.

    **Raises:** `ValueError` if the scene's surface has no uv.
    """
    scene = _without(photograph.scene, names)
    gbuffer, pixels = resolve(scene)
    if gbuffer.uv is None:
        raise ValueError(
            "scene: expected a surface with uv, which say where its texels lie"
        )
    size = gbuffer.mask.shape
    weight = np.broadcast_to(photograph.weight, photograph.image.shape)
    seen = np.asarray(gbuffer.mask) & (weight > 0).any(axis=-1)
    place = np.flatnonzero(seen).astype(np.int32)
    chosen = jnp.asarray(place)
    uv = gbuffer.uv.reshape(-1, 2)[chosen]
    index, share = texels(uv, (grid.rows, grid.columns), filter, grid.wrap)
    material = pixels.material_index()
    of = np.zeros(size, np.int32) if material is None else np.asarray(material)
    own = of.ravel()[place].astype(np.int32, copy=False)
    number = np.asarray(index, np.int32)
    if grid.layers > 1:
        number = number + (own * np.int32(grid.rows * grid.columns))[:, None]
    image = photograph.image
    image = np.maximum(image, 0) if film.clamp else image
    return LitImage(
        scene,
        place,
        pixels.select(chosen),
        merged(Touched(number, np.asarray(share))),
        own,
        image.reshape(-1, 3)[place],
        weight.reshape(-1, 3)[place],
        image,
        rounding_steps(photograph.image, film) if film.bits is not None else None,
    )


def _without(scene: Scene, names: tuple[str, ...]) -> Scene:
    """The scene without the textures that are to be found."""
    surface = scene.surface
    if not isinstance(surface, Mesh) or surface.uv is None:
        raise ValueError(
            "scene: expected a Mesh with uv, which say where its texels lie, got "
            f"{type(surface).__name__}"
        )
    if surface.textures is None:
        return scene
    none = dict.fromkeys(names)
    left = [dataclasses.replace(one, **none) for one in surface.textures]
    return dataclasses.replace(scene, surface=surface.with_textures(left))


def basis(image: LitImage, shininess: Float[np.ndarray, " materials"]) -> Basis:
    """The basis images of an image's samples."""
    found = _basis(image.pixels, jnp.asarray(np.log(shininess), image.target.dtype))
    return Basis(*(np.asarray(one) for one in found))


@program()
def _basis(pixels: PixelTerms, exponents: Array) -> tuple[Array, Array, Array]:
    def at(exponents: Array) -> Array:
        return jnp.moveaxis(pixels.basis(jnp.exp(exponents)[:, None]), -1, 0)

    # Each sample has one material, so that all exponents may grow at once.
    light, slope = jax.jvp(at, (exponents,), (jnp.ones_like(exponents),))
    return light, slope[2], pixels.fog_light()


class Shown(NamedTuple):
    """What the film makes of light, on average, and how that grows with it."""

    mean: Float[np.ndarray, "n 3"]
    slope: Float[np.ndarray, "n 3"]


def shown(light: np.ndarray, deviation: np.ndarray, clamp: bool) -> Shown:
    """Light with noise of a standard deviation, as the film shows it."""
    if not clamp:
        return Shown(light, np.ones_like(light))
    mean, slope = _clipped(jnp.asarray(light), jnp.asarray(deviation))
    return Shown(np.asarray(mean, float), np.asarray(slope, float))


@program()
def _clipped(light: Array, deviation: Array) -> tuple[Array, Array]:
    moments = clipped_moments(light, deviation)
    return moments.mean, moments.slope
