"""Noise, clipping and rounding: what an image does to the light before it is read.

Sensor noise comes first, then the clamp to [0, 1], then rounding. So a pixel near
white or black is not the model plus noise: on average it lies below, or above. The fit
compares with that average.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erfc
from jaxtyping import Array, Float

from phongfit.rendering.film import Encoding, Film, decode, encode

Values = Float[Array, "..."]


def clipped_mean(light: Values, sigma: Float[Array, ""] | Values) -> Values:
    r"""Mean of $\min(\max(I + \sigma n, 0), 1)$ with $n$ standard normal, elementwise.

    $I - \sigma g(\tfrac{1-I}{\sigma}) + \sigma g(\tfrac{I}{\sigma})$ with $g(z) =
    \phi(z) - z Q(z)$. For $\sigma \to 0$ it is the hard clamp; its slope beyond white
    is the chance that noise brings the pixel back below it.

    ??? cite "Source"
        Tobin, *Estimation of relationships for limited dependent variables*,
        Econometrica 26(1), 1958.
    """
    return _clipped_mean(light, jnp.broadcast_to(sigma, light.shape))


@jax.custom_jvp
def _clipped_mean(light: Values, sigma: Values) -> Values:
    return _mean_and_slopes(light, sigma)[0]


@_clipped_mean.defjvp
def _clipped_mean_derivative(
    at: tuple[Values, Values], towards: tuple[Values, Values]
) -> tuple[Values, Values]:
    mean, slope, in_sigma = _mean_and_slopes(*at)
    return mean, slope * towards[0] + in_sigma * towards[1]


def _mean_and_slopes(light: Values, sigma: Values) -> tuple[Values, Values, Values]:
    r"""The mean and its derivatives in $I$ and $\sigma$, from the same tails.

    With $a = \tfrac{1-I}{\sigma}$ and $b = \tfrac{I}{\sigma}$ these are $1 - Q(a) -
    Q(b)$ and $\phi(b) - \phi(a)$.
    """
    sigma = jnp.maximum(sigma, jnp.finfo(light.dtype).eps ** 2)
    above, below = (1 - light) / sigma, light / sigma
    density_above, density_below = _density(above), _density(below)
    tail_above, tail_below = _upper_tail(above), _upper_tail(below)
    over = density_above - above * tail_above
    under = density_below - below * tail_below
    slope = 1 - tail_above - tail_below
    return light + sigma * (under - over), slope, density_below - density_above


def _density(z: Values) -> Values:
    return jnp.exp(-(z**2) / 2) / math.sqrt(2 * math.pi)


def _upper_tail(z: Values) -> Values:
    return erfc(z / math.sqrt(2)) / 2


def clipped_variance_share(light: Values, sigma: Float[Array, ""] | Values) -> Values:
    r"""Variance of the clipped value over $\sigma^2$: 1 in mid-range, 0 past white."""
    sigma = jnp.maximum(sigma, jnp.finfo(light.dtype).eps ** 2)
    # Ten standard deviations stand for infinity; b² − b² would otherwise cancel badly.
    a = jnp.clip(-light / sigma, -10, 10)
    b = jnp.clip((1 - light) / sigma, -10, 10)
    density_a, density_b = _density(a), _density(b)
    below, above = _upper_tail(-a), _upper_tail(b)
    mean = density_a - density_b + a * below + b * above
    square = 1 - below - above + a * density_a - b * density_b
    square = square + a**2 * below + b**2 * above
    return jnp.clip(square - mean**2, 0, 1)


def rounding_steps(image: np.ndarray, film: Film) -> np.ndarray:
    """Width in linear light of the level that each value was rounded to; 0 if none."""
    if film.bits is None:
        return np.zeros_like(image)
    top = 2**film.bits - 1
    level = np.round(encode(image, film.encoding) * top)
    edges = np.clip(np.stack([level - 0.5, level + 0.5]) / top, 0, 1)
    low, high = decode(edges, film.encoding)
    return (high - low).astype(image.dtype)


def find_film(images: list[np.ndarray]) -> Film:
    """The film that images must have been through, from their values alone.

    Values outside [0, 1] were never clamped. Values that are all multiples of 1/255, or
    of 1/65535, in one of the encodings were rounded to them: that is no chance in an
    image. Only error bars rest on this, never the model.
    """
    low = min(float(image.min()) for image in images)
    high = max(float(image.max()) for image in images)
    if low < 0 or high > 1:
        return Film(clamp=False)
    for bits in (8, 16):
        for encoding in ("linear", "srgb"):
            if all(_is_rounded(image, encoding, bits) for image in images):
                return Film(encoding=encoding, bits=bits)
    return Film()


def _is_rounded(image: np.ndarray, encoding: Encoding, bits: int) -> bool:
    # What was never rounded shows it in its first few values.
    return all(
        bool(np.all(np.abs(levels - np.round(levels)) < 0.02))
        for part in (image.ravel()[:512], image)
        for levels in [encode(part, encoding) * (2**bits - 1)]
    )


def shared_rounding_variance(step: Values, sigma: Values) -> Values:
    r"""Variance of the part of a rounding error that equal pixels share.

    Noise of standard deviation $\sigma$ ahead of the rounding makes its error
    independent from pixel to pixel (dithering); what is left in common is the mean of
    the sawtooth error over the noise, $\sum_k \frac{q^2}{2 \pi^2 k^2} e^{-4 \pi^2 k^2
    \sigma^2 / q^2}$: $q^2/12$ without noise, nothing from $\sigma \approx q/2$ on.

    ??? cite "Source"
        Widrow and Kollár, *Quantization noise*, 2008, chapter 4.
    """
    total = jnp.zeros_like(step)
    ratio = jnp.where(step > 0, sigma / jnp.where(step > 0, step, 1), 0)
    for k in range(1, 9):
        total += jnp.exp(-4 * np.pi**2 * k**2 * ratio**2) / (2 * np.pi**2 * k**2)
    # The series' tail matters only without noise, where its sum is known.
    return step**2 * jnp.where(ratio < 1e-3, 1 / 12, total)


def arithmetic_floor(largest: Any, resolution: float) -> Any:
    """Noise level below which residuals are rounding of the arithmetic.

    **Arguments:** `largest` sample, and the number type's `resolution`.
    """
    return 16 * resolution * largest
