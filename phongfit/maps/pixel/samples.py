"""What one pixel measures: a sample for each channel and light, and its basis."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class PixelSamples(eqx.Module):
    r"""One pixel under many lights: $I = \rho_a A + \rho_d D + \rho_s S(f)$ each.

    An image of several lights has a highlight for each of them: the last two are
    tuples, one entry for each.
    """

    target: Float[Array, "channels images"]
    weight: Float[Array, "channels images"]
    ambient: Float[Array, "channels images"]
    diffuse: Float[Array, "channels images"]
    strength: tuple[Float[Array, "channels images"], ...]
    log_cosine: tuple[Float[Array, " images"], ...]
    veil: Float[Array, "channels images"] | None = None


PixelSamples.__init__.__doc__ = r"""**Arguments:**

- `target`: measured linear light.
- `weight`: 1, or the inverse of the sample's noise; 0 where it is left out, and its
    other numbers may then be anything finite.
- `ambient`, `diffuse`: A and D, light for $\rho_a = 1$ and $\rho_d = 1$.
- `strength`: of each highlight at its centre, for $\rho_s = 1$.
- `log_cosine`: logarithm of the cosine from its centre; very negative where there is
    none.
- `veil`: light of the fog in front, which `target` holds too; `None` without any.
"""


def whitened(samples: PixelSamples) -> PixelSamples:
    """In standard deviations: as samples of noise 1, which all weigh the same.

    **Arguments:** `samples`: weighted by the inverses of their noise, `target` too.
    """
    share = samples.weight
    return PixelSamples(
        samples.target,
        (share > 0).astype(share.dtype),
        share * samples.ambient,
        share * samples.diffuse,
        tuple(share * strength for strength in samples.strength),
        samples.log_cosine,
    )


DARK = -1e4
"""Stands for log 0: its exponential is 0 for every exponent from 1 on."""


def log_cosine(cosine: Float[Array, "..."]) -> Float[Array, "..."]:
    """Logarithm of a cosine, [`DARK`][] where it is not positive."""
    positive = cosine > 0
    # Rounding can make a cosine larger than 1.
    logarithm = jnp.log(jnp.where(positive, cosine, 1))
    return jnp.where(positive, jnp.minimum(logarithm, 0), DARK)
