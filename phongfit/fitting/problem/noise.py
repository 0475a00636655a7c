"""Noise, clipping and rounding of light in an image.

Sensor noise comes first, then the clamp to [0, 1], then rounding. So the mean of a
pixel is below the model near white, and above it near black. The fit compares the image
with this mean.
"""

import functools
import itertools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erf
from jaxtyping import Array, Bool, Float

from phongfit.rendering.film import Encoding, Film, decode, encode

Values = Float[Array, "..."]

# Standard deviations beyond which a normal distribution counts as 0: there it is 1e-23.
FAR = 10
# Number of values that are exactly 1 from which white was cut off, not reached by
# chance.
CUT_OFF = 3
# Least number of samples of one value that may be a plateau. They are compared with the
# samples between `BESIDE` times the value and the value: at a plateau they are more
# than `STEEP` times as many.
LEAST_PLATEAU = 20
BESIDE = 0.97
STEEP = 3
# Bisections in the search for a median, enough for the accuracy of a noise level.
HALVINGS = 16


class Moments(NamedTuple):
    """Moments of noisy, clipped light, elementwise.

    - `mean`: mean of the clipped value.
    - `slope`: derivative of the mean in the light: the probability of no clipping.
    - `variance_share`: variance after clipping over that of the noise: 1 in mid-range,
        0 past white.
    - `drift`: derivative of the mean in σ: 0 in mid-range.
    """

    mean: Values
    slope: Values
    variance_share: Values
    drift: Values


def clipped_moments(light: Values, sigma: Float[Array, ""] | Values) -> Moments:
    r"""Moments of $\min(\max(I + \sigma n, 0), 1)$ with $n$ standard normal.

    With $b = I / \sigma$, $a = (1 - I) / \sigma$ and $g(z) = \phi(z) - z Q(z)$ the mean
    is $I + \sigma (g(b) - g(a))$, and its slope $1 - Q(a) - Q(b)$. For $\sigma \to 0$
    that is the hard clamp.

    ??? cite "Source"
        Tobin, *Estimation of relationships for limited dependent variables*,
        Econometrica 26(1), 1958.
    """
    # A tiny σ in place of 0 gives the hard clamp without division by 0.
    sigma = jnp.maximum(sigma, jnp.finfo(light.dtype).eps ** 2)
    # Mostly no sample is near black or near white, so that branch is skipped.
    near_black = jnp.min(light / sigma, initial=FAR) < FAR
    near_white = jnp.min((1 - light) / sigma, initial=FAR) < FAR
    branches = [
        functools.partial(_moments, *near)
        for near in itertools.product((False, True), repeat=2)
    ]
    which = 2 * near_black.astype(jnp.int32) + near_white.astype(jnp.int32)
    return jax.lax.switch(which, branches, light, sigma)


def _moments(black: bool, white: bool, light: Values, sigma: Values) -> Moments:
    """The moments, without the terms of black or white if no sample is near it."""
    under = _beyond(light / sigma) if black else _Beyond()
    over = _beyond((1 - light) / sigma) if white else _Beyond()
    one, mean = jnp.ones_like(light), under.excess - over.excess
    return Moments(
        light + sigma * mean,
        one - over.chance - under.chance,
        jnp.clip(one - under.lost - over.lost - mean**2, 0, 1),
        one * (under.density - over.density),
    )


class _Beyond(NamedTuple):
    r"""Integrals of a standard normal distribution beyond z.

    - `density`: $\phi(z)$.
    - `chance`: $Q(z)$.
    - `excess`: $g(z) = \phi(z) - z Q(z)$, mean excess over z.
    - `lost`: $Q(z) + z g(z)$, its part of the variance; g and z are at most `FAR`,
        which stands for infinity.
    """

    density: Values | float = 0.0
    chance: Values | float = 0.0
    excess: Values | float = 0.0
    lost: Values | float = 0.0


def _beyond(z: Values) -> _Beyond:
    density = jnp.exp(-(z**2) / 2) / math.sqrt(2 * math.pi)
    # Small probabilities have few digits; more would be lost beside 1, and be slow.
    chance = (1 - erf(z / math.sqrt(2))) / 2
    excess = density - z * chance
    lost = chance + jnp.clip(z, -FAR, FAR) * jnp.minimum(excess, FAR)
    return _Beyond(density, chance, excess, lost)


def film_moments(
    light: Values, sigma: Float[Array, ""] | Values, clamp: bool
) -> Moments:
    """The moments of noisy light after a film with or without a clamp."""
    if clamp:
        return clipped_moments(light, sigma)
    one = jnp.ones_like(light)
    return Moments(light, one, one, jnp.zeros_like(light))


def clipped_mean(light: Values, sigma: Float[Array, ""] | Values) -> Values:
    """The mean of [`clipped_moments`][], with its analytical derivatives."""
    return _clipped_mean(light, jnp.broadcast_to(sigma, light.shape))


@jax.custom_jvp
def _clipped_mean(light: Values, sigma: Values) -> Values:
    return clipped_moments(light, sigma).mean


@_clipped_mean.defjvp
def _clipped_mean_derivative(
    at: tuple[Values, Values], towards: tuple[Values, Values]
) -> tuple[Values, Values]:
    found = clipped_moments(*at)
    return found.mean, found.slope * towards[0] + found.drift * towards[1]


def rounding_steps(image: np.ndarray, film: Film) -> np.ndarray:
    """Width in linear light of the level that each value was rounded to; 0 if none."""
    if film.bits is None:
        return np.zeros_like(image)
    top = 2**film.bits - 1
    level = np.round(encode(image, film.encoding) * top)
    edges = np.clip(np.stack([level - 0.5, level + 0.5]) / top, 0, 1)
    low, high = decode(edges, film.encoding)
    return (high - low).astype(image.dtype)


def end_steps(film: Film) -> tuple[float, float]:
    """Width in linear light of the levels beside black and white; 0 if none."""
    if film.bits is None:
        return 0.0, 0.0
    level = 1 / (2**film.bits - 1)
    ends = decode(np.array([level, 1 - level]), film.encoding)
    return float(ends[0]), float(1 - ends[1])


def find_film(images: list[np.ndarray]) -> Film:
    """Detect the film of images from their values.

    Values outside [0, 1] show that nothing was clamped, unless several are exactly 1:
    then white was cut off, and negative values count as clamped. If all values are
    multiples of 1/255, or of 1/65535, in one of the encodings, they were rounded to
    them. This affects error bars only, and in fits of textures the light near black or
    white.
    """
    low = min(float(image.min()) for image in images)
    high = max(float(image.max()) for image in images)
    if high > 1 or (low < 0 and not (high == 1 and _whites(images) >= CUT_OFF)):
        return Film(clamp=False)
    for bits in (8, 16):
        for encoding in ("linear", "srgb"):
            if all(_is_rounded(image, encoding, bits) for image in images):
                return Film(encoding=encoding, bits=bits)
    return Film()


class Plateau(NamedTuple):
    """Samples that were cut off at one value.

    - `value`: the largest value of the images.
    - `n_samples`: number of samples with this value.
    """

    value: float
    n_samples: int


def find_plateau(images: list[np.ndarray]) -> Plateau | None:
    """Detect a value below white at which images were cut off; `None` if there is none.

    Images of 12 bits in files of 16 bits have one: their white is 4095 of 65535.
    Without a cut, about as many samples have the largest value as the values just below
    it. A surface of constant brightness has no values just below.
    """
    top = max((float(image.max()) for image in images if image.size), default=1.0)
    if top == 1 or top <= 0:
        return None
    count = sum(int(np.count_nonzero(image == top)) for image in images)
    if count < LEAST_PLATEAU:
        return None
    below = [image[(image > BESIDE * top) & (image < top)] for image in images]
    beside = np.concatenate(below)
    if count <= STEEP * beside.size or len(np.unique(beside)) < CUT_OFF:
        return None
    return Plateau(top, count)


def _whites(images: list[np.ndarray]) -> int:
    """Number of values that are exactly 1."""
    return sum(int(np.count_nonzero(image == 1)) for image in images)


def _is_rounded(image: np.ndarray, encoding: Encoding, bits: int) -> bool:
    # The first few values are tested first: they mostly suffice to find no rounding.
    return all(
        bool(np.all(np.abs(levels - np.round(levels)) < 0.02))
        for part in (image.ravel()[:512], image)
        for levels in [encode(part, encoding) * (2**bits - 1)]
    )


def shared_rounding_variance(step: Values, sigma: Values) -> Values:
    r"""Variance of the part of a rounding error that equal pixels share.

    Noise of standard deviation $\sigma$ ahead of the rounding makes its error
    independent from pixel to pixel (dithering). The shared part is the mean of the
    sawtooth error over the noise, $\sum_k \frac{q^2}{2 \pi^2 k^2} e^{-4 \pi^2 k^2
    \sigma^2 / q^2}$: $q^2/12$ without noise, and nearly 0 from $\sigma \approx q/2$ on.

    ??? cite "Source"
        Widrow and Kollár, *Quantization noise*, 2008, chapter 4.
    """
    total = jnp.zeros_like(step)
    ratio = jnp.where(step > 0, sigma / jnp.where(step > 0, step, 1), 0)
    for k in range(1, 9):
        total += jnp.exp(-4 * np.pi**2 * k**2 * ratio**2) / (2 * np.pi**2 * k**2)
    # The series' tail matters only without noise, where its sum is known.
    return step**2 * jnp.where(ratio < 1e-3, 1 / 12, total)


def arithmetic_floor(image: Values) -> Float[Array, ""]:
    """Noise level below which residuals are rounding errors of the arithmetic."""
    # At least 1e-3, so that the floor of a black image is not 0.
    largest = jnp.max(jnp.abs(image), initial=1e-3)
    return 16 * jnp.finfo(image.dtype).eps * largest


def median_deviation(
    residual: Values, used: Bool[Array, "..."], least: Float[Array, ""] | None = None
) -> Float[Array, ""]:
    """Standard deviation from the median of |residual|, which is robust to outliers.

    The median is found by bisection of its logarithm, since sorting would take longer
    than a whole fit.

    **Arguments:**

    - `used`: true where a residual counts.
    - `least`: lower limit of the result; default a millionth of the largest residual.
    """
    size = jnp.where(used, jnp.abs(residual), 0)
    tiny = jnp.finfo(size.dtype).tiny
    high = jnp.log(jnp.maximum(jnp.max(size), tiny))
    low = high - 14 if least is None else jnp.minimum(jnp.log(least / 1.4826), high)
    half = jnp.sum(used).astype(size.dtype) / 2

    def halve(_: Array, edges: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = edges
        middle = (low + high) / 2
        below = jnp.sum(used & (size <= jnp.exp(middle))).astype(half.dtype)
        more = below < half
        return jnp.where(more, middle, low), jnp.where(more, high, middle)

    low, high = jax.lax.fori_loop(0, HALVINGS, halve, (low, high))
    return 1.4826 * jnp.exp((low + high) / 2)
