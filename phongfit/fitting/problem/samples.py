"""The pixels that a fit uses, gathered once from all its images."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from phongfit.geometry.shading import Interpolation
from phongfit.geometry.surfaces import GBuffer
from phongfit.material import Material
from phongfit.programs import program
from phongfit.reflectance import AbstractSpecular
from phongfit.rendering.pixels import PixelTerms, pixel_terms, resolve, with_model
from phongfit.scene import Scene
from phongfit.textures import Factors

# Number of samples from which padding by up to a quarter costs noticeable time.
MANY = 2**14


class View(eqx.Module):
    """One image's scene, and the pixels of its samples.

    `gbuffer` is that of the samples alone; `None` if rays must be traced again whenever
    the scene changes, or if it never does.
    """

    scene: Scene
    gbuffer: GBuffer | None
    index: Int[Array, " n"]

    def lit(self, scene: Scene) -> PixelTerms:
        """Geometry and light of the samples, for another scene of the same kind."""
        if self.gbuffer is not None:
            return pixel_terms(scene, self.gbuffer)
        return resolve(scene)[1].select(self.index)


class Channels(eqx.Module):
    """Geometry and light of samples, with the colour channels as the first axis.

    In each array a colour axis of 3 comes first and an axis of 1 is left in its place,
    since an innermost loop over three numbers is slow.
    """

    pixels: PixelTerms

    def light(self, material: Material) -> Float[Array, "3 n"]:
        """Linear light, before the film, that the model predicts for each sample."""
        return self._each_channel(
            lambda pixels, own: pixels.radiance(own)[..., 0], material
        )

    def basis(self, shininess: Float[Array, "..."]) -> Float[Array, "3 4 n"]:
        """Light for each reflectance of 1: ambient, diffuse, specular, emission."""
        return self._each_channel(lambda pixels, f: pixels.basis(f)[:, 0].T, shininess)

    def fog_light(self) -> Float[Array, "3 n"]:
        """Light that fog adds to each sample."""
        return self._each_channel(lambda pixels, _: pixels.fog_light()[:, 0], None)

    def shaped_by(self, model: AbstractSpecular) -> "Channels":
        """The channels with another specular model of the same kind."""
        return Channels(with_model(self.pixels, model))

    def _each_channel(
        self, of: Callable[[PixelTerms, Any], Array], numbers: Any
    ) -> Any:
        """A function of the pixels and of numbers, for each channel."""
        marks = jax.tree.map(lambda leaf: False, self.pixels)
        marks = eqx.tree_at(_colours, marks, replace_fn=lambda _: True)
        axes = jax.tree.map(lambda mark: 0 if mark else None, marks)
        mapped = jax.vmap(of, in_axes=(axes, jax.tree.map(_axis, numbers)))
        return mapped(self.pixels, jax.tree.map(_colour_first, numbers))


def _colours(pixels: PixelTerms) -> list[Any]:
    """Leaves of such a tree whose last axis is colour; leaves need not be arrays."""
    terms = [pixels.terms.ambient, pixels.terms.diffuse, pixels.terms.strength]
    haze = [] if pixels.haze is None else [pixels.haze.color]
    return [*terms, *haze, *jax.tree.leaves(pixels.factors)]


def _axis(leaf: Array) -> int | None:
    return 0 if leaf.shape[-1:] == (3,) else None


def _colour_first(leaf: Array) -> Array:
    return leaf if _axis(leaf) is None else _planes(leaf)[..., None]


def _planes(leaf: Float[Array, "*shape 3"]) -> Float[Array, "3 *shape"]:
    """Move the last axis, the channels, to the front."""
    # Stacked one by one: moving an axis takes XLA twice as long.
    return jnp.stack([leaf[..., k] for k in range(leaf.shape[-1])])


def by_channel(pixels: PixelTerms) -> Channels:
    """Pixels with the channels as the first axis."""
    return Channels(eqx.tree_at(_colours, pixels, replace_fn=_colour_first))


class Samples(eqx.Module):
    """Geometry, light and measured light of N pixels; padding has weight 0.

    **Fields:**

    - `channels`: geometry and light of the pixels.
    - `target`: measured linear light.
    - `weight`: relative inverse variance; 0 leaves a sample out.
    - `step`: width in linear light of the level that the target was rounded to; `None`
        where nothing was rounded.
    - `image`: index of a sample's image; the samples of an image are contiguous.
    - `views`: scene and pixels of each image, in order.
    """

    channels: Channels
    target: Float[Array, "3 n"]
    weight: Float[Array, "3 n"]
    step: Float[Array, "3 n"] | None
    image: Int[Array, " n"]
    views: tuple[View, ...]

    def lit(self, scenes: tuple[Scene, ...]) -> Channels:
        """Geometry and light of the samples, with other scenes in place of these."""
        pairs = zip(self.views, scenes, strict=True)
        return by_channel(join_pixels([view.lit(scene) for view, scene in pairs]))

    def stacked_views(self) -> View | None:
        """All views stacked along a first axis; `None` if their structures differ.

        A function that is mapped over them compiles as fast as for one image.
        """
        structures = {jax.tree.structure(view) for view in self.views}
        shapes = {tuple(map(jnp.shape, jax.tree.leaves(view))) for view in self.views}
        if len(self.views) == 1 or len(structures) > 1 or len(shapes) > 1:
            return None
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *self.views)

    def material_index(self) -> Int[Array, " n"]:
        """Index of each sample's material; 0 if there is only one."""
        index = self.channels.pixels.material_index()
        return jnp.zeros_like(self.image) if index is None else index


@dataclasses.dataclass(frozen=True)
class Source:
    """One image of a fit: geometry and light of its pixels, and the measured values.

    `mask` is true where the surface is seen. `weight` has one channel if all three are
    equal. `gbuffer` is `None` unless lights may change, `step` if nothing was rounded.
    """

    scene: Scene
    mask: Bool[Array, "height width"]
    pixels: PixelTerms
    gbuffer: GBuffer | None
    image: Float[Array, "height width 3"]
    weight: Float[Array, "height width channels"]
    step: np.ndarray | None

    def used(self) -> np.ndarray:
        """Values of the samples with a weight above 0."""
        image, used = np.asarray(self.image), np.asarray(self.weight) > 0
        return image[np.broadcast_to(used, image.shape)]

    def count(self) -> int:
        """Number of samples with a weight above 0."""
        used = np.count_nonzero(np.asarray(self.weight) > 0)
        return int(used) * (3 // self.weight.shape[-1])


def stacked_lit(views: View, scenes: Scene) -> Channels:
    """Geometry and light of stacked views in stacked scenes."""
    return by_channel(end_to_end(eqx.filter_vmap(View.lit)(views, scenes)))


def gather(sources: list[Source], used: list[np.ndarray]) -> Samples:
    """Samples of some pixels, image after image.

    Each image is padded to a common size, one of a coarse series, so that fits of
    similar size share one compiled program.

    **Arguments:** `used`: for each image the flat indices of its pixels, row by row.
    """
    size = _padded(max(len(index) for index in used), len(sources))
    index = np.arange(len(sources), dtype=np.int32)[:, None]
    image = np.broadcast_to(index, (len(sources), size)).ravel()
    places = [_repeated(index, size) for index in used]
    asked = list(zip(sources, places, map(len, used), strict=True))
    numbers = _join([_take(*_parts(*one)) for one in asked])
    views = [
        View(s.scene, None if s.gbuffer is None else s.gbuffer.select(place), place)
        for s, place, _ in asked
    ]
    return Samples(*numbers, image=jnp.asarray(image), views=tuple(views))


def _repeated(index: np.ndarray, size: int) -> Int[Array, " size"]:
    """Indices padded to a size, by repeating the first pixel."""
    padded = np.full(size, index[0] if len(index) else 0, np.int32)
    padded[: len(index)] = index
    return jnp.asarray(padded)


_Numbers = tuple[PixelTerms, Array, Array, Array | None]


def _parts(source: Source, place: Array, count: int) -> tuple[Any, ...]:
    """Arguments of [`_take`][]; vertices that no pixel shows are dropped."""
    pixels, at = source.pixels, place
    if pixels.interpolation is not None:
        pixels, at = pixels.select(place), None
    return pixels, at, (source.image, source.weight, source.step), place, count


@program()
def _take(
    pixels: PixelTerms,
    at: Array | None,
    numbers: tuple[Array, Array, Array | None],
    place: Array,
    count: Array,
) -> _Numbers:
    """Some pixels of an image, with their values, weights and rounding steps."""
    pixels = pixels if at is None else pixels.select(at)
    target, weight = (a.reshape(-1, a.shape[-1])[place] for a in numbers[:2])
    step = None if numbers[2] is None else numbers[2].reshape(-1, 3)[place]
    present = jnp.arange(len(place)) < count
    weight = jnp.where(present[:, None], weight, 0)
    return pixels, target, jnp.broadcast_to(weight, target.shape), step


@program()
def _join(parts: list[_Numbers]) -> tuple[Channels, Array, Array, Array | None]:
    """Join the images one after another, with channels as the first axis."""
    pixels, *numbers = zip(*parts, strict=True)
    target, weight = (_planes(jnp.concatenate(one)) for one in numbers[:2])
    rounded = numbers[2][0] is not None
    step = _planes(jnp.concatenate(numbers[2])) if rounded else None
    return by_channel(join_pixels(list(pixels))), target, weight, step


def seen_pixels(sources: list[Source]) -> list[np.ndarray]:
    """For each image the flat indices of the pixels with any weight, row by row."""
    # Channel by channel: an axis of 3 is slow to reduce.
    channels = [np.moveaxis(np.asarray(s.weight) > 0, -1, 0) for s in sources]
    return [np.flatnonzero(functools.reduce(np.logical_or, c)) for c in channels]


def join_pixels(parts: list[PixelTerms]) -> PixelTerms:
    """Join the geometry and light of several images, one after another."""
    if len(parts) == 1:
        return parts[0]
    if any(part.factors is not None for part in parts):
        parts = [_with_factors(part) for part in parts]
    lobes = max(part.terms.strength.shape[-2] for part in parts)
    return _concatenated(_apart([_with_lobes(part, lobes) for part in parts]))


def _with_factors(part: PixelTerms) -> PixelTerms:
    """Add texture factors of 1 to a part without textures."""
    if part.factors is not None:
        return part
    index = None if part.interpolation is None else part.interpolation.index
    count = part.terms.diffuse.shape[0] if index is None else index.shape[0]
    one = jnp.ones((count, 3), part.terms.diffuse.dtype)
    return dataclasses.replace(part, factors=Factors(one, one, one, one))


def end_to_end(stacked: PixelTerms) -> PixelTerms:
    """Join images of the same structure, which are stacked along a first axis."""
    interpolation, model = stacked.interpolation, stacked.terms.model
    images, points = stacked.terms.diffuse.shape[:2]
    if interpolation is not None:
        before = points * jnp.arange(images, dtype=interpolation.index.dtype)
        moved = interpolation.index + before[:, None, None]
        interpolation = Interpolation(moved, interpolation.weight)
        stacked = dataclasses.replace(stacked, interpolation=interpolation)
    flat = jax.tree.map(
        lambda leaf: leaf.reshape(images * leaf.shape[1], *leaf.shape[2:]),
        with_model(stacked, None),
    )
    return with_model(flat, jax.tree.map(lambda leaf: leaf[0], model))


def _apart(parts: list[PixelTerms]) -> list[PixelTerms]:
    """Shift the indices of interpolations: points are counted on over all parts."""
    counted, before = [], 0
    for part in parts:
        interpolation = part.interpolation
        if interpolation is not None:
            moved = Interpolation(interpolation.index + before, interpolation.weight)
            before += part.terms.diffuse.shape[0]
            part = dataclasses.replace(part, interpolation=moved)
        counted.append(part)
    return counted


@program()
def _concatenated(parts: list[PixelTerms]) -> PixelTerms:
    bare = [with_model(part, None) for part in parts]
    joined = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *bare)
    return with_model(joined, parts[0].terms.model)


def _padded(count: int, images: int) -> int:
    """The least number ≥ `count` with three significant bits.

    At least 256 for all images together. Large counts have four significant bits, since
    there padding costs more than compilation.
    """
    digits = 3 if count < MANY else 4
    unit = max(2 ** (max(count, 1).bit_length() - digits), 64 if images == 1 else 16)
    return max(-(-count // unit) * unit, 256 // images // unit * unit)


def _with_lobes(view: PixelTerms, lobes: int) -> PixelTerms:
    """A view with dark lights added, so that all images have equally many."""
    terms = view.terms
    *batch, count, _ = terms.strength.shape
    if count == lobes:
        return view
    dtype = terms.strength.dtype
    dark = jnp.zeros((*batch, lobes - count), dtype)
    strength = jnp.zeros((*batch, lobes - count, 3), dtype)
    terms = dataclasses.replace(
        terms,
        cosine=jax.tree.map(
            lambda one: jnp.concatenate([one, dark], axis=-1), terms.cosine
        ),
        strength=jnp.concatenate([terms.strength, strength], axis=-2),
    )
    return dataclasses.replace(view, terms=terms)
