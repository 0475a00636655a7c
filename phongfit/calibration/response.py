r"""`fit_response`: estimate a camera's response curve, if it is not linear or sRGB.

The light $g(M)$ of a number M is a rising curve from 0 to 1. Its slope is the
exponential of a cubic spline in $\sqrt M$, so that it always rises and is smooth, with
most freedom at small numbers, where gamma curves bend most. Two kinds of photographs
determine it:

- a matte surface of known shape under known lamps, whose light is $E \max(n \cdot l, 0)
  + a$ with an unknown strength E of each lamp and light a of the room;
- the same view at several exposures e, whose light is $e L$ with an unknown L in each
  pixel.

In both cases light is $E q + a$, with q known and E common to a group of samples, and a
number's residual is

$$r = M - g^{-1}(E q + a).$$

E and a are estimated by linear least squares in light, and the spline by nonlinear
least squares, with Tukey's biweight against parts that are not matte, or moved.

??? cite "Source"
    Mitsunaga and Nayar, *Radiometric self calibration*, CVPR 1999; Debevec and Malik,
    *Recovering high dynamic range radiance maps from photographs*, SIGGRAPH 1997, for
    exposures. Grossberg and Nayar, *What can be known about the radiometric response
    from images?*, ECCV 2002: exposures have to be known.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from phongfit.calibration.least_squares import (
    TUKEY,
    blocks,
    clamped_mean,
    differentiated,
    least_squares,
    robust_scale,
    summed_by_block,
    thinned,
    tukey_weight,
)
from phongfit.calibration.spheres import Images, looked_at, names_of
from phongfit.codes import coded
from phongfit.edge import checked
from phongfit.rendering.film import ENCODINGS, NamedEncoding, decode
from phongfit.rendering.jpeg import namespace
from phongfit.rendering.response import ResponseCurve
from phongfit.scene import Scene

SPLINES = 9
"""Number of spline coefficients of the logarithm of the slope."""

SMOOTH = 1.0
"""Prior standard deviation of the coefficients' second differences, which extrapolates
the curve where there are no data. For sRGB it is 0.5."""

NUMBERS = np.linspace(0, 1, 257)
"""Numbers at which the resulting curve is sampled."""

GRID = np.linspace(0, 1, 8 * (len(NUMBERS) - 1) + 1)
"""Numbers at which the slope is integrated to light."""

DARKEST, BRIGHTEST = 0.03, 0.98
"""Numbers expected outside this range may have been cut off."""

LIT = 0.1
"""Smallest |n·l| that is used, on the lit and the shadowed side: near n·l = 0 shading
is uncertain."""

FACING = 0.3
"""Smallest n·v that is used, since pixels at the rim average over many normals."""

MOST = 1500
"""Approximate number of pixels used: errors of more would be correlated."""

STIFF = 1e4
"""Initial factor on the weight of the curve's smoothness."""

ROUNDS = 10
"""Number of updates of the samples' weights."""

FITS = 4.0
"""An encoding fits if it is off by fewer standard deviations than this."""

LEVEL = 1 / 255
"""An encoding also fits if it is off by less than this, one level of 8 bits."""


class Check(NamedTuple):
    """Comparison of a named encoding with the fitted curve.

    - `sigmas`: number of standard deviations by which it fits worse than the curve.
    - `off`: largest difference of its light from the curve's, as a fraction of white,
        over the range of numbers in the photographs.
    """

    sigmas: float
    off: float

    @property
    def fits(self) -> bool:
        """True if the data do not prefer the curve over the encoding."""
        return self.sigmas < FITS or self.off < LEVEL

    def __str__(self) -> str:
        about = f"{self.sigmas:.1f}" if self.sigmas < 100 else "more than 100"
        word = "fits" if self.fits else "does not fit"
        return f"{word}: off by up to {self.off:.3f} of white, {about} σ"


@dataclass(frozen=True, eq=False)
class Response:
    """Result of [`fit_response`][].

    - `curve`: the response curve, for use as an encoding.
    - `error`: standard errors of its samples relative to the light of the largest
        number in the photographs, since the scale of light is arbitrary.
    - `seen`: smallest and largest number in the photographs; beyond them the curve is
        extrapolated smoothly.
    - `checks`: comparisons with the named encodings.
    - `warnings`: problems that affect the result.
    """

    curve: ResponseCurve
    error: Float[np.ndarray, " samples"]
    seen: tuple[float, float]
    checks: Mapping[str, Check]
    warnings: tuple[str, ...]

    @property
    def encoding(self) -> Any:
        """The named encoding that fits best, if any fits; else the curve."""
        fitting = [name for name, check in self.checks.items() if check.fits]
        if not fitting:
            return self.curve
        return min(fitting, key=lambda name: self.checks[name].sigmas)

    def __str__(self) -> str:
        lines = [f"{name:<7} {check}" for name, check in self.checks.items()]
        low, high = self.seen
        lines += ["", f"number   light ± error, of that of {high:.3f}"]
        numbers = np.linspace(0, 1, len(self.error))
        light = np.asarray(self.curve.light)
        light = light / np.interp(high, numbers, light)
        for at in np.linspace(0, len(numbers) - 1, 11).round().astype(int)[1:]:
            note = "" if low <= numbers[at] <= high else "  (not seen)"
            lines.append(
                f"{numbers[at]:6.3f}  {light[at]:.4f} ± {self.error[at]:.4f}{note}"
            )
        lines += [f"warning: {warning}" for warning in self.warnings]
        return "\n".join(lines)


@checked
def fit_response(
    photographs: Images,
    *,
    scenes: Sequence[Scene] | None = None,
    exposures: Sequence[float] | None = None,
    mask: Bool[np.ndarray, "height width"] | None = None,
    names: Sequence[str] | None = None,
) -> Response:
    """Estimate the camera's response from a matte surface or from several exposures.

        stored = pf.ResponseCurve((0.0, 1.0))  # numbers as they stand in the file
        images = [pf.read_image(path, stored) for path in paths]
        found = pf.fit_response(images, exposures=(1, 2, 4, 8))
        fit = pf.fit(scene, pf.read_image("ball.jpg", found.curve))

    **Arguments:**

    - `photographs`: their numbers, (height, width, 3) in [0, 1], all of one size, of a
        camera that stands still.
    - `scenes`: of a matte surface, one for each photograph, with its lamp; the lamps'
        strengths are not used.
    - `exposures`: alternatively, the relative exposure of each photograph. The curve is
        only as accurate as these: a power law in their errors passes into the curve.
    - `mask`: true for pixels that may be used.
    - `names`: of the photographs, for messages.

    **Returns:** a [`Response`][].

    **Raises:** `ValueError` that names the argument, or if there are too few samples.
    """
    count = len(photographs)
    if (scenes is None) == (exposures is None):
        raise ValueError(
            "scenes: expected it or exposures, got "
            + ("neither" if scenes is None else "both")
        )
    names = names_of(photographs, names)
    given = scenes if scenes is not None else exposures
    assert given is not None
    if len(given) != count:
        what = "scenes" if scenes is not None else "exposures"
        raise ValueError(
            f"{what}: expected {count}, one a photograph, got {len(given)}"
        )
    if scenes is not None:
        samples = _of_surface(photographs, names, scenes, mask)
    else:
        samples = _of_exposures(photographs, names, _positive(exposures), mask)
    return _fit(samples)


class _Samples(NamedTuple):
    """Numbers M and the known part q of their light E q + a: one row for each E.

    - `number`: M.
    - `share`: q.
    - `block`: number of the block of samples with correlated errors.
    - `sound`: true for samples that may be used. Black and white numbers are included:
        they are excluded later by the expected number, since selection by the number
        itself would be biased by noise.
    - `room`: true if there is light of the room, a.
    """

    number: Float[np.ndarray, "groups members"]
    share: Float[np.ndarray, "groups members"]
    block: Int[np.ndarray, "groups members"]
    sound: Bool[np.ndarray, "groups members"]
    room: bool


def _positive(exposures: Any) -> Float[np.ndarray, " n"]:
    found = np.asarray(exposures, float)
    if not (np.isfinite(found).all() and (found > 0).all()):
        raise ValueError(f"exposures: expected numbers > 0, got {exposures!r}")
    if len(found) < 2 or found.max() < 1.1 * found.min():
        raise ValueError(
            "exposures: expected several that differ, since alike ones tell nothing of "
            f"a response, got {', '.join(f'{one:g}' for one in found)}"
        )
    return found / found.mean()


def _numbers(
    photographs: Images, names: Sequence[str], mask: Any, size: tuple[int, int]
) -> Float[np.ndarray, "count pixels 3"]:
    found = []
    for image, name in zip(looked_at(photographs, names), names, strict=True):
        if image.shape[:2] != size:
            raise ValueError(
                f"{name}: expected {size[1]} × {size[0]} pixels, as mask and scenes "
                f"have, got {image.shape[1]} × {image.shape[0]}"
            )
        found.append(np.asarray(image[mask], float))
    return np.stack(found)


def _of_surface(
    photographs: Images,
    names: Sequence[str],
    scenes: Sequence[Scene],
    mask: Bool[np.ndarray, "height width"] | None,
) -> _Samples:
    for number, scene in enumerate(scenes):
        if len(scene.lights) != 1:
            raise ValueError(
                f"scenes[{number}]: expected one lamp, got {len(scene.lights)}"
            )
        if not scene.lights[0].directed:
            raise ValueError(
                f"scenes[{number}]: expected a lamp, got light from all around"
            )
    seen = scenes[0].trace()
    facing = np.sum(np.asarray(seen.normal) * np.asarray(seen.to_viewer), axis=-1)
    used = np.asarray(seen.mask) & (facing > FACING)
    if mask is not None:
        used &= _as_mask(mask, used.shape)
    used = thinned(used, MOST)
    numbers = _numbers(photographs, names, used, used.shape)
    normals, points = np.asarray(seen.normal)[used], np.asarray(seen.position)[used]
    cosines = np.zeros(numbers.shape[:2])
    shares = np.zeros(numbers.shape)
    for number, scene in enumerate(scenes):
        light = jax.vmap(scene.lights[0].illuminate)(jnp.asarray(points))
        cosines[number] = np.sum(normals * np.asarray(light.to_light), axis=-1)
        strength = np.asarray(light.intensity)
        shares[number] = np.maximum(cosines[number], 0)[:, None] * strength
    block = blocks(*used.shape)[used]
    block = np.arange(len(numbers))[:, None] * (block.max() + 1) + block
    lit = (cosines[..., None] > LIT) & (numbers > DARKEST) & (numbers < BRIGHTEST)
    if lit.sum() < 50 * SPLINES:
        raise ValueError(
            "photographs: too little is seen of a lit surface that is neither black "
            "nor white; is the surface where the scenes have it?"
        )

    def rows(values: np.ndarray) -> np.ndarray:
        """Values as rows, one for each photograph and channel."""
        every = np.broadcast_to(values, numbers.shape)
        return np.moveaxis(every, 2, 1).reshape(-1, every.shape[1])

    sound = np.abs(cosines) > LIT
    return _Samples(
        rows(numbers),
        rows(shares),
        rows(block[..., None]),
        rows(sound[..., None]),
        True,
    )


def _of_exposures(
    photographs: Images,
    names: Sequence[str],
    exposures: Float[np.ndarray, " n"],
    mask: Bool[np.ndarray, "height width"] | None,
) -> _Samples:
    size = np.shape(photographs[0])[:2]
    used = np.ones(size, bool) if mask is None else _as_mask(mask, size)
    used = thinned(used, MOST)
    numbers = _numbers(photographs, names, used, (size[0], size[1]))
    seen = (numbers > DARKEST) & (numbers < BRIGHTEST)
    # A pixel that is usable in a single photograph has no information.
    several = seen.sum(axis=0) > 1
    if seen[:, several].sum() < 50 * SPLINES:
        raise ValueError(
            "photographs: too few pixels are neither black nor white in two of them: "
            "bracket by one or two stops"
        )
    pixel, _ = np.nonzero(several)
    number = numbers[:, several].T
    share = np.broadcast_to(exposures, number.shape)
    block = np.broadcast_to(blocks(*used.shape)[used][pixel, None], number.shape)
    return _Samples(number, share, block, np.ones(number.shape, bool), False)


def _as_mask(mask: Any, size: tuple[int, ...]) -> Bool[np.ndarray, "height width"]:
    found = np.asarray(mask, bool)
    if found.shape != tuple(size):
        raise ValueError(f"mask: expected shape {tuple(size)}, got {found.shape}")
    return found


@functools.cache
def _basis() -> tuple[np.ndarray, np.ndarray]:
    """The spline's basis on the grid, and rows of its smoothness prior."""
    from scipy.interpolate import BSpline

    knots = np.concatenate([[0] * 3, np.linspace(0, 1, SPLINES - 2), [1] * 3])
    basis = BSpline.design_matrix(np.sqrt(GRID), knots, 3).toarray()
    bends = np.diff(np.eye(SPLINES), 2, axis=0) / SMOOTH
    # The last row fixes a common factor of the slope, which does not affect the curve.
    return basis, np.concatenate([bends, np.ones((1, SPLINES))])


class _Weights(NamedTuple):
    """Weights of the samples, from the latest curve.

    - `number`: numbers without the clamp's increase of their mean.
    - `used`: weights of Tukey's biweight; 0 for black and white samples.
    - `rise`: slope of the curve at the sample.
    - `sigma`: standard deviation of numbers.
    - `stiff`: factor on the weight of smoothness; 1 in the end.
    """

    number: Any
    used: Any
    rise: Any
    sigma: Any
    stiff: Any


def _light(theta: Any) -> Any:
    """Light on the grid, in arrays of JAX or NumPy."""
    xp = namespace(theta)
    log_slope = _basis()[0] @ theta
    slope = xp.exp(xp.clip(log_slope - log_slope.max(), -40, 0))
    steps = (slope[1:] + slope[:-1]) / 2 * np.diff(GRID)
    light = xp.concatenate([xp.zeros(1), xp.cumsum(steps)])
    return light / light[-1]


def _errors(light: Any, samples: Any, weights: Any, least_room: Any) -> Any:
    """Residuals of numbers for a curve, with room light of at least `least_room`.

    Strengths and the light of the room are estimated by linear least squares. Beyond
    black and white the curve is extrapolated linearly, for corrected numbers there.
    """
    xp = namespace(light)
    q, number, last = samples.share, weights.number, len(GRID) - 1
    below = xp.clip(number * last, 0, last - 1).astype(int)
    light_below, step = light[below], xp.diff(light)
    found = light_below + (number * last - below) * step[below]
    weight = weights.used / weights.rise**2

    def sums(values: Any) -> Any:
        return xp.sum(values, axis=1, keepdims=True)

    squares = xp.maximum(sums(weight * q * q), 1e-300)
    products, crossed = sums(weight * q * found), sums(weight * q)
    # The room's light, with strengths eliminated.
    top = xp.sum(weight * found) - xp.sum(products * crossed / squares)
    bottom = xp.sum(weight) - xp.sum(crossed**2 / squares)
    some = samples.room & (bottom > 0)
    best = xp.maximum(top / xp.where(some, bottom, 1), least_room)
    room = xp.where(some, best, 0)
    shown = (products - room * crossed) / squares * q + room
    below = xp.clip(xp.searchsorted(light, shown) - 1, 0, last - 1)
    return number - (below + (shown - light[below]) / step[below]) / last


def _residual(theta: Any, samples: Any, weights: Any, least_room: Any) -> Any:
    """Weighted residuals of numbers, and of the smoothness prior."""
    errors = _errors(_light(theta), samples, weights, least_room)
    bends = jnp.sqrt(weights.stiff) * weights.sigma * (_basis()[1] @ theta)
    return jnp.concatenate([jnp.ravel(jnp.sqrt(weights.used) * errors), bends])


def _fit(samples: _Samples) -> Response:
    """The best curve for the samples, and its standard errors."""
    residual = differentiated(_residual)
    theta, weights = _solve(samples, residual)
    light, slopes = differentiated(_light)(theta)
    rest = _errors(light, samples, weights, 0.0)
    lit = _lit(samples, weights.number - rest, weights.sigma)
    count, freedom = np.count_nonzero(lit), _freedom(samples, lit) - SPLINES
    # No bound at 0 here, since the light of a dark room is uncertain.
    jacobian = residual(theta, samples, weights, -np.inf)[1][: rest.size]
    root = np.sqrt(weights.used)
    u = rest / (TUKEY * weights.sigma)
    slope = np.where(lit & (np.abs(u) < 1), (1 - u**2) * (1 - 5 * u**2), 0)
    # Loss of efficiency by weights: Huber, *Robust statistics*, 1981, section 7.6.
    scores = weights.used * rest
    variance = np.sum(scores**2) / freedom / (np.sum(slope) / count) ** 2
    data, smooth = jacobian.T @ jacobian, _basis()[1].T @ _basis()[1]
    held = np.linalg.inv(data + weights.stiff * weights.sigma**2 * smooth)
    known = held @ data
    # Inflation by correlated errors: excess variance of the sums of blocks.
    each = (root * rest).reshape(-1, 1) * jacobian
    together = summed_by_block(each, samples.block.ravel())
    bread = known @ held
    inflation = np.trace(bread @ together.T @ together) / np.trace(
        bread @ each.T @ each
    )
    variance *= np.sum(weights.used) / count * max(float(inflation), 1.0)
    covariance = np.linalg.inv(data / variance + weights.stiff * smooth)

    shown = (weights.used > 0) & (samples.share > 0)
    low, high = np.percentile(samples.number[shown], (0.5, 99.5)).tolist()
    # Derivatives of the curve relative to its light at the largest number, since the
    # scale of light is arbitrary.
    at_high = np.interp(high, GRID, light)
    by_high = [np.interp(high, GRID, column) for column in slopes.T]
    slopes = (slopes - np.outer(light / at_high, by_high)) / at_high
    slopes = slopes[:: (len(GRID) - 1) // (len(NUMBERS) - 1)]
    best = float(np.sum(weights.used * rest**2))

    def check(name: NamedEncoding) -> Check:
        other = np.asarray(decode(GRID, name))
        off = _errors(other, samples, weights, 0.0)
        more = (float(np.sum(weights.used * off**2)) - best) / variance
        freedom = max(float(np.trace(known)), 1.0)
        return _checked(light, other, max(more, 0.0), freedom, (low, high))

    # Ensure a rise everywhere: rounding could make parts flat.
    curve = np.interp(NUMBERS, GRID, light) + 1e-9 * NUMBERS
    return Response(
        ResponseCurve((curve / curve[-1]).tolist()),
        np.sqrt(np.einsum("ni,ij,nj->n", slopes, covariance, slopes)),
        (low, high),
        {name: check(name) for name in ENCODINGS},
        _warnings(low, high, weights.sigma),
    )


def _solve(
    samples: _Samples, residual: Callable[..., Any]
) -> tuple[np.ndarray, _Weights]:
    """The spline's coefficients, and the final weights of samples."""
    number = samples.number
    used = ((number > DARKEST) & (number < BRIGHTEST)).astype(float)
    used = np.where(samples.share == 0, 1.0, used) * samples.sound
    weights = _Weights(number, used, np.ones(number.shape), 0.01, 1.0)
    starts = []
    for name in ENCODINGS:
        light = np.asarray(decode(GRID, name))
        log_slope = np.log(np.gradient(light, GRID))
        rest = _errors(light, samples, weights, 0.0)[used > 0]
        near = np.linalg.lstsq(_basis()[0], log_slope, rcond=None)[0]
        starts.append((float(np.median(np.abs(rest))), near))
    theta = min(starts, key=lambda start: start[0])[1]
    for step in range(ROUNDS):
        # Stiff at first: otherwise the curve bends below the darkest number, where a
        # step in light is degenerate with light of the room.
        weights = weights._replace(stiff=max(STIFF / 4**step, 1.0))
        theta = least_squares(residual, theta, samples, weights, 0.0).values
        light = _light(theta)
        rest = _errors(light, samples, weights, 0.0)
        expected = weights.number - rest
        lit = _lit(samples, expected, weights.sigma)
        # Shadows are excluded, since the clamp at black may cut off half of them.
        lost = np.sqrt(np.count_nonzero(lit) / _freedom(samples, lit))
        sigma = max(robust_scale(rest[lit & (samples.share > 0)]) * lost, 1e-5)
        number = samples.number + expected - clamped_mean(expected, sigma)
        # The first curves are too far off to identify outliers.
        tukey = tukey_weight(number - expected, sigma) if step >= ROUNDS // 2 else 1.0
        rise = np.interp(np.maximum(expected, DARKEST), GRID, np.gradient(light, GRID))
        used = np.where(lit, tukey, 0.0)
        weights = _Weights(number, used, rise, sigma, weights.stiff)
    return theta, weights


def _lit(samples: _Samples, expected: np.ndarray, sigma: float) -> np.ndarray:
    """Mask of samples in use: shadows, and numbers that are neither black nor white.

    Near these limits the expected number decides, since the number has noise.
    """
    number, near = samples.number, min(5 * sigma, 0.1)
    dark = np.where(number < DARKEST + near, expected, number) < DARKEST
    bright = np.where(number > BRIGHTEST - near, expected, number) > BRIGHTEST
    return samples.sound & (~dark & ~bright | (samples.share == 0))


def _freedom(samples: _Samples, lit: np.ndarray) -> int:
    """Degrees of freedom: samples in use minus strengths and room light; at least 1."""
    strengths = np.count_nonzero((lit & (samples.share > 0)).any(axis=1))
    return max(int(np.count_nonzero(lit) - strengths) - samples.room, 1)


def _checked(
    light: np.ndarray,
    other: np.ndarray,
    more: float,
    freedom: float,
    seen: tuple[float, float],
) -> Check:
    """Compare an encoding's light with the curve's; `more` is its excess of χ²."""
    from scipy import stats

    chance = float(stats.chi2.sf(more, freedom))
    # Approximation where the tail's probability underflows.
    sigmas = stats.norm.isf(chance / 2) if chance > 1e-300 else np.sqrt(more)
    shown = (GRID >= seen[0]) & (GRID <= seen[1])
    one, two = other[shown], light[shown]
    scale = one @ two / (two @ two)
    return Check(float(sigmas), float(np.abs(one - scale * two).max()))


def _warnings(low: float, high: float, sigma: float) -> tuple[str, ...]:
    found = []
    if high < 0.7 or low > 0.4:
        words = (
            f"only numbers from {low:.2f} to {high:.2f} are seen: beyond them the "
            "curve is extrapolated"
        )
        found.append(coded("range-unseen", words))
    if sigma > 0.02:
        words = f"numbers are {sigma:.3f} from the curve (standard deviation)"
        found.append(coded("not-one-curve", words))
    return tuple(found)
