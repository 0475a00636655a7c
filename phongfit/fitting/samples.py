"""The pixels that a fit uses, gathered once from all its images."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from phongfit.geometry.shading import Interpolation
from phongfit.material import Material
from phongfit.rendering.pixels import PixelTerms


class Samples(eqx.Module):
    """Geometry, light and measured light of N pixels; padding has weight 0."""

    pixels: PixelTerms
    target: Float[Array, "n 3"]
    weight: Float[Array, "n 3"]
    step: Float[Array, "n 3"]

    def light(self, material: Material) -> Float[Array, "n 3"]:
        """Linear light, before the film, that the model predicts for each sample."""
        return self.pixels.radiance(material)

    def take(self, index: np.ndarray) -> "Samples":
        """Some of the samples."""
        numbers = (np.asarray(a)[index] for a in (self.target, self.weight, self.step))
        pixels = self.pixels.select(jnp.asarray(index))
        return Samples(pixels, *map(jnp.asarray, numbers))


Samples.__init__.__doc__ = """**Arguments:**

- `pixels`: what the pixels see.
- `target`: measured linear light.
- `weight`: relative inverse variance; 0 leaves a sample out.
- `step`: width in linear light of the level that the target was rounded to, or 0.
"""


def gather(
    views: list[PixelTerms],
    images: list[np.ndarray],
    weights: list[np.ndarray],
    steps: list[np.ndarray],
) -> Samples:
    """Samples of all pixels with any weight, image after image.

    Each image is padded to a common size out of a coarse series, so that fits of
    similar size share one compilation.
    """
    used = [np.flatnonzero(weight.any(axis=-1)) for weight in weights]
    size = _padded(max(len(index) for index in used))
    lobes = max(view.terms.cosine.shape[-1] for view in views)
    parts = []
    for view, image, weight, step, index in zip(
        views, images, weights, steps, used, strict=True
    ):
        # Padding repeats pixels, with no weight.
        padded = np.resize(index, size) if len(index) else np.zeros(size, int)
        present = (np.arange(size) < len(index))[:, None]
        target, weight, step = (
            array.reshape(-1, 3)[padded] for array in (image, weight, step)
        )
        numbers = (target, np.where(present, weight, 0), step)
        pixels = _with_lobes(view, lobes).select(jnp.asarray(padded))
        parts.append(Samples(pixels, *map(jnp.asarray, numbers)))
    return parts[0] if len(parts) == 1 else _join(_apart(parts))


def _apart(parts: list[Samples]) -> list[Samples]:
    """Samples whose interpolation counts the points of all parts, one after another."""
    counted, before = [], 0
    for part in parts:
        interpolation = part.pixels.interpolation
        if interpolation is not None:
            moved = Interpolation(interpolation.index + before, interpolation.weight)
            pixels = dataclasses.replace(part.pixels, interpolation=moved)
            before += part.pixels.terms.diffuse.shape[0]
            part = dataclasses.replace(part, pixels=pixels)
        counted.append(part)
    return counted


@jax.jit
def _join(parts: list[Samples]) -> Samples:
    joined = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    # The model's own arrays, if it has any, are of no sample.
    model = parts[0].pixels.terms.model
    return eqx.tree_at(lambda s: s.pixels.terms.model, joined, model)


def _padded(count: int) -> int:
    """The least number ≥ `count` with three significant bits, and at least 256."""
    unit = max(2 ** (max(count, 1).bit_length() - 3), 64)
    return max(-(-count // unit) * unit, 256)


def _with_lobes(view: PixelTerms, lobes: int) -> PixelTerms:
    """A view with dark lights added, so that all images have equally many."""
    terms = view.terms
    *batch, count = terms.cosine.shape
    if count == lobes:
        return view
    dtype = terms.cosine.dtype
    cosine = jnp.zeros((*batch, lobes - count), dtype)
    strength = jnp.zeros((*batch, lobes - count, 3), dtype)
    terms = dataclasses.replace(
        terms,
        cosine=jnp.concatenate([terms.cosine, cosine], axis=-1),
        strength=jnp.concatenate([terms.strength, strength], axis=-2),
    )
    return dataclasses.replace(view, terms=terms)
