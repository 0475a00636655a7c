"""The pixels that a fit uses, gathered once from all its images."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from phongfit.material import Material
from phongfit.rendering.terms import ShadingTerms, combine


class Samples(eqx.Module):
    """Shading terms and measured light of N pixels; padding has weight 0."""

    terms: ShadingTerms
    target: Float[Array, "n 3"]
    weight: Float[Array, "n 3"]
    step: Float[Array, "n 3"]

    def light(self, material: Material) -> Float[Array, "n 3"]:
        """Unclamped linear light that the model predicts for each sample."""
        return combine(self.terms, material)

    @eqx.filter_jit
    def take(self, index: Int[Array, " m"]) -> "Samples":
        """Some of the samples."""
        return jax.tree.map(lambda leaf: leaf[index], self)


Samples.__init__.__doc__ = """**Arguments:**

- `terms`: of the pixels.
- `target`: measured linear light.
- `weight`: relative inverse variance; 0 leaves a sample out.
- `step`: width in linear light of the level that the target was rounded to, or 0.
"""


def gather(
    terms: list[ShadingTerms],
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
    lobes = max(t.cosine.shape[-1] for t in terms)
    parts = []
    for term, image, weight, step, index in zip(
        terms, images, weights, steps, used, strict=True
    ):
        padded = np.zeros(size, int)
        padded[: len(index)] = index
        present = np.arange(size) < len(index)
        part = _gather(term, image, weight, step, padded, present)
        parts.append(_with_lobes(part, lobes))
    return parts[0] if len(parts) == 1 else _join(parts)


@jax.jit
def _join(parts: list[Samples]) -> Samples:
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


@jax.jit
def _gather(
    terms: ShadingTerms,
    image: Float[Array, "height width 3"],
    weight: Float[Array, "height width 3"],
    step: Float[Array, "height width 3"],
    index: Int[Array, " n"],
    present: Array,
) -> Samples:
    def pick(leaf: Array) -> Array:
        return leaf.reshape(-1, *leaf.shape[2:])[index]

    weight = jnp.where(present[:, None], pick(weight), 0)
    return Samples(jax.tree.map(pick, terms), pick(image), weight, pick(step))


def _padded(count: int) -> int:
    """The least number ≥ `count` with three significant bits, and at least 256."""
    unit = max(2 ** (max(count, 1).bit_length() - 3), 64)
    return max(-(-count // unit) * unit, 256)


def _with_lobes(samples: Samples, lobes: int) -> Samples:
    """Samples with dark lights added, so that all images have equally many."""
    missing = lobes - samples.terms.cosine.shape[-1]
    if missing == 0:
        return samples
    n = samples.target.shape[0]
    dtype = samples.target.dtype
    where = lambda s: (s.terms.cosine, s.terms.strength)  # noqa: E731
    cosine = jnp.zeros((n, missing), dtype)
    strength = jnp.zeros((n, missing, 3), dtype)
    more = (
        jnp.concatenate([samples.terms.cosine, cosine], axis=1),
        jnp.concatenate([samples.terms.strength, strength], axis=1),
    )
    return eqx.tree_at(where, samples, more)
