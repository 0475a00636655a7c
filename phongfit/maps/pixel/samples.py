"""What one pixel measures: a sample for each channel and light, and its basis."""

import equinox as eqx
from jaxtyping import Array, Float

from phongfit.maps.pixel.lobes import Angles


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
    angles: Angles
    veil: Float[Array, "channels images"] | None = None


PixelSamples.__init__.__doc__ = r"""**Arguments:**

- `target`: measured linear light.
- `weight`: 1, or the inverse of the sample's noise; 0 where it is left out, and its
    other numbers may then be anything finite.
- `ambient`, `diffuse`: A and D, light for $\rho_a = 1$ and $\rho_d = 1$.
- `strength`: of each highlight at its centre, for $\rho_s = 1$.
- `angles`: what each highlight's lobe takes: see [`AbstractLobes`][].
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
        samples.angles,
    )
